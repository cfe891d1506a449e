/* The I2C controllers as masters (chapter 27): start, address, bytes and stop take bus time; DMA moves received bytes.
Devices are memories with a pointer, which the first bytes of a write set. */
#include "machine.h"

#include <string.h>

enum { PE = 1, START = 1 << 8, STOP = 1 << 9, ACK = 1 << 10, SWRST = 1 << 15 };
enum { ITERREN = 1 << 8, ITEVTEN = 1 << 9, ITBUFEN = 1 << 10, DMAEN = 1 << 11, LAST = 1 << 12 };
enum { SB = 1, ADDR = 2, BTF = 4, RXNE = 1 << 6, TXE = 1 << 7, AF = 1 << 10, ERRORS = 0xDF00 };
enum { MSL = 1, BUSY = 2, TRA = 4 };
enum { NOTHING, STARTING, ADDRESSING, SENDING, RECEIVING, STOPPING };

static const uint32_t BASE[BUSES] = {0x40005400, 0x40005800, 0x40005C00};
static const uint8_t EVENT_IRQ[BUSES] = {31, 33, 72};

static void update_lines(struct machine *m, unsigned n)
{
    struct bus *b = &m->bus[n];
    uint32_t events = b->sr1 & (SB | ADDR | BTF), buffer = b->cr2 & ITBUFEN ? b->sr1 & (RXNE | TXE) : 0;
    set_line(m, EVENT_IRQ[n], b->cr2 & ITEVTEN && (events || buffer));
    set_line(m, EVENT_IRQ[n] + 1u, b->cr2 & ITERREN && b->sr1 & ERRORS);
}

static uint64_t bit_cycles(const struct bus *b)
{
    uint64_t clocks = b->ccr & 0xFFF, factor = !(b->ccr & 0x8000) ? 2 : b->ccr & 0x4000 ? 25 : 3;
    return 4 * factor * (clocks ? clocks : 1); /* APB1 runs at a quarter of the core's clock */
}

static void act(struct machine *m, unsigned n, uint32_t action, unsigned bits)
{
    m->bus[n].action = action;
    plan(m, DUE_BUS + n, action ? m->now + bits * bit_cycles(&m->bus[n]) : NEVER);
}

static struct device *device_at(struct machine *m, unsigned n, uint32_t address)
{
    for (unsigned i = 0; i < m->devices; i++)
        if (m->device[i].bus == n && m->device[i].address == address)
            return &m->device[i];
    return 0;
}

void device_write(struct device *d, uint8_t byte)
{
    if (d->left) {
        d->pointer = (d->left == d->address_bytes ? 0 : d->pointer << 8) | byte;
        d->left--;
    } else {
        d->memory[d->pointer % d->size] = byte;
        d->pointer++;
        d->writes++;
        d->wrote = 1;
        d->left = d->pairs ? d->address_bytes : 0;
    }
}

void device_begin(struct device *d, int reading)
{
    if (!reading) {
        d->left = d->address_bytes;
        return;
    }
    for (uint32_t i = 0; i < sizeof d->burst && i < d->size; i++) /* one read sees one sample */
        d->burst[i] = d->memory[(d->pointer + i) % d->size];
    d->left = 0;
}

uint8_t device_read(struct device *d)
{
    uint8_t byte = d->left < sizeof d->burst ? d->burst[d->left % d->size] : d->memory[d->pointer % d->size];
    d->left++;
    d->pointer++;
    return byte;
}

/* A transfer is over: what was written acts. */
void device_end(struct machine *m, struct device *d)
{
    if (d && d->watched && d->wrote) {
        m->touched |= 1u << (d - m->device);
        m->stop_reason |= STOP_DEVICE;
        d->wrote = 0;
    }
}

static void stopped(struct machine *m, struct bus *b)
{
    device_end(m, b->device);
    b->cr1 &= ~(uint32_t)STOP;
    b->sr1 &= ~(uint32_t)(SB | ADDR | BTF | TXE);
    b->sr2 = 0;
    b->holding = 0;
    b->device = 0;
}

static void receive(struct machine *m, unsigned n)
{
    act(m, n, RECEIVING, 9);
}

static void byte_received(struct machine *m, unsigned n)
{
    struct bus *b = &m->bus[n];
    uint8_t byte = b->device ? device_read(b->device) : 0xFF;
    int last = 0, more = (b->cr1 & ACK) != 0;
    act(m, n, NOTHING, 0);
    if (b->cr2 & DMAEN && dma_put(m, BASE[n] + 0x10, byte, &last)) {
        if (!(last && b->cr2 & LAST) && more)
            receive(m, n);
    } else if (b->sr1 & RXNE) { /* the clock is held low until the register is read */
        b->shift = byte;
        b->sr1 |= BTF;
    } else {
        b->dr = byte;
        b->sr1 |= RXNE;
        if (more)
            receive(m, n);
    }
}

