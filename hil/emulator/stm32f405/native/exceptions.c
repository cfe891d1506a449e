/* Exceptions of the Cortex-M4: NVIC, SysTick, system control block, entry and return with and without floats (B1.5, B3.2).

Unicorn has the exception number, handler mode and its stack; everything else is here. Floats are stacked at once; the chip
would only reserve their space. */
#include "machine.h"

enum { SPSEL = 2, FPCA = 4, ENTRY_CYCLES = 12, RETURN_CYCLES = 10, ALIGNED = 1 << 9 };
enum { NONBASETHRDENA = 1, STKALIGN = 1 << 9 }; /* bits of CCR, B3.2.8 */
enum { USE_PSP = 4, NO_FLOATS = 16, TO_THREAD = 8 }; /* bits of EXC_RETURN */
enum { VECTTBL = 1 << 1, FORCED = 1 << 30 };
enum { COUNTFLAG = 1 << 16 }; /* of SysTick */
#define UNUSED 0xA5A5A5A5u /* what FreeRTOS fills a stack with */

uint32_t get_register(struct machine *m, int number)
{
    uint32_t value = 0;
    m->engine.reg_read(m->engine.uc, number, &value);
    return value;
}

void set_register(struct machine *m, int number, uint32_t value)
{
    m->engine.reg_write(m->engine.uc, number, &value);
}

/* Writing XPSR changes the exception number; unicorn enters or leaves handler mode only when its flags are written. */
void set_xpsr(struct machine *m, uint32_t value)
{
    set_register(m, R_XPSR, value);
    set_register(m, R_FLAGS, value);
}

/* Registers by their numbers in an instruction. */
static int named(unsigned number)
{
    return number == 13 ? R_SP : number == 14 ? R_LR : number == 15 ? R_PC : R_R0 + (int)number;
}

uint32_t get_core_register(struct machine *m, unsigned number)
{
    return get_register(m, named(number));
}

void set_core_register(struct machine *m, unsigned number, uint32_t value)
{
    set_register(m, named(number), value);
}

/* Return the bytes at an address, 0 where there is no memory. */
uint8_t *memory_at(struct machine *m, uint32_t address, uint32_t size)
{
    if (address - RAM_BASE <= RAM_SIZE - size)
        return m->ram + (address - RAM_BASE);
    if (address - CCM_BASE <= CCM_SIZE - size)
        return m->ccm + (address - CCM_BASE);
    if (address - FLASH_BASE <= FLASH_SIZE - size)
        return m->flash + (address - FLASH_BASE);
    return address <= FLASH_SIZE - size ? m->flash + address : 0;
}

static uint32_t *word(struct machine *m, uint32_t address)
{
    return (uint32_t *)(void *)memory_at(m, address, 4);
}

/* The running task has written below its stack: record it. */
void note_overflow(struct machine *m)
{
    if (m->overflow)
        return;
    m->overflow = m->task[m->running].block;
    m->stop_reason |= STOP_OVERFLOW;
}

static void look(struct machine *m)
{
    m->attention = (m->pending[0] & m->enabled[0]) || (m->pending[1] & m->enabled[1]);
}

void set_pending(struct machine *m, unsigned exception)
{
    m->pending[exception >> 6] |= 1ull << (exception & 63);
    look(m);
}

void set_line(struct machine *m, unsigned irq, int high)
{
    unsigned exception = irq + IRQ;
    uint64_t bit = 1ull << (exception & 63), *line = &m->line[exception >> 6];
    if (!high) {
        *line &= ~bit;
    } else if (!(*line & bit)) {
        *line |= bit;
        set_pending(m, exception);
    }
}

/* Group priority of an exception: lower is more urgent (B1.5.4). */
static int group(struct machine *m, int priority)
{
    unsigned bits = (m->aircr >> 8 & 7) + 1;
    return priority >> bits << bits;
}

static int urgency(struct machine *m, unsigned exception)
{
    if (exception <= HARD_FAULT)
        return (int)exception - 4;
    return m->priority[exception];
}

static int running_urgency(struct machine *m)
{
    int least = 256;
    for (unsigned half = 0; half < 2; half++)
        for (uint64_t bits = m->active[half]; bits; bits &= bits - 1) {
            int own = urgency(m, half * 64 + (unsigned)__builtin_ctzll(bits));
            own = own < 0 ? own : group(m, own);
            if (own < least)
                least = own;
        }
    return least;
}

