/* The two DMA controllers (chapter 10) in direct mode: a peripheral asks, one item of PSIZE moves at once. */
#include "machine.h"

#include <string.h>

enum { ENABLE = 1, TRANSFER_ERROR_IE = 4, COMPLETE_IE = 16, TO_PERIPHERAL = 64, CIRCULAR = 256, INCREMENT = 1024 };
enum { FIRST_STREAM = 0x10, STREAM_SIZE = 0x18 };

static const uint8_t STREAM_IRQ[DMAS][STREAMS] = {{11, 12, 13, 14, 15, 16, 17, 47}, {56, 57, 58, 59, 60, 68, 69, 70}};
static const uint8_t FLAGS_AT[4] = {0, 6, 16, 22};

static void update_line(struct machine *m, unsigned n, unsigned s)
{
    struct dma *dma = &m->dma[n];
    uint32_t flags = dma->flags[s / 4] >> FLAGS_AT[s & 3], cr = dma->stream[s].cr;
    set_line(m, STREAM_IRQ[n][s], (flags & 32 && cr & COMPLETE_IE) || (flags & 8 && cr & TRANSFER_ERROR_IE));
}

static void raise_flag(struct machine *m, unsigned n, unsigned s, uint32_t flag)
{
    m->dma[n].flags[s / 4] |= flag << FLAGS_AT[s & 3];
    update_line(m, n, s);
}

static uint8_t *ram_at(struct machine *m, uint32_t address, uint32_t size) /* it cannot reach the CCM, chapter 2.3.1 */
{
    return address - RAM_BASE <= RAM_SIZE - size ? m->ram + (address - RAM_BASE) : 0;
}

/* Move one item between a peripheral's data register and memory; return 0 without a stream for it. `last`: the last one. */
static int move(struct machine *m, uint32_t peripheral, uint32_t direction, uint32_t *item, int *last)
{
    for (unsigned n = 0; n < DMAS; n++)
        for (unsigned s = 0; s < STREAMS; s++) {
            struct stream *stream = &m->dma[n].stream[s];
            if (!(stream->cr & ENABLE) || stream->par != peripheral || (stream->cr & 0xC0) != direction)
                continue;
            uint32_t address = stream->m0ar + (stream->cr & INCREMENT ? stream->place : 0);
            uint32_t power = stream->cr >> 11 & 3, size = power < 2 ? power + 1 : 4; /* PSIZE */
            uint8_t *memory = ram_at(m, address, size);
            if (!memory && direction == TO_PERIPHERAL && address - FLASH_BASE <= FLASH_SIZE - size)
                memory = m->flash + (address - FLASH_BASE);
            if (!memory) {
                stream->cr &= ~(uint32_t)ENABLE;
                raise_flag(m, n, s, 8);
                return 0;
            }
            if (direction)
                memcpy(item, memory, size);
            else
                memcpy(memory, item, size);
            stream->place += size;
            stream->ndtr--;
            *last = !stream->ndtr;
            if (*last) {
                if (stream->cr & CIRCULAR) {
                    stream->ndtr = stream->initial;
                    stream->place = 0;
                } else {
                    stream->cr &= ~(uint32_t)ENABLE;
                }
                raise_flag(m, n, s, 32);
            }
            return 1;
        }
    return 0;
}

int dma_put(struct machine *m, uint32_t peripheral, uint32_t item, int *last)
{
    return move(m, peripheral, 0, &item, last);
}

int dma_take(struct machine *m, uint32_t peripheral, uint32_t *item)
{
    int last;
    *item = 0;
    return move(m, peripheral, TO_PERIPHERAL, item, &last);
}

uint32_t dma_read(struct machine *m, unsigned n, uint32_t offset)
{
    struct dma *dma = &m->dma[n];
    if (offset < FIRST_STREAM)
        return offset < 8 ? dma->flags[offset / 4] : 0;
    struct stream *stream = &dma->stream[(offset - FIRST_STREAM) / STREAM_SIZE & 7];
    const uint32_t registers[6] = {stream->cr, stream->ndtr, stream->par, stream->m0ar, stream->m1ar, stream->fcr};
    return registers[(offset - FIRST_STREAM) % STREAM_SIZE / 4];
}

void dma_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value)
{
    struct dma *dma = &m->dma[n];
    if (offset < FIRST_STREAM) {
        if (offset >= 8)
            dma->flags[(offset - 8) / 4] &= ~value;
        for (unsigned s = 0; s < STREAMS; s++)
            update_line(m, n, s);
        return;
    }
    unsigned s = (offset - FIRST_STREAM) / STREAM_SIZE & 7;
    struct stream *stream = &dma->stream[s];
    uint32_t was = stream->cr, *const plain[] = {&stream->par, &stream->m0ar, &stream->m1ar, &stream->fcr};
    switch ((offset - FIRST_STREAM) % STREAM_SIZE) {
    case 0x00:
        stream->cr = value;
        if (value & ENABLE && !(was & ENABLE)) {
            stream->initial = stream->ndtr;
            stream->place = 0;
            if (!stream->ndtr)
                stream->cr &= ~(uint32_t)ENABLE;
            usart_kick(m);
            spi_kick(m);
        } else if (was & ENABLE && !(value & ENABLE)) {
            raise_flag(m, n, s, 32); /* software has ended it: complete as well, chapter 10.3.14 */
        }
        update_line(m, n, s);
        break;
    case 0x04: /* read-only while a transfer is under way, chapter 10.5.6; Bitcraze's I2C driver writes it before one has begun */
        if (!(was & ENABLE && stream->place))
            stream->ndtr = value & 0xFFFF;
        break;
    default: *plain[(offset - FIRST_STREAM) % STREAM_SIZE / 4 - 2] = value;
    }
}
