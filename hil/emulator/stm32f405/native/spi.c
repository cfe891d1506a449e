/* The SPI controllers as masters (chapter 28), 8 bits: a byte takes its time and returns another one, by interrupt or DMA.

A device is memory that a pin of the chip selects. The first byte of a transfer is an address; with its highest bit set, what
follows is written there. */
#include "machine.h"

enum { RXNE = 1, TXE = 2, OVR = 64, BSY = 128 };
enum { SPE = 1 << 6, RXDMAEN = 1, TXDMAEN = 2, ERRIE = 1 << 5, RXNEIE = 1 << 6, TXEIE = 1 << 7 };
enum { DESELECTED, SELECTED, ADDRESSED };
enum { CR1 = 0x00, SR = 0x08, DR = 0x0C, WRITE = 0x80 };

static const uint32_t BASE[SPIS] = {0x40013000, 0x40003800, 0x40003C00};
static const uint8_t SPI_IRQ[SPIS] = {35, 36, 51};

static void update_line(struct machine *m, unsigned n)
{
    struct spi *s = &m->spi[n];
    set_line(m, SPI_IRQ[n], (s->cr2 & RXNEIE && s->sr & RXNE) || (s->cr2 & TXEIE && s->sr & TXE) || (s->cr2 & ERRIE && s->sr & OVR));
}

/* A port has other levels: select what is low now. */
void spi_select(struct machine *m, unsigned port, uint32_t levels)
{
    for (unsigned i = 0; i < m->devices; i++) {
        struct device *d = &m->device[i];
        uint32_t low = !(levels >> (d->address & 15) & 1);
        if (d->bus < BUSES || d->address >> 4 != port || low == (d->selected != DESELECTED))
            continue;
        d->selected = low ? SELECTED : DESELECTED;
        if (low)
            device_begin(d, 0);
        else
            device_end(m, d);
    }
}

static uint8_t exchange(struct machine *m, unsigned n, uint8_t byte)
{
    for (unsigned i = 0; i < m->devices; i++) {
        struct device *d = &m->device[i];
        if (d->bus != BUSES + n || d->selected == DESELECTED)
            continue;
        if (d->selected == SELECTED) {
            d->selected = ADDRESSED;
            d->first = byte;
            d->reading = !(byte & WRITE);
            device_write(d, byte & ~WRITE);
            if (d->reading)
                device_begin(d, 1);
            d->wrote = 1; /* that it was read may act as well */
            return 0;
        }
        if (d->reading)
            return device_read(d);
        device_write(d, byte);
        return 0;
    }
    return 0xFF;
}

static void shift_out(struct machine *m, unsigned n, uint32_t byte)
{
    struct spi *s = &m->spi[n];
    uint64_t clock = n ? 4 : 2; /* core cycles per cycle of APB1 and APB2 */
    s->shift = byte;
    s->busy = 1;
    plan(m, DUE_SPI + n, m->now + 8 * clock * (2u << (s->cr1 >> 3 & 7)));
}

static void write_data(struct machine *m, unsigned n, uint32_t byte)
{
    struct spi *s = &m->spi[n];
    if (!s->busy && s->cr1 & SPE) {
        shift_out(m, n, byte);
    } else {
        s->held = byte;
        s->sr &= ~(uint32_t)TXE;
    }
}

/* Let DMA fill whatever is empty. */
void spi_kick(struct machine *m)
{
    for (unsigned n = 0; n < SPIS; n++) {
        struct spi *s = &m->spi[n];
        uint32_t byte;
        while (s->cr1 & SPE && s->cr2 & TXDMAEN && s->sr & TXE && dma_take(m, BASE[n] + DR, &byte))
            write_data(m, n, byte);
        update_line(m, n);
    }
}

void spi_due(struct machine *m, unsigned n)
{
    struct spi *s = &m->spi[n];
    uint8_t byte = exchange(m, n, (uint8_t)s->shift);
    int last;
    s->busy = 0;
    plan(m, DUE_SPI + n, NEVER);
    if (!(s->cr2 & RXDMAEN) || !dma_put(m, BASE[n] + DR, byte, &last)) {
        if (s->sr & RXNE)
            s->sr |= OVR;
        else
            s->dr = byte;
        s->sr |= RXNE;
    }
    if (!(s->sr & TXE) && s->cr1 & SPE) {
        s->sr |= TXE;
        shift_out(m, n, s->held);
    }
    spi_kick(m);
}

uint32_t spi_read(struct machine *m, unsigned n, uint32_t offset)
{
    struct spi *s = &m->spi[n];
    if (offset == DR) {
        s->sr &= ~(uint32_t)(RXNE | OVR);
        update_line(m, n);
    }
    return s->registers[offset / 4 % 10] | (offset == SR && s->busy ? BSY : 0);
}

void spi_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value)
{
    struct spi *s = &m->spi[n];
    if (offset == DR)
        write_data(m, n, value & 0xFF);
    else if (offset != SR)
        s->registers[offset / 4 % 10] = value & 0xFFFF;
    if (offset == CR1 && s->cr1 & SPE && !s->busy && !(s->sr & TXE)) { /* it was written before the start */
        s->sr |= TXE;
        shift_out(m, n, s->held);
    }
    spi_kick(m);
}