/* Priority of what runs now (B1.5.4); `waking`: as for WFI, which ignores PRIMASK (B1.5.17). */
static int execution_priority(struct machine *m, int waking)
{
    int least = running_urgency(m), base = m->basepri ? group(m, (int)m->basepri) : 256;
    if (base < least)
        least = base;
    if (!waking && least > 0 && get_register(m, R_PRIMASK) & 1)
        least = 0;
    if (!waking && least > -1 && m->faultmask)
        least = -1;
    return least;
}

/* Return the exception to enter now, 0 if none. */
unsigned next_exception(struct machine *m, int waking)
{
    unsigned best = 0;
    int best_urgency = 257;
    for (unsigned half = 0; half < 2; half++)
        for (uint64_t bits = m->pending[half] & m->enabled[half]; bits; bits &= bits - 1) {
            unsigned exception = half * 64 + (unsigned)__builtin_ctzll(bits);
            if (urgency(m, exception) < best_urgency) {
                best = exception;
                best_urgency = urgency(m, exception);
            }
        }
    if (!best)
        return 0;
    int own = best_urgency < 0 ? best_urgency : group(m, best_urgency);
    return own < execution_priority(m, waking) ? best : 0;
}

static void lock_up(struct machine *m, uint32_t pc)
{
    m->stop_reason |= STOP_LOCKUP;
    m->locked = 1;
    m->pc = pc;
    m->stopping = 1;
    m->engine.emu_stop(m->engine.uc);
}

void enter(struct machine *m, unsigned exception, uint32_t return_address)
{
    uint32_t control = get_register(m, R_CONTROL), xpsr = get_register(m, R_XPSR);
    int handler = xpsr & 0x1FF, process = !handler && control & SPSEL, floats = control & FPCA;
    int stack = process ? R_PSP : R_MSP;
    uint32_t sp = get_register(m, stack), padding = floats || m->ccr & STKALIGN ? sp & 4 : 0, frame = sp - padding - (floats ? 0x68 : 0x20);
    uint32_t *place = word(m, frame), *end = word(m, frame + (floats ? 0x64 : 0x1C));
    if (process && m->canary && *word(m, m->stack_begin) != UNUSED) /* it overflowed, and may have returned since */
        note_overflow(m);
    if (!place || !end) {
        if (exception == HARD_FAULT) {
            lock_up(m, return_address);
            return;
        }
        m->cfsr |= 1 << 12; /* STKERR */
        m->hfsr |= FORCED;
        exception = HARD_FAULT;
        place = 0;
    }
    if (place) {
        for (int i = 0; i < 4; i++)
            place[i] = get_register(m, R_R0 + i);
        place[4] = get_register(m, R_R12);
        place[5] = get_register(m, R_LR);
        place[6] = return_address & ~1u;
        place[7] = (xpsr & ~(uint32_t)ALIGNED) | (padding ? ALIGNED : 0);
        if (floats) {
            for (int i = 0; i < 8; i++)
                m->engine.reg_read(m->engine.uc, R_D0 + i, &place[8 + 2 * i]);
            place[24] = get_register(m, R_FPSCR);
        }
        set_register(m, stack, frame);
    }
    uint32_t exc_return = 0xFFFFFFE1 | (handler ? 0 : TO_THREAD) | (process ? USE_PSP : 0) | (floats ? 0 : NO_FLOATS);
    set_register(m, R_CONTROL, control & ~(uint32_t)(SPSEL | FPCA));
    set_xpsr(m, (xpsr & 0xF80F0000) | THUMB | exception);
    set_register(m, R_LR, exc_return);
    if (process)
        m->task_return = exc_return;
    m->pending[exception >> 6] &= ~(1ull << (exception & 63));
    m->active[exception >> 6] |= 1ull << (exception & 63);
    look(m);
    m->exceptions++;
    if (m->profile)
        profile_enter(m, exception);
    m->now += ENTRY_CYCLES;
    uint32_t *vector = word(m, m->vtor + 4 * exception);
    if (!vector) { /* nor is there one for the HardFault that follows */
        m->hfsr |= VECTTBL;
        lock_up(m, return_address);
        return;
    }
    m->pc = *vector & ~1u;
    set_register(m, R_PC, *vector);
}

/* Whether a task is not ready. */
static int waits(struct machine *m, uint32_t block)
{
    uint32_t *list = word(m, block + m->kernel.container_offset);
    return !list || *list - m->kernel.ready_begin >= m->kernel.ready_end - m->kernel.ready_begin;
}

