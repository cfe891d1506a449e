/* Timers 1 to 14 (chapters 17 to 20): up-counting, prescaler, period, update interrupt, compare registers, capture; DMA by
channel.

The counter is computed when it is read. An overflow is an event only if its interrupt or DMA for an output is enabled; a flag
alone is computed when it is read, so that PWM at some hundred kilohertz costs nothing. */
#include "machine.h"

enum { CR1 = 0x00, DIER = 0x0C, SR = 0x10, EGR = 0x14, CCMR1 = 0x18, CCER = 0x20, CNT = 0x24, PSC = 0x28, ARR = 0x2C };
enum { CCR1 = 0x34, CCR4 = 0x40, CHANNELS = 4, WITH_CHANNELS = 8 }; /* TIM1 to TIM8: two of them have no channels */

/* Interrupt of the update event, by index: TIM1..TIM14. */
static const uint8_t UPDATE_IRQ[TIMERS] = {25, 28, 29, 30, 50, 54, 55, 44, 24, 25, 26, 43, 44, 45};

/* Core cycles per cycle of the timer's clock: APB2 runs at half the core's clock and its timers at twice that. */
static uint64_t tick_cycles(unsigned n, const struct timer *t)
{
    unsigned number = n + 1, fast = number == 1 || (number >= 8 && number <= 11);
    return (fast ? 1ull : 2ull) * (t->prescaler + 1ull);
}

static uint64_t ticks(struct machine *m, unsigned n, uint64_t when)
{
    struct timer *t = &m->timer[n];
    return t->base + (t->cr1 & 1 && when > t->since ? (when - t->since) / tick_cycles(n, t) : 0);
}

static uint32_t ccr_address(unsigned n, unsigned channel)
{
    static const uint32_t BASE[WITH_CHANNELS] = {0x40010000, 0x40000000, 0x40000400, 0x40000800, 0x40000C00, 0, 0, 0x40010400};
    return BASE[n] + CCR1 + 4 * channel;
}

static int is_input(const struct timer *t, unsigned channel) /* CCxS */
{
    return t->others[CCMR1 / 4 + channel / 2] >> 8 * (channel & 1) & 3;
}

static int feeds_output(unsigned n, const struct timer *t, unsigned channel) /* CCxDE of an output */
{
    return n < WITH_CHANNELS && t->dier >> (9 + channel) & 1 && !is_input(t, channel);
}

static int feeds_outputs(unsigned n, const struct timer *t)
{
    return feeds_output(n, t, 0) || feeds_output(n, t, 1) || feeds_output(n, t, 2) || feeds_output(n, t, 3);
}

static void write_ccr(struct machine *m, unsigned n, unsigned channel, uint32_t value)
{
    m->timer[n].others[CCR1 / 4 + channel] = value;
    if (!esc_at(m, n, channel) && m->compare[n][channel] != value) {
        m->compare[n][channel] = value;
        m->stop_reason |= STOP_COMPARE;
    }
}

/* A period is over: its pulses have left the outputs, and the requests of its compare matches get their words. */
static void end_period(struct machine *m, unsigned n)
{
    struct timer *t = &m->timer[n];
    for (unsigned channel = 0; channel < CHANNELS; channel++) {
        uint32_t word;
        if (!feeds_output(n, t, channel))
            continue;
        if (esc_at(m, n, channel))
            esc_pulse(m, esc_at(m, n, channel), t->others[CCR1 / 4 + channel], t->arr + 1ull, tick_cycles(n, t),
                      t->others[CCER / 4] >> (4 * channel + 1) & 1);
        if (dma_take(m, ccr_address(n, channel), &word))
            write_ccr(m, n, channel, word);
    }
}

