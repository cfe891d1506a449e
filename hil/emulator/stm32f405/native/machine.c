/* The whole machine: it runs code block by block, executes due events in between, and stops when the caller must act. */
#include "machine.h"

#include <stddef.h>
#include <string.h>

enum { HOOK_INTR = 1, HOOK_CODE = 4, HOOK_BLOCK = 8, HOOK_READ = 0x400, HOOK_WRITE = 0x800, HOOK_TLB = 0x20000, HOOK_INVALID = 0x3F0 /* accesses to unmapped memory */ };
enum { ACCESS_FETCH = 18, RIGHT_READ = 1, RIGHT_WRITE = 2, RIGHT_EXECUTE = 4, FLUSH_TLB = 11 | 1 << 30, FLUSH_CODE = 10 | 1 << 30 };
enum { TRAP_SVC = 2, TRAP_UNALIGNED = 4, TRAP_BREAKPOINT = 7, TRAP_RETURN = 8, TRAP_NO_FLOATS = 17, TRAP_STATE = 18 };
enum { REFILL = 3, NOWHERE = 0xFFFFFFFE };

struct page { /* uc_tlb_entry */
    uint64_t address;
    uint32_t rights;
};

static void look_ahead(struct machine *m)
{
    m->next_due = NEVER;
    for (unsigned slot = 0; slot < SLOTS; slot++)
        if (m->due[slot] < m->next_due)
            m->next_due = m->due[slot];
}

void plan(struct machine *m, unsigned slot, uint64_t due)
{
    uint64_t was = m->due[slot];
    m->due[slot] = due;
    if (due < m->next_due)
        m->next_due = due;
    else if (was == m->next_due)
        look_ahead(m);
}

static void happen(struct machine *m, unsigned slot)
{
    if (slot == DUE_SYSTICK) {
        tick_due(m);
    } else if (slot < DUE_BUS) {
        timer_due(m, slot - DUE_TIMER);
    } else if (slot < DUE_SPI) {
        bus_due(m, slot - DUE_BUS);
    } else if (slot < DUE_SEND) {
        spi_due(m, slot - DUE_SPI);
    } else if (slot < DUE_RECEIVE) {
        usart_send_due(m, slot - DUE_SEND);
    } else if (slot < DUE_WATCHDOG) {
        usart_receive_due(m, slot - DUE_RECEIVE);
    } else if (slot < DUE_ESC) {
        m->due[slot] = NEVER;
        m->stop_reason |= STOP_WATCHDOG;
    } else {
        esc_due(m, slot - DUE_ESC);
    }
}

static void let_happen(struct machine *m)
{
    while (m->next_due <= m->now) {
        for (unsigned slot = 0; slot < SLOTS; slot++)
            if (m->due[slot] == m->next_due) {
                happen(m, slot);
                break;
            }
        look_ahead(m);
    }
}

void stop(struct machine *m, uint32_t pc)
{
    m->pc = pc;
    m->stopping = 1;
    m->engine.emu_stop(m->engine.uc);
}

/* Record where the last block went on. */
static __attribute__((noinline)) void end_block(struct machine *m, uint64_t next)
{
    if (m->block_begin == m->block_end)
        return;
    struct passage *end = &m->passages[m->block_end / 2];
    if (next == m->block_end || next == FLASH_BASE + m->block_end)
        end->fell++;
    else
        end->jumped++;
    m->block_begin = m->block_end;
}

static __attribute__((noinline)) void begin_block(struct machine *m, uint32_t begin, uint32_t end)
{
    if (m->profile)
        profile_block(m, begin, end);
    if (m->passages) {
        m->passages[begin / 2].begun++;
        m->block_begin = begin;
        m->block_end = end;
    }
}

/* The instruction at `pc` has ended its block. */
void cut_block(struct machine *m, uint32_t pc)
{
    uint32_t at = pc < FLASH_SIZE ? pc : pc - FLASH_BASE;
    uint16_t first;
    if (at - m->block_begin >= m->block_end - m->block_begin)
        return;
    memcpy(&first, m->flash + at, sizeof first);
    m->block_end = at + (first >> 11 > 0x1C ? 4 : 2);
}