static void look_at_stack(struct machine *m, uint32_t block)
{
    uint32_t *begin = word(m, block + m->kernel.stack_offset), *last = begin ? word(m, *begin) : 0;
    m->stack_begin = last ? *begin : 0;
    m->canary = last && *last == UNUSED;
}

/* Check for another task of the scheduler. */
static void look_at_task(struct machine *m)
{
    uint32_t *current = word(m, m->kernel.current_place), i = 0;
    if (!current)
        return;
    if (!m->stack_begin)
        look_at_stack(m, *current);
    if (m->task_count && m->task[m->running].block == *current)
        return;
    if (m->task_count) {
        m->task[m->running].cycles += m->now - m->running_since;
        m->task[m->running].ran = m->now;
        if (waits(m, m->task[m->running].block)) {
            m->task[m->running].busy_since = 0;
            if (m->profile)
                end_activation(m);
        }
    }
    look_at_stack(m, *current);
    m->running_since = m->now;
    while (i < m->task_count && m->task[i].block != *current)
        i++;
    if (i == TASKS)
        i--; /* all without room count as one */
    else if (i == m->task_count)
        m->task[m->task_count++].block = *current;
    m->task[i].times++;
    if (!m->task[i].busy_since)
        m->task[i].busy_since = m->now;
    m->running = i;
    if (m->tracing && m->switch_count < SWITCHES)
        m->task_switch[m->switch_count++] = (struct task_switch){.now = m->now, .block = *current};
}

/* Whether an exception may return so (ExceptionReturn, B1.5.8); `others`: more exceptions are active. */
static int may_return(struct machine *m, uint32_t exc_return, unsigned exception, int others)
{
    if (!(m->active[exception >> 6] >> (exception & 63) & 1) || (exc_return & 0x0FFFFFE0) != 0x0FFFFFE0)
        return 0;
    switch (exc_return & 15) {
    case 1: return others;
    case 9: case 13: return !others || m->ccr & NONBASETHRDENA;
    default: return 0;
    }
}

void leave(struct machine *m, uint32_t exc_return)
{
    unsigned exception = get_register(m, R_XPSR) & 0x1FF;
    int active = __builtin_popcountll(m->active[0]) + __builtin_popcountll(m->active[1]);
    int valid = may_return(m, exc_return, exception, active > 1);
    uint32_t control = get_register(m, R_CONTROL);
    int process = exc_return & USE_PSP, floats = !(exc_return & NO_FLOATS), stack = process ? R_PSP : R_MSP;
    if (m->profile)
        profile_leave(m, m->now + RETURN_CYCLES);
    m->active[exception >> 6] &= ~(1ull << (exception & 63));
    m->faultmask = 0;
    if (m->line[exception >> 6] >> (exception & 63) & 1)
        set_pending(m, exception);
    if (!valid) {
        raise_fault(m, USAGE_FAULT, INVPC, exc_return);
        return;
    }
    uint32_t frame = get_register(m, stack), *place = word(m, frame), *end = word(m, frame + (floats ? 0x64 : 0x1C));
    if (!place || !end) {
        raise_fault(m, BUS_FAULT, 1 << 11, exc_return); /* UNSTKERR */
        return;
    }
    if (!(exc_return & TO_THREAD) != !!(place[7] & 0x1FF)) {
        raise_fault(m, USAGE_FAULT, INVPC, exc_return);
        return;
    }
    uint32_t saved[8];
    for (int i = 0; i < 8; i++)
        saved[i] = place[i];
    for (int i = 0; i < 4; i++)
        set_register(m, R_R0 + i, saved[i]);
    set_register(m, R_R12, saved[4]);
    set_register(m, R_LR, saved[5]);
    if (floats) {
        for (int i = 0; i < 8; i++)
            m->engine.reg_write(m->engine.uc, R_D0 + i, &place[8 + 2 * i]);
        set_register(m, R_FPSCR, place[24]);
    }
    set_register(m, stack, frame + (floats ? 0x68 : 0x20) + (saved[7] & ALIGNED ? 4 : 0));
    uint32_t number = exc_return & TO_THREAD ? 0 : saved[7] & 0x1FF;
    set_xpsr(m, (saved[7] & ~0x3FFu) | THUMB | number);
    set_register(m, R_CONTROL, (control & 1) | (!number && process ? SPSEL : 0) | (floats ? FPCA : 0));
    m->now += RETURN_CYCLES;
    m->pc = saved[6];
    set_register(m, R_PC, m->pc | 1);
    if (!(saved[7] & THUMB)) {
        raise_fault(m, USAGE_FAULT, INVSTATE, m->pc);
        return;
    }
    if (m->kernel.current_place && (exception == PENDSV || exception == SVC))
        look_at_task(m);
    if (m->profile)
        profile_resume(m);
}