static void look_for_overflow(struct machine *m, unsigned n)
{
    struct timer *t = &m->timer[n];
    uint64_t overflows = ticks(m, n, m->now) / (t->arr + 1ull);
    if (overflows <= t->seen)
        return;
    while (t->seen < overflows && feeds_outputs(n, t)) {
        t->seen++;
        end_period(m, n);
    }
    t->seen = overflows;
    if (!(t->cr1 & 2)) /* UDIS */
        t->sr |= 1;
}

/* The level at an input has changed at a time: capture the count. */
void timer_edge(struct machine *m, unsigned n, unsigned channel, int high, uint64_t when)
{
    struct timer *t = &m->timer[n];
    uint32_t polarity = t->others[CCER / 4] >> 4 * channel & 11, count = (uint32_t)(ticks(m, n, when) % (t->arr + 1ull));
    int last;
    if (is_input(t, channel) != 1 || !(polarity == 11 || polarity == (high ? 1u : 3u))) /* CCxE, with CCxP and CCxNP */
        return;
    t->others[CCR1 / 4 + channel] = count;
    if (t->dier >> (9 + channel) & 1)
        dma_put(m, ccr_address(n, channel), count, &last);
}

static void plan_overflow(struct machine *m, unsigned n)
{
    struct timer *t = &m->timer[n];
    uint64_t next = (t->seen + 1) * (t->arr + 1ull) - t->base;
    int wanted = t->cr1 & 1 && (t->dier & 1 || feeds_outputs(n, t)) && t->arr;
    plan(m, DUE_TIMER + n, wanted ? t->since + next * tick_cycles(n, t) : NEVER);
}

static void update_line(struct machine *m, unsigned n)
{
    set_line(m, UPDATE_IRQ[n], m->timer[n].sr & m->timer[n].dier & 1);
}

/* Count on from here, with a possibly changed clock. */
static void restart(struct machine *m, unsigned n, uint32_t count)
{
    struct timer *t = &m->timer[n];
    t->base = count;
    t->since = m->now;
    t->seen = 0;
}

void timer_due(struct machine *m, unsigned n)
{
    struct timer *t = &m->timer[n];
    look_for_overflow(m, n);
    if (t->prescaler != t->psc) { /* it is preloaded: takes effect at an update */
        restart(m, n, 0);
        t->prescaler = t->psc;
    }
    plan_overflow(m, n);
    update_line(m, n);
}

uint32_t timer_read(struct machine *m, unsigned n, uint32_t offset)
{
    struct timer *t = &m->timer[n];
    look_for_overflow(m, n);
    switch (offset) {
    case CR1: return t->cr1;
    case DIER: return t->dier;
    case SR: return t->sr;
    case CNT: return (uint32_t)(ticks(m, n, m->now) % (t->arr + 1ull));
    case PSC: return t->psc;
    case ARR: return t->arr;
    default: return t->others[offset / 4 & 31];
    }
}

void timer_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value)
{
    struct timer *t = &m->timer[n];
    look_for_overflow(m, n);
    uint32_t count = (uint32_t)(ticks(m, n, m->now) % (t->arr + 1ull));
    switch (offset) {
    case CR1:
        restart(m, n, count);
        t->cr1 = value;
        break;
    case DIER: t->dier = value; break;
    case SR: t->sr &= value; break;
    case EGR:
        if (value & 1) {
            restart(m, n, 0);
            t->prescaler = t->psc;
            if (!(t->cr1 & 6)) /* UDIS, URS */
                t->sr |= 1;
        }
        break;
    case CNT: restart(m, n, value); break;
    case PSC: t->psc = value & 0xFFFF; break;
    case ARR:
        restart(m, n, value && count > value ? 0 : count);
        t->arr = n == 1 || n == 4 ? value : value & 0xFFFF; /* TIM2 and TIM5 have 32 bits */
        break;
    default:
        if (offset >= CCR1 && offset <= CCR4)
            write_ccr(m, n, (offset - CCR1) / 4, value);
        else
            t->others[offset / 4 & 31] = value;
    }
    plan_overflow(m, n);
    update_line(m, n);
}
