/* Unaligned accesses (A3.2.1, B3.2.8): the core carries out loads and stores of one register, all others fault.

Unicorn itself aligns nothing. `unaligned_accesses_trap` of chip.py lets it take the core for one without the Main
Extension: then every unaligned access of a word or half word traps, and aligned ones lose no time. Such a core has no
BASEPRI and no FAULTMASK either. They are kept here. */
#include "machine.h"

#include <string.h>

enum { HOOK_CODE = 4, TO_MSP = 8, TO_PSP, TO_BASEPRI = 17, TO_BASEPRI_MAX, TO_FAULTMASK };

struct access {
    uint32_t address, size, loads, is_signed, target, base, moved, writes_back, length;
};

static int is_wide(uint16_t first)
{
    return first >> 11 >= 0x1D;
}

/* Decode LDR, LDRH, LDRSH, STR and STRH (A5.2.4, A5.3.7 to A5.3.10); return 0 for all other instructions. */
static int decode(struct machine *m, const uint16_t *at, struct access *a)
{
    static const uint8_t NARROW_SIZES[8] = {4, 2, 1, 1, 4, 2, 1, 2};
    unsigned first = at[0], second = at[1], group = first >> 12;
    uint32_t offset = 0, adds = 1, before = 1;
    if (!is_wide(at[0])) {
        unsigned operation = first >> 9 & 7;
        *a = (struct access){.length = 2, .target = first & 7, .base = first >> 3 & 7, .loads = first >> 11 & 1};
        if (group == 5) {
            a->size = NARROW_SIZES[operation];
            a->loads = operation >= 3;
            a->is_signed = operation == 7;
            offset = get_core_register(m, first >> 6 & 7);
        } else if (group == 6 || group == 8) {
            a->size = group == 6 ? 4 : 2;
            offset = (first >> 6 & 31) * a->size;
        } else {
            return 0;
        }
        a->address = get_core_register(m, a->base) + offset;
        return 1;
    }
    if (first >> 9 != 0x7C) /* 1111100: one register */
        return 0;
    *a = (struct access){.length = 4, .target = second >> 12, .base = first & 15, .loads = first >> 4 & 1,
                         .is_signed = first >> 8 & 1, .size = 1u << (first >> 5 & 3)};
    if (a->target == 15)
        return 0;
    uint32_t base = a->base == 15 ? (get_register(m, R_PC) & ~3u) + 4 : get_core_register(m, a->base);
    if (first & 0x80 || a->base == 15) {
        offset = second & 0xFFF;
        adds = first >> 7 & 1;
    } else if (second & 0x800) {
        offset = second & 0xFF;
        adds = second >> 9 & 1;
        before = second >> 10 & 1;
    } else {
        offset = get_core_register(m, second & 15) << (second >> 4 & 3);
    }
    a->moved = adds ? base + offset : base - offset;
    a->address = before ? a->moved : base;
    a->writes_back = !(first & 0x80) && a->base != 15 && (second & 0x900) == 0x900;
    return 1;
}

static int is_device(uint32_t address) /* A3.2.1 and B3.1: the order of its accesses matters */
{
    return address >> 29 == 2 || address >> 29 >= 5;
}

/* Return an error of unicorn, 0 without one. */
static int carry_out(struct machine *m, const struct access *a)
{
    uint32_t value = 0;
    if (a->loads) {
        if (m->engine.mem_read(m->engine.uc, a->address, &value, a->size))
            return READ_UNMAPPED;
        set_core_register(m, a->target, a->is_signed ? (uint32_t)(int16_t)value : value);
    } else {
        uint8_t *there = memory_at(m, a->address, a->size);
        if (!there)
            return WRITE_UNMAPPED;
        if (there >= m->flash && there < m->flash + FLASH_SIZE)
            return WRITE_PROTECTED;
        value = get_core_register(m, a->target);
        m->engine.mem_write(m->engine.uc, a->address, &value, a->size);
    }
    if (a->writes_back)
        set_core_register(m, a->base, a->moved);
    return 0;
}

/* Move on within an IT block (ITAdvance, A7.3.3). */
static void advance_condition(struct machine *m)
{
    uint32_t xpsr = get_register(m, R_XPSR), it = (xpsr >> 25 & 3) | (xpsr >> 8 & 0xFC);
    if (!it)
        return;
    it = it & 7 ? (it & 0xE0) | (it << 1 & 0x1F) : 0;
    set_register(m, R_XPSR, (xpsr & ~(uint32_t)IT_STATE) | (it & 3) << 25 | (it & 0xFC) << 8);
}