static void count(struct machine *m, uint64_t address, uint32_t size)
{
    uint64_t begin = address < FLASH_SIZE ? address : address - FLASH_BASE;
    if (begin + size <= FLASH_SIZE) {
        if (m->recorded)
            begin_block(m, (uint32_t)begin, (uint32_t)begin + size);
        if (m->flash_cache)
            read_flash(m, (uint32_t)begin, (uint32_t)begin + size);
        uint64_t passed = m->before[(begin + size) / 2] - m->before[begin / 2];
        m->now += passed & ((1u << SUM_INSTRUCTIONS) - 1);
        m->instructions += passed >> SUM_INSTRUCTIONS & ((1u << (SUM_MASKS - SUM_INSTRUCTIONS)) - 1);
        m->masks = passed >> SUM_MASKS & ((1u << (SUM_STACKERS - SUM_MASKS)) - 1);
        m->stacks = passed >> SUM_STACKERS != 0;
    } else { /* in RAM: as if all were narrow */
        m->instructions += size / 2;
        m->now += size / 2;
        m->stacks = m->masks = 1;
    }
    if (address != m->next_address)
        m->now += REFILL;
    m->next_address = address + size;
}

static int in_task(const struct machine *m)
{
    return !m->active[0] && !m->active[1];
}

/* In a task; exceptions have a separate stack. */
static void look_at_stack_pointer(struct machine *m)
{
    if (get_register(m, R_SP) < m->stack_begin)
        note_overflow(m);
}

static void on_block(uc_engine *uc, uint64_t address, uint32_t size, void *user)
{
    struct machine *m = user;
    uint32_t resumed = m->resume;
    m->resume = NOWHERE;
    int counted = resumed == (uint32_t)address; /* in the middle of a block, which was counted as a whole at its begin */
    if (m->masks && !counted)
        set_masks(m);
    if (m->recorded && !counted)
        end_block(m, address);
    if (m->stepping && m->stepping++ > 1) { /* the instruction was the last of its block, or was carried out here */
        m->resume = counted ? resumed : NOWHERE;
        stop(m, (uint32_t)address);
        return;
    }
    if (counted)
        return;
    if (m->stacks && m->stack_begin && !m->overflow && in_task(m))
        look_at_stack_pointer(m);
    if (m->next_due <= m->now)
        let_happen(m);
    if (m->now >= m->until || m->stop_reason) {
        if (!m->stepping) {
            stop(m, (uint32_t)address);
            return;
        }
    }
    if (m->attention) {
        unsigned exception = next_exception(m, 0);
        if (exception) {
            enter(m, exception, (uint32_t)address);
            return;
        }
    }
    m->earlier_at = m->begun_at;
    m->begun_at = m->now;
    m->begun = m->instructions;
    count(m, address, size);
}

static void on_trap(uc_engine *uc, uint32_t number, void *user)
{
    struct machine *m = user;
    uint32_t pc = get_register(m, R_PC);
    switch (number) {
    case TRAP_UNALIGNED: on_unaligned(m, pc); break;
    case TRAP_SVC: call_supervisor(m, pc); break;
    case TRAP_RETURN:
        leave(m, pc | 1);
        if (m->owed && in_task(m) && !m->stepping)
            stop(m, m->pc);
        break;
    case TRAP_BREAKPOINT: m->hfsr |= 1u << 31; raise_fault(m, HARD_FAULT, 0, pc); break;
    case TRAP_NO_FLOATS: raise_fault(m, USAGE_FAULT, NOCP, pc); break;
    case TRAP_STATE: raise_fault(m, USAGE_FAULT, INVSTATE, pc); break;
    default: raise_fault(m, USAGE_FAULT, UNDEFINSTR, pc); break;
    }
}

