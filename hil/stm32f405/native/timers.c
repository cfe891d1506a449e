/* Timers 1 to 14 (chapters 17 to 20): up-counting, prescaler, period, update interrupt, compare registers.

The counter is computed when it is read. An overflow is an event only if its interrupt is enabled; a flag alone is
computed when it is read, so that PWM at some hundred kilohertz costs nothing. */
#include "machine.h"

enum { CR1 = 0x00, DIER = 0x0C, SR = 0x10, EGR = 0x14, CNT = 0x24, PSC = 0x28, ARR = 0x2C, CCR1 = 0x34, CCR4 = 0x40 };

/* Interrupt of the update event, by index: TIM1..TIM14. */
static const uint8_t UPDATE_IRQ[TIMERS] = {25, 28, 29, 30, 50, 54, 55, 44, 24, 25, 26, 43, 44, 45};

/* Core cycles per cycle of the timer's clock: APB2 runs at half the core's clock and its timers at twice that. */
static uint64_t tick_cycles(unsigned n, const struct timer *t)
{
    unsigned number = n + 1, fast = number == 1 || (number >= 8 && number <= 11);
    return (fast ? 1ull : 2ull) * (t->prescaler + 1ull);
}

static uint64_t ticks(struct machine *m, unsigned n)
{
    struct timer *t = &m->timer[n];
    return t->base + (t->cr1 & 1 ? (m->now - t->since) / tick_cycles(n, t) : 0);
}

static void look_for_overflow(struct machine *m, unsigned n)
{
    struct timer *t = &m->timer[n];
    uint64_t overflows = ticks(m, n) / (t->arr + 1ull);
    if (overflows > t->seen) {
        t->seen = overflows;
        if (!(t->cr1 & 2)) /* UDIS */
            t->sr |= 1;
    }
}

static void plan_overflow(struct machine *m, unsigned n)
{
    struct timer *t = &m->timer[n];
    uint64_t next = (t->seen + 1) * (t->arr + 1ull) - t->base;
    int wanted = t->cr1 & 1 && t->dier & 1 && t->arr;
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
    case CNT: return (uint32_t)(ticks(m, n) % (t->arr + 1ull));
    case PSC: return t->psc;
    case ARR: return t->arr;
    default: return t->others[offset / 4 & 31];
    }
}

void timer_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value)
{
    struct timer *t = &m->timer[n];
    look_for_overflow(m, n);
    uint32_t count = (uint32_t)(ticks(m, n) % (t->arr + 1ull));
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
        t->others[offset / 4 & 31] = value;
        if (offset >= CCR1 && offset <= CCR4 && m->compare[n][(offset - CCR1) / 4] != value) {
            m->compare[n][(offset - CCR1) / 4] = value;
            m->why |= WHY_COMPARE;
        }
    }
    plan_overflow(m, n);
    update_line(m, n);
}
