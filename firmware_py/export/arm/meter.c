/* Counts what an emulated Cortex-M4 executes: called by unicorn at the start of every basic block, on this machine.

Instructions and cycles of a block come from prefix sums over the image, one entry per half word. A block that does not
follow the last one was jumped to: the pipeline is refilled. Flash is read in lines of 16 bytes through a cache of 64
lines, least recently used first out (STM32F405, RM0090 chapter 3); every miss waits, as if nothing were prefetched. */
#include <stdint.h>
#include <string.h>

enum { CACHE_LINES = 64, FLASH_LINES = 4096, REFILL = 3, WAIT_STATES = 5 };

struct meter {
    const uint32_t *instructions_before; /* of every half word of the image */
    const uint32_t *cycles_before;
    uint64_t flash; /* address of the image */
    uint64_t next;  /* where the last block ended */
    uint64_t instructions;
    uint64_t cycles;
    uint32_t time;
    uint32_t used[FLASH_LINES]; /* time of the last access to a line in the cache, 0: not in the cache */
    int32_t cached[CACHE_LINES];
    int32_t filled;
};

uint64_t meter_size(void)
{
    return sizeof(struct meter);
}

void meter_start(struct meter *meter)
{
    memset(&meter->next, 0, sizeof *meter - ((char *)&meter->next - (char *)meter));
}

static void read_line(struct meter *meter, int32_t line)
{
    meter->time++;
    if (meter->used[line] == 0) {
        int32_t place = 0;
        meter->cycles += WAIT_STATES;
        if (meter->filled < CACHE_LINES) {
            place = meter->filled++;
        } else {
            for (int32_t i = 1; i < CACHE_LINES; i++)
                if (meter->used[meter->cached[i]] < meter->used[meter->cached[place]])
                    place = i;
            meter->used[meter->cached[place]] = 0;
        }
        meter->cached[place] = line;
    }
    meter->used[line] = meter->time;
}

void meter_block(void *engine, uint64_t address, uint32_t size, void *user)
{
    struct meter *meter = user;
    uint64_t begin = address - meter->flash, end = begin + size;
    (void)engine;
    meter->instructions += meter->instructions_before[end / 2] - meter->instructions_before[begin / 2];
    meter->cycles += meter->cycles_before[end / 2] - meter->cycles_before[begin / 2];
    if (address != meter->next)
        meter->cycles += REFILL;
    meter->next = address + size;
    for (uint64_t line = begin / 16; line * 16 < end; line++)
        read_line(meter, (int32_t)line);
}