/* Before a hook of an access in an IT block, unicorn writes that instruction's condition into XPSR, and leaves it there:
it would then apply to the next block (github.com/unicorn-engine/unicorn/issues/2309). */
static void forget_condition(struct machine *m)
{
    uint32_t xpsr = get_register(m, R_XPSR);
    if (xpsr & IT_STATE)
        set_register(m, R_XPSR, xpsr & ~(uint32_t)IT_STATE);
}

static int on_invalid(uc_engine *uc, int type, uint64_t address, int size, int64_t value, void *user)
{
    struct machine *m = user;
    m->fault_address = (uint32_t)address;
    forget_condition(m);
    return 0;
}

/* Map a page for data only until code there is executed: unicorn watches pages with code and stores to them slowly. */
static int on_page(uc_engine *uc, uint64_t address, int type, struct page *page, void *user)
{
    struct machine *m = user;
    uint64_t place = address - RAM_BASE;
    int executed = type == ACCESS_FETCH;
    if (place < RAM_SIZE) {
        uint8_t *known = &m->executed[place / PAGE_SIZE];
        if (executed && !*known)
            m->engine.ctl(uc, FLUSH_TLB); /* forget the mapping for data only */
        executed = *known |= executed;
    }
    if (type != ACCESS_FETCH)
        forget_condition(m);
    page->address = address;
    page->rights = RIGHT_READ | RIGHT_WRITE | (executed ? RIGHT_EXECUTE : 0);
    return 1;
}

static void on_break(uc_engine *uc, uint64_t address, uint32_t size, void *user)
{
    struct machine *m = user;
    if (m->skip_at == (uint32_t)address) {
        m->skip_at = NOWHERE;
        return;
    }
    m->skip_at = m->resume = (uint32_t)address;
    m->stop_reason |= STOP_BREAK;
    stop(m, (uint32_t)address);
}

/* Sleep until an interrupt wakes the core, without leaving the engine: WFI runs ten thousand times a second. */
static void on_sleep(uc_engine *uc, uint64_t address, uint32_t size, void *user)
{
    struct machine *m = user;
    uint32_t after = (uint32_t)address + size;
    if (m->stepping)
        return;
    for (;;) {
        if (m->next_due <= m->now)
            let_happen(m);
        if (m->now >= m->until || m->stop_reason) {
            m->asleep = 1;
            stop(m, after);
            return;
        }
        if (next_exception(m, 1))
            break;
        uint64_t next = m->next_due < m->until ? m->next_due : m->until;
        m->sleeping += next - m->now;
        m->now = next;
    }
    unsigned exception = next_exception(m, 0);
    if (exception) {
        enter(m, exception, after);
    } else { /* masked: continue after the instruction */
        m->pc = after;
        set_register(m, R_PC, after | 1);
    }
}

/* A division by zero is a fault if the firmware wants it so, else its result is 0: stop before the first one. */
static void on_division(uc_engine *uc, uint64_t address, uint32_t size, void *user)
{
    struct machine *m = user;
    uint32_t at = (uint32_t)address & (FLASH_SIZE - 1), number = m->flash[at + 2] & 15;
    if (get_core_register(m, number))
        return;
    if (m->ccr & DIV_0_TRP) {
        raise_fault(m, USAGE_FAULT, DIVBYZERO, (uint32_t)address);
        return;
    }
    if (m->divided || m->stepping)
        return;
    m->divided = 1;
    m->resume = (uint32_t)address;
    m->stop_reason |= STOP_DIVISION;
    stop(m, (uint32_t)address);
}

/* Before an instruction while the floating-point unit is off (B1.4.5). */
static void on_float(uc_engine *uc, uint64_t address, uint32_t size, void *user)
{
    struct machine *m = user;
    uint16_t at[2];
    uint8_t *code = size == 4 && !(m->cpacr >> 20 & 1) ? memory_at(m, (uint32_t)address, 4) : 0;
    if (!code)
        return;
    memcpy(at, code, sizeof at);
    if ((at[0] & 0xEC00) == 0xEC00 && (at[1] & 0x0E00) == 0x0A00) /* coprocessors 10 and 11 */
        raise_fault(m, USAGE_FAULT, NOCP, (uint32_t)address);
}

