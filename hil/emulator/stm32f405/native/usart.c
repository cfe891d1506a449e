/* The USARTs (chapter 30), 8 bits and no parity: one byte in the register, one in the shifter, by interrupt or by DMA.

Bytes from outside arrive back to back, at the rate of the receiver. Sent bytes are kept until the line is silent. */
#include "machine.h"

enum { ORE = 1 << 3, RXNE = 1 << 5, TC = 1 << 6, TXE = 1 << 7 };
enum { RE = 4, TE = 8, RXNEIE = 1 << 5, TCIE = 1 << 6, TXEIE = 1 << 7, UE = 1 << 13, DMAR = 1 << 6, DMAT = 1 << 7, EIE = 1 };

static const uint32_t BASE[USARTS] = {0x40011000, 0x40004400, 0x40004800, 0x40004C00, 0x40005000, 0x40011400};
static const uint8_t USART_IRQ[USARTS] = {37, 38, 39, 52, 53, 71};

static void update_line(struct machine *m, unsigned n)
{
    struct usart *u = &m->usart[n];
    int receiving = u->cr1 & RXNEIE && u->sr & (RXNE | ORE);
    set_line(m, USART_IRQ[n], receiving || (u->cr1 & TCIE && u->sr & TC) || (u->cr1 & TXEIE && u->sr & TXE));
}

static uint64_t byte_cycles(const struct usart *u, unsigned n)
{
    uint64_t clock = n == 0 || n == 5 ? 2 : 4; /* core cycles per cycle of APB2 and APB1 */
    return 10 * clock * (u->brr ? u->brr : 1);
}

static void shift_out(struct machine *m, unsigned n, uint32_t byte)
{
    struct usart *u = &m->usart[n];
    u->shift = byte;
    u->sending = 1;
    u->sr &= ~(uint32_t)TC;
    plan(m, DUE_SEND + n, m->now + byte_cycles(u, n));
}

static void write_data(struct machine *m, unsigned n, uint32_t byte)
{
    struct usart *u = &m->usart[n];
    if (!u->sending) {
        shift_out(m, n, byte);
    } else {
        u->held = byte;
        u->sr &= ~(uint32_t)(TXE | TC);
    }
}

/* Let DMA fill empty registers. */
void usart_kick(struct machine *m)
{
    for (unsigned n = 0; n < USARTS; n++) {
        struct usart *u = &m->usart[n];
        uint32_t byte;
        while (u->cr3 & DMAT && u->sr & TXE && dma_take(m, BASE[n] + 4, &byte))
            write_data(m, n, byte);
        update_line(m, n);
    }
}

void usart_send_due(struct machine *m, unsigned n)
{
    struct usart *u = &m->usart[n];
    if (u->filled < LINE_BYTES)
        u->sent[u->filled++] = (uint8_t)u->shift;
    u->sending = 0;
    plan(m, DUE_SEND + n, NEVER);
    if (!(u->sr & TXE)) {
        u->sr |= TXE;
        shift_out(m, n, u->held);
        usart_kick(m);
    }
    if (!u->sending) {
        u->sr |= TC;
        m->stop_reason |= STOP_SERIAL;
    }
    update_line(m, n);
}

void usart_receive_due(struct machine *m, unsigned n)
{
    struct usart *u = &m->usart[n];
    uint8_t byte = u->received[u->first++ % LINE_BYTES];
    int last;
    plan(m, DUE_RECEIVE + n, u->first != u->last ? m->due[DUE_RECEIVE + n] + byte_cycles(u, n) : NEVER);
    if (!(u->cr1 & UE) || !(u->cr1 & RE))
        return;
    if (u->cr3 & DMAR && dma_put(m, BASE[n] + 4, byte, &last))
        return;
    if (u->sr & RXNE) {
        u->sr |= ORE;
        u->overruns++;
    } else {
        u->dr = byte;
        u->sr |= RXNE;
    }
    update_line(m, n);
}

/* Start the arrival of bytes from outside, after those still arriving; return the number accepted. */
uint32_t usart_feed(struct machine *m, unsigned n, const uint8_t *bytes, uint32_t size)
{
    struct usart *u = &m->usart[n];
    uint32_t taken = 0;
    if (u->first == u->last && size)
        plan(m, DUE_RECEIVE + n, m->now + byte_cycles(u, n));
    for (; taken < size && u->last - u->first < LINE_BYTES; taken++)
        u->received[u->last++ % LINE_BYTES] = bytes[taken];
    return taken;
}

uint32_t usart_read(struct machine *m, unsigned n, uint32_t offset)
{
    struct usart *u = &m->usart[n];
    uint32_t value = offset < sizeof u->registers ? u->registers[offset / 4] : 0;
    if (offset == 0x04) {
        u->sr &= ~(uint32_t)(RXNE | ORE);
        update_line(m, n);
    }
    return value;
}

void usart_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value)
{
    struct usart *u = &m->usart[n];
    if (offset == 0x00)
        u->sr &= value | ~(uint32_t)(TC | RXNE);
    else if (offset == 0x04)
        write_data(m, n, value & 0xFF);
    else if (offset < sizeof u->registers)
        u->registers[offset / 4] = value & 0xFFFF;
    usart_kick(m);
}