static void addressed(struct machine *m, unsigned n)
{
    struct bus *b = &m->bus[n];
    act(m, n, NOTHING, 0);
    b->device = device_at(m, n, b->shift >> 1);
    if (!b->device) {
        b->sr1 |= AF;
        return;
    }
    int reading = b->shift & 1;
    device_begin(b->device, reading);
    b->sr1 |= ADDR;
    b->sr2 = MSL | BUSY | (reading ? 0 : TRA);
}

void bus_due(struct machine *m, unsigned n)
{
    struct bus *b = &m->bus[n];
    switch (b->action) {
    case STARTING:
        act(m, n, NOTHING, 0);
        device_end(m, b->device);
        b->cr1 &= ~(uint32_t)START;
        b->sr1 = (b->sr1 & ~(uint32_t)(BTF | TXE | RXNE | ADDR)) | SB;
        b->sr2 = MSL | BUSY;
        b->holding = 0;
        break;
    case ADDRESSING: addressed(m, n); break;
    case SENDING:
        act(m, n, NOTHING, 0);
        if (b->device)
            device_write(b->device, (uint8_t)b->shift);
        if (b->holding) {
            b->shift = b->dr;
            b->holding = 0;
            act(m, n, SENDING, 9);
        } else {
            b->sr1 |= BTF;
        }
        b->sr1 |= TXE;
        break;
    case RECEIVING: byte_received(m, n); break;
    case STOPPING:
        stopped(m, b);
        act(m, n, b->cr1 & START ? STARTING : NOTHING, 2);
        break;
    default: break;
    }
    update_lines(m, n);
}

uint32_t bus_read(struct machine *m, unsigned n, uint32_t offset)
{
    struct bus *b = &m->bus[n];
    uint32_t value = b->registers[offset / 4 % 10];
    if (offset == 0x10) {
        if (b->sr1 & BTF && !(b->sr2 & TRA)) {
            b->dr = b->shift;
            b->sr1 &= ~(uint32_t)BTF;
            if (b->cr1 & ACK)
                receive(m, n);
        } else {
            b->sr1 &= ~(uint32_t)RXNE;
        }
        update_lines(m, n);
    } else if (offset == 0x18 && b->sr1 & ADDR) {
        b->sr1 &= ~(uint32_t)ADDR;
        if (b->sr2 & TRA)
            b->sr1 |= TXE;
        else
            receive(m, n);
        update_lines(m, n);
    }
    return value;
}

static void write_control(struct machine *m, unsigned n, uint32_t value)
{
    struct bus *b = &m->bus[n];
    if (value & SWRST) {
        memset(b, 0, sizeof *b);
        act(m, n, NOTHING, 0);
        b->cr1 = SWRST;
        return;
    }
    uint32_t stopping = b->action == STOPPING;
    b->cr1 = value;
    if (!(value & PE)) {
        stopped(m, b);
        b->sr1 = 0;
        act(m, n, NOTHING, 0);
    } else if (stopping) {
        b->cr1 |= STOP; /* it is in progress, and a start waits for it */
    } else if (value & STOP) {
        act(m, n, STOPPING, 1);
    } else if (value & START && b->action != STARTING) {
        act(m, n, STARTING, 1);
    }
}

static void write_data(struct machine *m, unsigned n, uint32_t value)
{
    struct bus *b = &m->bus[n];
    if (b->sr1 & SB) {
        b->sr1 &= ~(uint32_t)SB;
        b->shift = value & 0xFF;
        act(m, n, ADDRESSING, 9);
    } else if (b->sr2 & TRA) {
        b->sr1 &= ~(uint32_t)BTF;
        if (b->action == SENDING) {
            b->dr = value & 0xFF;
            b->holding = 1;
            b->sr1 &= ~(uint32_t)TXE;
        } else {
            b->shift = value & 0xFF;
            act(m, n, SENDING, 9);
        }
    }
}

void bus_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value)
{
    struct bus *b = &m->bus[n];
    switch (offset) {
    case 0x00: write_control(m, n, value & 0xFFFF); break;
    case 0x10: write_data(m, n, value); break;
    case 0x14: b->sr1 &= ~(uint32_t)ERRORS | value; break;
    case 0x18: break; /* read only */
    default: b->registers[offset / 4 % 10] = value & 0xFFFF;
    }
    update_lines(m, n);
}