/* Unicorn has stopped before an unaligned access of the instruction at `pc`. */
void on_unaligned(struct machine *m, uint32_t pc)
{
    uint8_t *code = memory_at(m, pc, 4);
    uint16_t at[2];
    struct access a;
    memcpy(at, code ? code : memory_at(m, pc, 2), code ? 4 : 2);
    if (!decode(m, at, &a) || m->ccr & UNALIGN_TRP || is_device(a.address)) {
        raise_fault(m, USAGE_FAULT, UNALIGNED, pc);
        return;
    }
    int error = carry_out(m, &a);
    if (error) {
        m->fault_address = a.address;
        fault_of(m, error);
        stop(m, m->pc);
        return;
    }
    for (unsigned i = 0; i < WATCHPOINTS; i++)
        if (m->watchpoint[i].hook && (m->watchpoint[i].kind == 4 || m->watchpoint[i].kind == (a.loads ? 3 : 2)))
            note_access(&m->watchpoint[i], a.address, a.size);
    advance_condition(m);
    m->resume = m->pc = pc + a.length;
    set_register(m, R_PC, m->pc | 1);
}

/* The last block has ended: carry out its MSR or CPS, as far as unicorn does not (B5.2.1, B5.2.3). */
void set_masks(struct machine *m)
{
    uint8_t *end = memory_at(m, (uint32_t)m->next_address - 4, 4);
    uint16_t at[2];
    m->masks = 0;
    if (!end)
        return;
    memcpy(at, end, sizeof at);
    if ((at[1] & 0xFFED) == 0xB661 && !is_wide(at[0])) {
        m->faultmask = at[1] >> 4 & 1;
    } else if ((at[0] & 0xFFF0) == 0xF380 && (at[1] & 0xFF00) == 0x8800) {
        uint32_t value = get_core_register(m, at[0] & 15), which = at[1] & 0xFF, priority = value & 0xF0;
        if (which == TO_BASEPRI || (which == TO_BASEPRI_MAX && priority && (priority < m->basepri || !m->basepri)))
            m->basepri = priority;
        else if (which == TO_FAULTMASK)
            m->faultmask = value & 1;
        else if (which == TO_MSP || which == TO_PSP) /* their two lowest bits are always 0, B1.4.1 */
            set_register(m, which == TO_MSP ? R_MSP : R_PSP, value & ~3u);
    }
}

/* MRS of a register that is kept here. */
static void on_mask_read(uc_engine *uc, uint64_t address, uint32_t size, void *user)
{
    struct machine *m = user;
    uint16_t second;
    memcpy(&second, memory_at(m, (uint32_t)address + 2, 2), 2);
    set_core_register(m, second >> 8 & 15, (second & 0xFF) == TO_FAULTMASK ? m->faultmask : m->basepri);
    m->resume = m->pc = (uint32_t)address + size;
    set_register(m, R_PC, m->pc | 1);
}

/* Unicorn checks no alignment of two words at once, nor of STREX to where nothing was reserved. */
static void on_double(uc_engine *uc, uint64_t address, uint32_t size, void *user)
{
    struct machine *m = user;
    uint16_t first;
    memcpy(&first, memory_at(m, (uint32_t)address, 2), 2);
    uint32_t mask = (first & 0xFFF0) == 0xE8C0 ? 1 : 3;
    if (get_core_register(m, first & 15) & mask)
        raise_fault(m, USAGE_FAULT, UNALIGNED, (uint32_t)address);
}

/* Hook what unicorn does not check or has no register for; matches outside instructions have no effect. */
int watch_alignment(struct machine *m)
{
    uint64_t hook;
    int failed = 0;
    for (uint32_t i = 0; i + 4 <= FLASH_SIZE; i += 2) {
        uint16_t at[2];
        memcpy(at, m->flash + i, sizeof at);
        unsigned base = at[0] & 15;
        int reads = at[0] == 0xF3EF && (at[1] & 0xF0FF) >= 0x8011 && (at[1] & 0xF0FF) <= 0x8013;
        int doubles = (at[0] & 0xFE00) == 0xEC00 && (at[1] & 0x0F00) == 0x0B00 && at[0] & 0x0180 && base < 13;
        int stores = (at[0] & 0xFFF0) == 0xE840 || ((at[0] & 0xFFF0) == 0xE8C0 && (at[1] & 0x0FF0) == 0x0F50);
        if (reads || doubles || stores)
            failed |= m->engine.hook_add(m->engine.uc, &hook, HOOK_CODE, reads ? (void *)on_mask_read : (void *)on_double, m,
                                         (uint64_t)FLASH_BASE + i, (uint64_t)FLASH_BASE + i);
    }
    return failed;
}
