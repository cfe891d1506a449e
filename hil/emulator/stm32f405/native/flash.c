/* The cache before the flash: 64 lines of 16 bytes, least recently used first out (STM32F405, RM0090 chapter 3). Every miss
   waits, as if nothing were prefetched. */
#include "machine.h"

enum { CACHE_LINES = 64, WAIT_STATES = 5, END = FLASH_LINES };

void flash_empty(struct machine *m)
{
    struct flash_line *lines = m->flash_cache->lines;
    for (uint32_t i = lines[END].newer; lines[i].cached; i = lines[i].newer)
        lines[i].cached = 0;
    lines[END].newer = lines[END].older = END;
    m->flash_cache->filled = 0;
    m->next_address = 0;
}

static void read_line(struct machine *m, uint32_t number)
{
    struct flash_line *lines = m->flash_cache->lines, *line = &lines[number], *end = &lines[END];
    if (end->older == number) /* the line that was used last */
        return;
    if (!line->cached) {
        m->now += WAIT_STATES;
        if (m->flash_cache->filled < CACHE_LINES) {
            m->flash_cache->filled++;
        } else {
            struct flash_line *oldest = &lines[end->newer];
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

void read_flash(struct machine *m, uint32_t begin, uint32_t end)
{
    for (uint32_t number = begin / FLASH_LINE; number * FLASH_LINE < end; number++)
        read_line(m, number);
}