/* Enter the handler of a fault, or HardFault if it is disabled or already active (B1.5.14). */
void raise_fault(struct machine *m, unsigned exception, uint32_t status, uint32_t pc)
{
    m->cfsr |= status;
    m->masks = 0; /* the end of the block was not reached */
    cut_block(m, pc);
    int priority = execution_priority(m, 0);
    if (priority <= -1) {
        lock_up(m, pc);
        return;
    }
    int on = exception == HARD_FAULT || (exception != SVC && m->shcsr >> (12 + exception) & 1);
    if (exception != HARD_FAULT && (!on || group(m, urgency(m, exception)) >= priority)) {
        m->hfsr |= FORCED;
        exception = HARD_FAULT;
    }
    enter(m, exception, pc);
}

/* SVC, which becomes a HardFault where its own exception may not interrupt (B1.5.14). */
void call_supervisor(struct machine *m, uint32_t return_address)
{
    if (group(m, urgency(m, SVC)) < execution_priority(m, 0))
        enter(m, SVC, return_address);
    else
        raise_fault(m, SVC, 0, return_address);
}

static void start_tick(struct machine *m)
{
    uint64_t factor = m->tick_ctrl & 4 ? 1 : 8;
    m->tick_since = m->now;
    plan(m, DUE_SYSTICK, m->tick_ctrl & 1 && m->tick_load ? m->now + (m->tick_load + 1ull) * factor : NEVER);
}

static uint32_t tick_value(struct machine *m)
{
    uint64_t factor = m->tick_ctrl & 4 ? 1 : 8;
    return m->tick_ctrl & 1 ? m->tick_load - (uint32_t)((m->now - m->tick_since) / factor % (m->tick_load + 1ull)) : 0;
}

static uint32_t icsr(struct machine *m)
{
    uint32_t active = get_register(m, R_XPSR) & 0x1FF;
    return active | (m->pending[0] >> PENDSV & 1) << 28 | (m->pending[0] >> SYSTICK & 1) << 26;
}

static uint32_t bits_of(const uint64_t *set, uint32_t index)
{
    unsigned first = IRQ + 32 * index; /* 32 interrupts span two words of 64 exceptions */
    uint64_t low = first < 128 ? set[first >> 6] >> (first & 63) : 0;
    uint64_t high = (first & 63) > 32 && first >> 6 == 0 ? set[1] << (64 - (first & 63)) : 0;
    return (uint32_t)(low | high);
}

static void write_bits(struct machine *m, uint64_t *set, uint32_t index, uint32_t value, int high)
{
    for (uint32_t bits = value; bits; bits &= bits - 1) {
        unsigned exception = IRQ + 32 * index + (unsigned)__builtin_ctz(bits);
        if (exception >= EXCEPTIONS)
            break;
        uint64_t bit = 1ull << (exception & 63);
        set[exception >> 6] = high ? set[exception >> 6] | bit : set[exception >> 6] & ~bit;
    }
    look(m);
}

static uint32_t system_word(struct machine *m, uint32_t offset)
{
    uint32_t index = (offset & 0x7F) / 4;
    if (offset >= 0xE100 && offset < 0xE400)
        switch (offset & 0xF80) {
        case 0x100: case 0x180: return bits_of(m->enabled, index);
        case 0x200: case 0x280: return bits_of(m->pending, index);
        case 0x300: return bits_of(m->active, index);
        default: return 0;
        }
    switch (offset) {
    case 0x1000: return 1; /* DWT CTRL */
    case 0x1004: return (uint32_t)m->now; /* CYCCNT */
    case 0xE010: {
        uint32_t control = m->tick_ctrl;
        m->tick_ctrl &= ~(uint32_t)COUNTFLAG; /* by reading, B3.3.3 */
        return control;
    }
    case 0xE014: return m->tick_load;
    case 0xE018: return tick_value(m);
    case 0xED00: return 0x410FC241;
    case 0xED04: return icsr(m);
    case 0xED08: return m->vtor;
    case 0xED0C: return 0xFA050000 | m->aircr;
    case 0xED10: return m->scr;
    case 0xED14: return m->ccr;
    case 0xED24: return m->shcsr;
    case 0xED28: return m->cfsr;
    case 0xED2C: return m->hfsr;
    case 0xED38: return m->bfar;
    case 0xED88: return m->cpacr;
    case 0xEF34: return m->fpccr;
    case 0xEF40: return 0x10110021; /* MVFR0 */
    default: return 0;
    }
}

