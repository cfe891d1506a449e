/* Finds a peripheral's register: some have behaviour, here or in separate files, others only store values.

RCC reports every clock as ready, PWR the voltage, FLASH that it is idle; GPIO, EXTI, the watchdog, ADC, USB without a
host, and the random numbers are here (chapters 7, 5, 3, 8, 12, 21, 13, 34, 24). */
#include "machine.h"

enum { LSI_HZ = 32000 };

enum { NONE, PLAIN, TIMER, BUS, SPI, USART, DMA, PORT, EXTI, RCC, PWR, FLASH, WATCHDOG, ADC };
#define STEP 0x400 /* each peripheral has so many addresses */
#define AT(base) [(base) / STEP]

static const struct range {
    uint8_t kind, index;
} RANGES[PERIPHERALS_SIZE / STEP] = {
    AT(0x00000) = {TIMER, 1}, AT(0x00400) = {TIMER, 2}, AT(0x00800) = {TIMER, 3}, AT(0x00C00) = {TIMER, 4},
    AT(0x01000) = {TIMER, 5}, AT(0x01400) = {TIMER, 6}, AT(0x01800) = {TIMER, 11}, AT(0x01C00) = {TIMER, 12},
    AT(0x02000) = {TIMER, 13}, AT(0x02800) = {PLAIN, 0}, AT(0x02C00) = {PLAIN, 0}, AT(0x03000) = {WATCHDOG, 0},
    AT(0x03800) = {SPI, 1}, AT(0x03C00) = {SPI, 2}, AT(0x04400) = {USART, 1}, AT(0x04800) = {USART, 2},
    AT(0x04C00) = {USART, 3}, AT(0x05000) = {USART, 4}, AT(0x05400) = {BUS, 0}, AT(0x05800) = {BUS, 1},
    AT(0x05C00) = {BUS, 2}, AT(0x07000) = {PWR, 0}, AT(0x10000) = {TIMER, 0}, AT(0x10400) = {TIMER, 7},
    AT(0x11000) = {USART, 0}, AT(0x11400) = {USART, 5}, AT(0x12000) = {ADC, 0}, AT(0x13000) = {SPI, 0},
    AT(0x13800) = {PLAIN, 0}, AT(0x13C00) = {EXTI, 0}, AT(0x14000) = {TIMER, 8}, AT(0x14400) = {TIMER, 9},
    AT(0x14800) = {TIMER, 10}, AT(0x20000) = {PORT, 0}, AT(0x20400) = {PORT, 1}, AT(0x20800) = {PORT, 2},
    AT(0x20C00) = {PORT, 3}, AT(0x21000) = {PORT, 4}, AT(0x21400) = {PORT, 5}, AT(0x21800) = {PORT, 6},
    AT(0x21C00) = {PORT, 7}, AT(0x22000) = {PORT, 8}, AT(0x23800) = {RCC, 0}, AT(0x23C00) = {FLASH, 0},
    AT(0x26000) = {DMA, 0}, AT(0x26400) = {DMA, 1},
};

void note_unknown(struct machine *m, uint32_t address)
{
    for (uint32_t i = 0; i < m->unknown_count; i++)
        if (m->unknown[i] == address)
            return;
    if (m->unknown_count < 16)
        m->unknown[m->unknown_count++] = address;
}

/* Whether RCC clocks a peripheral (chapter 7.3.10 to 7.3.14): most have the bit of their place on their bus. */
static int has_clock(const struct machine *m, uint32_t offset)
{
    static const uint32_t REGISTERS[3] = {0x23840, 0x23844, 0x23830}; /* APB1ENR, APB2ENR, AHB1ENR */
    static const uint32_t ALWAYS[3] = {1 << 10 | 1 << 12, 1 << 15, 1 << 14 | 1 << 15}; /* RTC, IWDG; EXTI; RCC, FLASH */
    uint32_t bus = offset >> 16, place = (offset & 0xFFFF) / STEP, bits = 1u << (place & 31);
    if (bus > 2 || place > 31 || ALWAYS[bus] & bits)
        return 1;
    if (bus == 1 && place == 8)
        bits = 7 << 8; /* any of three ADCs */
    else if (bus == 2 && place >= 24)
        bits = 1u << (place - 3); /* DMA */
    return (m->plain[REGISTERS[bus] / 4] & bits) != 0;
}

/* Whether an access by the core has no effect because the peripheral's clock is off; one by Python always has. */
static int is_dead(uc_engine *uc, struct machine *m, uint32_t offset, struct range range)
{
    if (!uc || range.kind == NONE || has_clock(m, offset))
        return 0;
    note_unknown(m, (0x40000000 + (offset & ~0x3FFu)) | 1);
    return 1;
}

