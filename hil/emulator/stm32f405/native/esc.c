/* Electronic speed controllers at outputs of timers: DSHOT frames in, the motor's speed back on the same wire.

A frame is 16 pulses, long ones are 1: 11 bits of throttle, a request, 4 bits of checksum. With inverted levels and checksum
an ESC answers. Times and limits are those of Bluejay (0368d11), which Bitcraze's ESCs run. */
#include "machine.h"

enum { FRAME_BITS = 16, COMMANDS = 48 /* throttles below stop the motor */, REPLY_BITS = 21 };
#define REPLY_AFTER (30 * (uint64_t)CLOCK_HZ / 1000000)
#define SILENCE (160 * (uint64_t)CLOCK_HZ / 1000) /* 10 rounds of 16 ms without a frame stop the motor */

struct esc *esc_at(struct machine *m, unsigned timer, unsigned channel)
{
    for (unsigned i = 0; i < m->escs; i++)
        if (m->esc[i].timer == timer && m->esc[i].channel == channel)
            return &m->esc[i];
    return 0;
}

static void set_throttle(struct machine *m, struct esc *e, uint32_t throttle)
{
    if (e->throttle != throttle)
        m->stop_reason |= STOP_COMPARE;
    e->throttle = m->compare[e->timer][e->channel] = throttle;
}

static void take_frame(struct machine *m, struct esc *e, int inverted)
{
    uint32_t data = e->frame >> 4 & 0xFFF, sum = data ^ data >> 4 ^ data >> 8, throttle = data >> 1;
    if (((inverted ? ~sum : sum) & 15) != (e->frame & 15)) {
        e->refused++;
        return;
    }
    if (throttle < COMMANDS)
        throttle = 0;
    e->ready |= !throttle;
    set_throttle(m, e, e->ready ? throttle : 0);
    e->left = inverted ? REPLY_BITS : 0;
    e->high = 1;
    plan(m, DUE_ESC + (unsigned)(e - m->esc), m->now + (inverted ? REPLY_AFTER : SILENCE));
}

/* A pulse of `width` ticks in a period has arrived; width 0: the wire has rested, and the next pulse begins a frame. */
void esc_pulse(struct machine *m, struct esc *e, uint64_t width, uint64_t period, uint64_t tick, int inverted)
{
    e->frame = e->frame << 1 | (2 * width > period);
    e->bits = width ? e->bits + 1 : 0;
    e->reply_bit = period * tick * 4 / 5;
    if (e->bits == FRAME_BITS)
        take_frame(m, e, inverted);
}

/* Return a reply: the period of an electrical revolution [us] as 3 bits of exponent and 9 of mantissa, with a checksum, in
   group code behind a start bit. A 1 is a change of the level. */
static uint32_t reply_of(const struct esc *e)
{
    static const uint8_t CODE[16] = {25, 27, 18, 19, 29, 21, 22, 23, 26, 9, 10, 11, 30, 13, 14, 15};
    double period = *e->rpm > 0.0 ? 120e6 / (*e->rpm * e->poles) : 1e6;
    uint32_t exponent = 0, value = 0xFFF, reply = 1;
    while (exponent < 7 && period >= 512 << exponent)
        exponent++;
    if (period < 512 << exponent) /* else it counts as standing */
        value = exponent << 9 | (uint32_t)period >> exponent;
    value = value << 4 | (~(value ^ value >> 4 ^ value >> 8) & 15);
    for (int shift = 12; shift >= 0; shift -= 4)
        reply = reply << 5 | CODE[value >> shift & 15];
    return reply;
}

/* The next edge of the reply is due, the wire's return to rest, or the end of patience. */
void esc_due(struct machine *m, unsigned i)
{
    struct esc *e = &m->esc[i];
    uint64_t now = m->due[DUE_ESC + i];
    uint32_t bits = 0; /* to the edge after this one */
    if (!e->left && e->high) {
        e->ready = 0;
        set_throttle(m, e, 0);
        plan(m, DUE_ESC + i, NEVER);
        return;
    }
    if (e->left == REPLY_BITS)
        e->reply = reply_of(e);
    e->high = !e->high;
    timer_edge(m, e->timer, e->channel, (int)e->high, now);
    while (e->left) {
        e->left--;
        bits++;
        if (e->left && e->reply >> (e->left - 1) & 1)
            break;
    }
    plan(m, DUE_ESC + i, now + (bits && (e->left || !e->high) ? bits * e->reply_bit : SILENCE));
}

/* Connect an ESC to a timer's output, of a motor with so many poles that turns at `rpm`; return 0 without room. */
int machine_esc(struct machine *m, uint32_t timer, uint32_t channel, const double *rpm, uint32_t poles)
{
    if (m->escs == ESCS)
        return 0;
    m->esc[m->escs++] = (struct esc){.rpm = rpm, .timer = timer, .channel = channel, .poles = poles};
    return 1;
}