/* Hook every instruction while the floating-point unit is off: it is for a moment after a reset. */
static void watch_floats(struct machine *m)
{
    int off = !(m->cpacr >> 20 & 1);
    if (off == (m->float_hook != 0))
        return;
    if (off) {
        m->engine.hook_add(m->engine.uc, &m->float_hook, HOOK_CODE, (void *)on_float, m, (uint64_t)1, (uint64_t)0);
    } else {
        m->engine.hook_del(m->engine.uc, m->float_hook);
        m->float_hook = 0;
    }
    m->engine.ctl(m->engine.uc, FLUSH_CODE);
}

/* Return whether an instruction may lower the stack pointer, by its first half word: PUSH, SUB, MOV or ADD to SP, and
   stores and floats with write-back to it. */
static int lowers_stack(uint16_t first)
{
    return (first & 0xFE00) == 0xB400 || (first & 0xFF80) == 0xB080 || (first & 0xFC87) == 0x4485 || (first & 0xFE0F) == 0xE80D ||
           (first & 0xFE0F) == 0xEC0D || (first & 0xF80F) == 0xF00D || (first & 0xFE0F) == 0xEA0D || (first & 0xFE0F) == 0xF80D;
}

/* Find the instructions that sleep, divide or stack; matches outside instructions have no effect. */
static int look_at_code(struct machine *m)
{
    uint16_t at[2];
    uint64_t hook, stackers = 0, masks = 0;
    int failed = 0;
    for (uint64_t i = 0; i + sizeof at <= FLASH_SIZE; i += sizeof *at) {
        memcpy(at, m->flash + i, sizeof at);
        int divides = (at[0] & 0xFFD0) == 0xFB90 && (at[1] & 0xF0F0) == 0xF0F0; /* SDIV and UDIV, A7.7.127 and A7.7.195 */
        if (at[0] == 0xBF30 || divides) /* WFI */
            failed |= m->engine.hook_add(m->engine.uc, &hook, HOOK_CODE, divides ? (void *)on_division : (void *)on_sleep, m,
                                         FLASH_BASE + i, FLASH_BASE + i);
        stackers += lowers_stack(at[0]);
        masks += (at[0] & 0xFFF0) == 0xF380 || (at[0] & 0xFFED) == 0xB661; /* MSR and CPS, B5.2 */
        m->before[i / 2 + 1] += (stackers << SUM_STACKERS) + (masks << SUM_MASKS);
    }
    m->before[FLASH_SIZE / 2] += (stackers << SUM_STACKERS) + (masks << SUM_MASKS);
    return failed | watch_alignment(m);
}

uint64_t machine_size(void)
{
    return sizeof(struct machine);
}

/* Initialise a machine in zeroed memory, map its buses and set its hooks; engine and memories must exist. */
int machine_attach(struct machine *m, const struct engine *engine, uint8_t *flash, uint8_t *ram, uint8_t *ccm,
                   uint64_t *before)
{
    const uint64_t everywhere[2] = {1, 0};
    const uint64_t not_memory[3][2] = {{0, CCM_BASE - 1}, {CCM_BASE + CCM_SIZE, RAM_BASE - 1}, {RAM_BASE + RAM_SIZE, UINT32_MAX}};
    uint64_t hook;
    m->engine = *engine;
    m->flash = flash;
    m->ram = ram;
    m->ccm = ccm;
    m->before = before;
    for (unsigned i = 0; i < ESCS; i++)
        m->due[DUE_ESC + i] = NEVER;
    uc_engine *uc = engine->uc;
    int failed = engine->mmio_map(uc, 0x40000000, PERIPHERALS_SIZE, peripheral_read, m, peripheral_write, m);
    failed |= engine->mmio_map(uc, 0x50000000, PERIPHERALS_SIZE, usb_read, m, usb_write, m);
    failed |= engine->mmio_map(uc, 0x22000000, RAM_SIZE * 32, ram_bit_read, m, ram_bit_write, m);
    failed |= engine->mmio_map(uc, 0x42000000, PERIPHERALS_SIZE * 32, peripheral_bit_read, m, peripheral_bit_write, m);
    failed |= engine->mmio_map(uc, 0xE0000000, 0x100000, system_read, m, system_write, m);
    failed |= engine->hook_add(uc, &hook, HOOK_BLOCK, (void *)on_block, m, everywhere[0], everywhere[1]);
    failed |= engine->hook_add(uc, &hook, HOOK_INTR, (void *)on_trap, m, everywhere[0], everywhere[1]);
    failed |= engine->hook_add(uc, &hook, HOOK_TLB, (void *)on_page, m, everywhere[0], everywhere[1]);
    for (unsigned i = 0; i < 3; i++)
        failed |= engine->hook_add(uc, &hook, HOOK_INVALID, (void *)on_invalid, m, not_memory[i][0], not_memory[i][1]);
    return failed | look_at_code(m);
}