static uint8_t *priority_byte(struct machine *m, uint32_t offset)
{
    if (offset >= 0xE400 && offset < 0xE400 + EXCEPTIONS - IRQ)
        return &m->priority[IRQ + offset - 0xE400];
    if (offset >= 0xED18 && offset < 0xED24)
        return &m->priority[4 + offset - 0xED18];
    return 0;
}

uint64_t system_read(uc_engine *uc, uint64_t offset, unsigned size, void *user)
{
    struct machine *m = user;
    uint32_t at = (uint32_t)offset, value = 0;
    if (!priority_byte(m, at))
        return system_word(m, at & ~3u) >> 8 * (at & 3);
    for (unsigned i = 0; i < size; i++)
        value |= (uint32_t)*priority_byte(m, at + i) << 8 * i;
    return value;
}

static void write_icsr(struct machine *m, uint32_t value)
{
    if (value >> 28 & 1)
        set_pending(m, PENDSV);
    if (value >> 27 & 1)
        m->pending[0] &= ~(1ull << PENDSV);
    if (value >> 26 & 1)
        set_pending(m, SYSTICK);
    if (value >> 25 & 1)
        m->pending[0] &= ~(1ull << SYSTICK);
    look(m);
}

void system_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t given, void *user)
{
    struct machine *m = user;
    uint32_t at = (uint32_t)offset, value = (uint32_t)given, index = (at & 0x7F) / 4;
    if (priority_byte(m, at)) {
        for (unsigned i = 0; i < size && priority_byte(m, at + i); i++)
            *priority_byte(m, at + i) = (uint8_t)(value >> 8 * i) & 0xF0; /* four bits exist, chapter 12.2 */
        return;
    }
    if (at >= 0xE100 && at < 0xE300) {
        write_bits(m, at < 0xE200 ? m->enabled : m->pending, index, value, !(at & 0x80));
        for (unsigned irq = 0; at >= 0xE280 && irq < 32; irq++) /* a continuing request is pending again */
            if (value >> irq & 1 && 32 * index + irq < EXCEPTIONS - IRQ) {
                unsigned exception = IRQ + 32 * index + irq;
                if (m->line[exception >> 6] >> (exception & 63) & 1)
                    set_pending(m, exception);
            }
        return;
    }
    switch (at) {
    case 0xE010:
        m->tick_ctrl = (m->tick_ctrl & COUNTFLAG) | (value & 7);
        start_tick(m);
        break;
    case 0xE014: m->tick_load = value & 0xFFFFFF; break;
    case 0xE018: /* whatever is written, B3.3.5 */
        m->tick_ctrl &= ~(uint32_t)COUNTFLAG;
        start_tick(m);
        break;
    case 0xED04: write_icsr(m, value); break;
    case 0xED08: m->vtor = value & ~0x7Fu; break;
    case 0xED0C:
        if (value >> 16 != 0x5FA)
            break;
        m->aircr = value & 0x700;
        if (value & 4)
            m->stop_reason |= STOP_RESET;
        break;
    case 0xED10: m->scr = value; break;
    case 0xED14: m->ccr = value; break;
    case 0xED24: m->shcsr = value; break;
    case 0xED28: m->cfsr &= ~value; break;
    case 0xED2C: m->hfsr &= ~value; break;
    case 0xED88: m->cpacr = value; break;
    case 0xED94: /* MPU_CTRL */
        if (value & 1)
            note_unknown(m, 0xE000ED94);
        break;
    case 0xEF00: /* STIR */
        if ((value & 0x1FF) < EXCEPTIONS - IRQ)
            set_pending(m, IRQ + (value & 0x1FF));
        break;
    case 0xEF34: m->fpccr = value; break;
    default: break;
    }
}

void tick_due(struct machine *m)
{
    uint64_t factor = m->tick_ctrl & 4 ? 1 : 8;
    m->tick_since = m->due[DUE_SYSTICK];
    plan(m, DUE_SYSTICK, m->tick_since + (m->tick_load + 1ull) * factor);
    m->tick_ctrl |= COUNTFLAG;
    if (m->tick_ctrl & 2)
        set_pending(m, SYSTICK);
}