/* GPIO */

static uint32_t levels(struct machine *m, unsigned port)
{
    uint32_t mode = m->plain[(0x20000 + 0x400 * port) / 4], out = 0;
    for (unsigned pin = 0; pin < 16; pin++)
        out |= (uint32_t)((mode >> 2 * pin & 3) == 1) << pin;
    return (m->output[port] & out) | (m->input[port] & ~out & 0xFFFF);
}

static uint32_t port_read(struct machine *m, unsigned port, uint32_t at)
{
    if (at == 0x10)
        return levels(m, port);
    return at == 0x14 ? m->output[port] : m->plain[(0x20000 + 0x400 * port + at) / 4];
}

static void port_write(struct machine *m, unsigned port, uint32_t at, uint32_t value, unsigned size)
{
    if (at == 0x14)
        m->output[port] = value & 0xFFFF;
    else if (at == 0x18) /* the half that sets wins */
        m->output[port] = ((m->output[port] & ~(size == 4 ? value >> 16 : 0)) | value) & 0xFFFF;
    else if (at == 0x1A)
        m->output[port] &= ~value;
    else
        m->plain[(0x20000 + 0x400 * port + at) / 4] = value;
    spi_select(m, port, levels(m, port));
}

/* EXTI */

static void update_exti(struct machine *m)
{
    uint32_t on = m->exti[5] & m->exti[0];
    for (unsigned line = 0; line < 5; line++)
        set_line(m, 6 + line, on >> line & 1);
    set_line(m, 23, (on & 0x3E0) != 0);
    set_line(m, 40, (on & 0xFC00) != 0);
}

/* Set a pin's level from outside. */
void machine_pin(struct machine *m, uint32_t port, uint32_t pin, uint32_t high)
{
    uint32_t was = m->input[port] >> pin & 1, source = m->plain[(0x13808 + pin / 4 * 4) / 4] >> pin % 4 * 4 & 15;
    m->input[port] = (m->input[port] & ~(1u << pin)) | (high & 1) << pin;
    if (was != (high & 1) && source == port && m->exti[high ? 2 : 3] >> pin & 1) {
        m->exti[5] |= 1u << pin;
        update_exti(m);
    }
}

static void exti_write(struct machine *m, uint32_t at, uint32_t value)
{
    if (at == 0x14) {
        m->exti[5] &= ~value;
    } else if (at == 0x10) {
        m->exti[5] |= value & m->exti[0];
    } else if (at < 0x10) {
        m->exti[at / 4] = value;
    }
    update_exti(m);
}

/* RCC: every enabled clock is ready, and the selected one runs. */

static uint32_t rcc_read(struct machine *m, uint32_t at)
{
    uint32_t value = m->plain[(0x23800 + at) / 4];
    switch (at) {
    case 0x00: return value | (value & 0x05010001) << 1;
    case 0x08: return (value & ~12u) | (value & 3) << 2;
    case 0x70: return value | (value & 1) << 1;
    case 0x74: return value | (value & 1) << 1;
    default: return value;
    }
}

static void rcc_write(struct machine *m, uint32_t at, uint32_t value)
{
    uint32_t *reg = &m->plain[(0x23800 + at) / 4];
    if (at == 0x74) /* the causes of resets are cleared together, by RMVF */
        *reg = value >> 24 & 1 ? value & 1 : (*reg & 0xFE000000) | (value & 1);
    else
        *reg = value;
}

/* Independent watchdog */

static void watchdog_write(struct machine *m, uint32_t at, uint32_t value)
{
    if (at == 4)
        m->watchdog_prescaler = value & 7;
    if (at == 8)
        m->watchdog_reload = value & 0xFFF;
    if (at == 0 && value == 0xCCCC)
        m->watchdog_on = 1;
    if (at == 0 && m->watchdog_on && (value == 0xAAAA || value == 0xCCCC)) {
        unsigned power = m->watchdog_prescaler < 6 ? m->watchdog_prescaler : 6;
        plan(m, DUE_WATCHDOG, m->now + (CLOCK_HZ / LSI_HZ * (4ull << power)) * (m->watchdog_reload + 1ull));
    }
}

static uint32_t watchdog_read(struct machine *m, uint32_t at)
{
    return at == 4 ? m->watchdog_prescaler : at == 8 ? m->watchdog_reload : 0;
}