/* Reset the processor; time and pin levels continue. `cause` goes to RCC's register of causes. */
void machine_reset(struct machine *m, uint32_t vectors, uint32_t cause)
{
    uint32_t words[2];
    memset(&m->enabled, 0, sizeof *m - offsetof(struct machine, enabled));
    for (unsigned slot = 0; slot < DUE_ESC; slot++)
        m->due[slot] = NEVER;
    look_ahead(m);
    for (unsigned n = 0; n < USARTS; n++)
        m->usart[n].sr = 0xC0;
    for (unsigned n = 0; n < SPIS; n++)
        m->spi[n].sr = 2; /* TXE */
    for (unsigned n = 0; n < TIMERS; n++)
        m->timer[n].arr = n == 1 || n == 4 ? 0xFFFFFFFF : 0xFFFF;
    m->enabled[0] = 0xFFFF; /* the system's own exceptions */
    m->stack_begin = m->canary = m->overflow = 0;
    for (unsigned i = 0; i < m->task_count; i++)
        m->task[i].busy_since = 0;
    m->attention = m->asleep = m->locked = m->stop_reason = m->watchdog_on = 0;
    m->watchdog_reload = 0xFFF;
    m->vtor = vectors;
    m->ccr = 0x200;
    m->fpccr = 0xC0000000;
    m->random = 0x2545F491;
    m->plain[0x23874 / 4] = cause;
    m->plain[0x23800 / 4] = 0x83;
    memcpy(words, m->flash + (vectors - FLASH_BASE), sizeof words);
    words[0] &= ~3u; /* as the register does, B1.4.7 */
    m->resume = m->skip_at = NOWHERE;
    m->masks = 0;
    for (int i = 0; i < 13; i++)
        set_register(m, R_R0 + i, 0);
    set_xpsr(m, THUMB);
    set_register(m, R_PRIMASK, 0);
    set_register(m, R_CONTROL, 0);
    set_register(m, R_MSP, words[0]);
    m->pc = words[1] & ~1u;
    if (m->profile)
        profile_reset(m);
}

/* True for the first sixteen. */
static int is_new_low_writer(struct machine *m)
{
    for (uint32_t i = 0; i < m->low_writer_count; i++)
        if (m->low_writers[i] == m->pc)
            return 0;
    if (m->low_writer_count == LOW_WRITERS)
        return 0;
    m->low_writers[m->low_writer_count++] = m->pc;
    return 1;
}

