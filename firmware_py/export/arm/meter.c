/* Counts what an emulated Cortex-M4 executes: called by unicorn at the start of every basic block, on this machine.

Instructions and cycles of a block come from prefix sums over the image, one entry per half word. A block that does not
follow the last one was jumped to: the pipeline is refilled. Flash is read in lines of 16 bytes through a cache of 64
lines, least recently used first out (STM32F405, RM0090 chapter 3); every miss waits, as if nothing were prefetched. */
#include <stdint.h>

enum { CACHE_LINES = 64, FLASH_LINES = 65536, END = FLASH_LINES, REFILL = 3, WAIT_STATES = 5 };

struct line {
    uint32_t newer, older; /* neighbours in the order of their last use; END on both sides of all lines */
    uint32_t cached;
};

struct meter {
    const uint32_t *instructions_before; /* of every half word of the image */
    const uint32_t *cycles_before;
    uint64_t flash; /* address of the image */
    uint64_t next;  /* where the last block ended */
    uint64_t instructions;
    uint64_t cycles;
    uint64_t filled;
    struct line lines[FLASH_LINES + 1];
};

uint64_t meter_size(void)
{
    return sizeof(struct meter);
}

void meter_start(struct meter *meter)
{
    for (uint32_t i = meter->lines[END].newer; meter->lines[i].cached; i = meter->lines[i].newer)
        meter->lines[i].cached = 0;
    meter->next = meter->instructions = meter->cycles = meter->filled = 0;
    meter->lines[END].newer = meter->lines[END].older = END;
}

static void read_line(struct meter *meter, uint32_t number)
{
    struct line *lines = meter->lines, *line = &lines[number], *end = &lines[END];
    if (end->older == number) /* the line that was used last */
        return;
    if (!line->cached) {
        meter->cycles += WAIT_STATES;
        if (meter->filled < CACHE_LINES) {
            meter->filled++;
        } else {
            struct line *oldest = &lines[end->newer];
            oldest->cached = 0;
            lines[oldest->newer].older = END;
            end->newer = oldest->newer;
        }
        line->cached = 1;
    } else {
        lines[line->newer].older = line->older;
        lines[line->older].newer = line->newer;
    }
    line->newer = END;
    line->older = end->older;
    lines[end->older].newer = number;
    end->older = number;
}

void meter_block(void *engine, uint64_t address, uint32_t size, void *user)
{
    struct meter *meter = user;
    uint64_t begin = address - meter->flash, end = begin + size;
    meter->instructions += meter->instructions_before[end / 2] - meter->instructions_before[begin / 2];
    meter->cycles += meter->cycles_before[end / 2] - meter->cycles_before[begin / 2];
    if (address != meter->next)
        meter->cycles += REFILL;
    meter->next = address + size;
    for (uint64_t line = begin / 16; line * 16 < end; line++)
        read_line(meter, (uint32_t)line);
}