uint64_t peripheral_read(uc_engine *uc, uint64_t where, unsigned size, void *user)
{
    struct machine *m = user;
    uint32_t offset = (uint32_t)where & ~3u, at = offset & 0x3FF, shift = 8 * ((uint32_t)where & 3), value;
    struct range range = RANGES[offset / STEP];
    if (is_dead(uc, m, offset, range))
        return 0;
    switch (range.kind) {
    case TIMER: value = timer_read(m, range.index, at); break;
    case BUS: value = bus_read(m, range.index, at); break;
    case SPI: value = spi_read(m, range.index, at); break;
    case USART: value = usart_read(m, range.index, at); break;
    case DMA: value = dma_read(m, range.index, at); break;
    case PORT: value = port_read(m, range.index, at); break;
    case EXTI: value = at < 0x18 ? m->exti[at / 4] : 0; break;
    case RCC: value = rcc_read(m, at); break;
    case PWR: value = at == 4 ? m->plain[offset / 4] | 0xC008 : m->plain[offset / 4]; break; /* VOSRDY and others */
    case FLASH: value = at == 0x0C ? 0 : m->plain[offset / 4]; break;
    case WATCHDOG: value = watchdog_read(m, at); break;
    case ADC: value = at == 0 ? 0x12 : at == 0x4C ? 0x800 : m->plain[offset / 4]; break; /* done, half of the range */
    case PLAIN: value = m->plain[offset / 4]; break;
    default:
        note_unknown(m, 0x40000000 + offset - at);
        value = 0;
    }
    return value >> shift;
}

void peripheral_write(uc_engine *uc, uint64_t where, unsigned size, uint64_t given, void *user)
{
    struct machine *m = user;
    uint32_t offset = (uint32_t)where, at = offset & 0x3FF, value = (uint32_t)given;
    struct range range = RANGES[offset / STEP];
    if (is_dead(uc, m, offset, range))
        return;
    switch (range.kind) {
    case TIMER: timer_write(m, range.index, at, value); break;
    case BUS: bus_write(m, range.index, at, value); break;
    case SPI: spi_write(m, range.index, at, value); break;
    case USART: usart_write(m, range.index, at, value); break;
    case DMA: dma_write(m, range.index, at, value); break;
    case PORT: port_write(m, range.index, at, value, size); break;
    case EXTI: exti_write(m, at, value); break;
    case RCC: rcc_write(m, at & ~3u, value << 8 * (at & 3)); break;
    case WATCHDOG: watchdog_write(m, at, value); break;
    case PWR: case FLASH: case ADC: case PLAIN: m->plain[offset / 4] = value; break;
    default: note_unknown(m, 0x40000000 + (offset & ~0x3FFu));
    }
}

/* Bit-banding: each bit of RAM and of the peripherals also has a word (PM0214, chapter 2.2.5). */

uint64_t ram_bit_read(uc_engine *uc, uint64_t where, unsigned size, void *user)
{
    struct machine *m = user;
    return m->ram[where >> 5] >> (where >> 2 & 7) & 1;
}

void ram_bit_write(uc_engine *uc, uint64_t where, unsigned size, uint64_t value, void *user)
{
    struct machine *m = user;
    uint8_t bit = (uint8_t)(1 << (where >> 2 & 7)), *byte = m->ram + (where >> 5);
    *byte = value & 1 ? *byte | bit : (uint8_t)(*byte & ~bit);
}

uint64_t peripheral_bit_read(uc_engine *uc, uint64_t where, unsigned size, void *user)
{
    return peripheral_read(uc, where >> 5 & ~3u, 4, user) >> (where >> 2 & 31) & 1;
}

void peripheral_bit_write(uc_engine *uc, uint64_t where, unsigned size, uint64_t value, void *user)
{
    uint64_t place = where >> 5 & ~3u, bit = 1ull << (where >> 2 & 31), word = peripheral_read(uc, place, 4, user);
    peripheral_write(uc, place, 4, value & 1 ? word | bit : word & ~bit, user);
}

uint64_t usb_read(uc_engine *uc, uint64_t where, unsigned size, void *user)
{
    struct machine *m = user;
    uint32_t offset = (uint32_t)where;
    if (offset == 0x10) /* GRSTCTL: idle, no reset in progress */
        return 0x80000000;
    if (offset == 0x60804) /* RNG: a number is ready */
        return 1;
    if (offset == 0x60808) {
        m->random ^= m->random << 13;
        m->random ^= m->random >> 17;
        m->random ^= m->random << 5;
        return m->random;
    }
    if (offset >= 0x40000)
        note_unknown(m, 0x50000000 + (offset & ~0x3FFu));
    return 0;
}

void usb_write(uc_engine *uc, uint64_t where, unsigned size, uint64_t value, void *user)
{
}