void fault_of(struct machine *m, int error)
{
    uint32_t pc = get_register(m, R_PC);
    m->pc = pc & ~1u;
    if (!(get_register(m, R_XPSR) & THUMB)) { /* no matter what is at that address */
        raise_fault(m, USAGE_FAULT, INVSTATE, pc);
    } else if ((error == READ_UNMAPPED || error == FETCH_UNMAPPED) && m->fault_address < FLASH_SIZE) {
        m->resume = m->pc; /* the alias of flash, mapped after this report */
        m->stop_reason |= STOP_LOW_READ;
    } else if (error == WRITE_PROTECTED || (error == WRITE_UNMAPPED && m->fault_address < FLASH_SIZE)) {
        /* A store to flash has no effect unless it is being programmed. */
        uint16_t first;
        if (m->fault_address < FLASH_SIZE && is_new_low_writer(m)) {
            m->resume = m->pc;
            m->stop_reason |= STOP_LOW_WRITE;
            return;
        }
        cut_block(m, m->pc);
        memcpy(&first, m->flash + (m->pc & (FLASH_SIZE - 1)), sizeof first);
        m->pc += first >> 11 > 0x1C ? 4 : 2;
    } else if (error == FETCH_UNMAPPED || error == FETCH_PROTECTED) {
        int never = pc >> 29 == 2 || pc >> 29 >= 5; /* devices, B3.1 */
        raise_fault(m, never ? MEMORY_FAULT : BUS_FAULT, never ? IACCVIOL : IBUSERR, pc);
    } else if (error == INVALID || error == 21) {
        raise_fault(m, USAGE_FAULT, UNDEFINSTR, pc);
    } else {
        m->bfar = m->fault_address;
        raise_fault(m, BUS_FAULT, PRECISERR | BFARVALID, pc);
    }
}

static void execute(struct machine *m, uint64_t count_of)
{
    watch_floats(m);
    m->stopping = 0;
    int error = m->engine.emu_start(m->engine.uc, m->pc | 1, NOWHERE, 0, count_of);
    if (error && !m->stopping) {
        fault_of(m, error);
    } else if (!m->stopping) {
        m->pc = get_register(m, R_PC) & ~1u;
        m->asleep = !m->stepping; /* nothing else ends the sleep */
    }
}

/* Let time pass without instructions, if none is executed now: for the outside load, and while the core sleeps. */
static int pass_time(struct machine *m, uint64_t until)
{
    uint64_t next = m->next_due < until ? m->next_due : until;
    if (m->owed && m->resume != m->pc && in_task(m) && !next_exception(m, 0)) {
        uint64_t part = next - m->now < m->owed ? next - m->now : m->owed;
        m->owed -= part;
        m->taken += part;
        m->running_since += part;
        m->now += part;
        return 1;
    }
    if (m->asleep || m->locked) {
        if (m->locked || !next_exception(m, 1)) {
            m->sleeping += next - m->now;
            m->now = next;
            return 1;
        }
        m->asleep = 0;
    }
    return 0;
}

/* Run up to a time, or until the caller must act; return the reason (`STOP_...`, 0: it is `until`). */
uint32_t machine_run(struct machine *m, uint64_t until)
{
    m->until = until;
    m->stop_reason = 0;
    m->stepping = 0;
    if (m->skip_at != m->pc) /* the pc has changed since */
        m->skip_at = NOWHERE;
    for (;;) {
        if (m->resume != m->pc) {
            m->resume = NOWHERE;
            let_happen(m);
            if (m->stop_reason || m->now >= until)
                return m->stop_reason;
        }
        if (pass_time(m, until))
            continue;
        execute(m, 0);
        if (m->stop_reason & (STOP_BREAK | STOP_LOW_READ | STOP_LOW_WRITE | STOP_DIVISION))
            return m->stop_reason;
    }
}

/* Stop before the second instruction of a step, in the middle of its block. */
static void on_step(uc_engine *uc, uint64_t address, uint32_t size, void *user)
{
    struct machine *m = user;
    if (!m->first_step && !m->stopping) {
        m->resume = (uint32_t)address;
        stop(m, (uint32_t)address);
    }
    m->first_step = 0;
}

/* Execute one instruction, or enter one exception; return without STOP_STEP if the time or a reason comes before it. */
uint32_t machine_step(struct machine *m, uint64_t until)
{
    m->until = until;
    m->stop_reason = 0;
    do {
        if (m->resume != m->pc) {
            m->resume = NOWHERE;
            let_happen(m);
            if (m->stop_reason || m->now >= until)
                return m->stop_reason;
        }
    } while (pass_time(m, until));
    uint32_t pc = m->pc;
    m->stepping = 1;
    m->skip_at = pc;
    uint64_t hook;
    m->engine.hook_add(m->engine.uc, &hook, HOOK_CODE, (void *)on_step, m, (uint64_t)1, (uint64_t)0);
    m->first_step = 1;
    execute(m, 0);
    m->engine.hook_del(m->engine.uc, hook);
    m->stepping = 0;
    m->skip_at = m->pc;
    if (m->pc == pc + 2 && !m->stop_reason)
        m->asleep = m->flash[(pc - FLASH_BASE) % FLASH_SIZE] == 0x30 && m->flash[(pc + 1 - FLASH_BASE) % FLASH_SIZE] == 0xBF;
    return m->stop_reason | STOP_STEP;
}

/* Set or remove a breakpoint; return 0 without room. */
int machine_break(struct machine *m, uint32_t address, int on)
{
    for (unsigned i = 0; i < BREAKPOINTS; i++) {
        if (on ? m->break_hook[i] != 0 : m->break_address[i] != address || !m->break_hook[i])
            continue;
        if (on) {
            m->break_address[i] = address;
            m->engine.hook_add(m->engine.uc, &m->break_hook[i], HOOK_CODE, (void *)on_break, m, (uint64_t)address,
                               (uint64_t)address);
        } else {
            m->engine.hook_del(m->engine.uc, m->break_hook[i]);
            m->break_hook[i] = 0;
        }
        return 1;
    }
    return 0;
}

/* Stop after the block of instructions with the access; real watchpoints are late as well. */
static void on_access(uc_engine *uc, int type, uint64_t address, int size, int64_t value, void *user)
{
    struct watchpoint *w = user;
    forget_condition(w->machine);
    note_access(w, (uint32_t)address, (uint32_t)size);
}

void note_access(struct watchpoint *w, uint32_t first, uint32_t size)
{
    if (first >= w->address + w->size || first + size <= w->address)
        return;
    struct machine *m = w->machine;
    m->watch_address = first > w->address ? first : w->address;
    m->watch_pc = get_register(m, R_PC) & ~1u;
    m->watch_exceptions = m->exceptions;
    m->stop_reason |= STOP_WATCHPOINT;
}

/* Set or remove a watchpoint of a GDB kind: 2 writes, 3 reads, 4 both; return 0 without room. */
int machine_watch(struct machine *m, uint32_t kind, uint32_t address, uint32_t size, int on)
{
    static const int hooks[3] = {HOOK_WRITE, HOOK_READ, HOOK_READ | HOOK_WRITE};
    for (unsigned i = 0; i < WATCHPOINTS; i++) {
        struct watchpoint *w = &m->watchpoint[i];
        if (on ? w->hook != 0 : !w->hook || w->address != address || w->size != size || w->kind != kind)
            continue;
        if (on) {
            *w = (struct watchpoint){.machine = m, .address = address, .size = size, .kind = kind};
            m->engine.hook_add(m->engine.uc, &w->hook, hooks[kind - 2], (void *)on_access, w, (uint64_t)address - 7,
                               (uint64_t)address + size - 1); /* a wide access may begin before it */
        } else {
            m->engine.hook_del(m->engine.uc, w->hook);
            w->hook = 0;
        }
        return 1;
    }
    return 0;
}

/* Add a device; returns its number, from 1 on, 0 where there is no room. */
int machine_device(struct machine *m, uint32_t bus, uint32_t address, uint8_t *memory, uint32_t size, uint32_t address_bytes,
                   uint32_t pairs)
{
    if (m->devices == DEVICES)
        return 0;
    m->device[m->devices++] = (struct device){.memory = memory, .size = size, .bus = bus, .address = address,
                                              .address_bytes = address_bytes, .pairs = pairs};
    return (int)m->devices;
}

/* Copy the bytes that a USART has sent; return their number. */
uint32_t machine_sent(struct machine *m, uint32_t n, uint8_t *bytes)
{
    uint32_t size = m->usart[n].filled;
    memcpy(bytes, m->usart[n].sent, size);
    m->usart[n].filled = 0;
    return size;
}
