"""Registers without much behaviour, against the tables of RM0090: bits, clocks, pins and their interrupts, watchdog."""

import numpy as np
import pytest

pytest.importorskip("unicorn")

from hil.emulator.stm32f405.chip import CYCLES_PER_US, StopReason
from support.stm32_bench import Bench

PORTS = dict(zip("ABCDEFGHI", range(0x4002_0000, 0x4002_2400, 0x400), strict=True))
RCC, EXTI, SYSCFG, IWDG, FLASH_REGISTERS = 0x4002_3800, 0x4001_3C00, 0x4001_3800, 0x4000_3000, 0x4002_3C00
PENDING = 0xE000_E200
STREAMS = [dma + 0x10 + 0x18 * one for dma in (0x4002_6000, 0x4002_6400) for one in range(8)]
# Base, registers, bits that software can write and read back.
KEPT = [
    *((base, (0x08, 0x0C, 0x10, 0x14), 0xFFFF_FFFF) for base in STREAMS),  # PAR, M0AR, M1AR, FCR
    *((base, (0x04,), 0xFFFF) for base in STREAMS),  # NDTR
    *((base, (0x28, 0x34, 0x38, 0x3C, 0x40), 0xFFFF) for base in (0x4001_0000, 0x4001_0400)),  # PSC, CCR1 to 4
    *((base, (0x28, 0x2C), 0xFFFF) for base in (0x4000_1000, 0x4000_1400, 0x4001_4000, 0x4001_4800)),  # and ARR
    *((base, (0x2C, 0x34, 0x38, 0x3C, 0x40), 0xFFFF_FFFF) for base in (0x4000_0000, 0x4000_0C00)),
    *((base, (0x08, 0x10, 0x14), 0xFFF) for base in (0x4001_1000, 0x4000_4400, 0x4000_5000)),  # BRR, CR2, CR3
    *((base, (0x08, 0x0C, 0x1C, 0x20), 0xFFFF) for base in (0x4000_5400, 0x4000_5800, 0x4000_5C00)),  # OAR, CCR, TRISE
    *((base, (0x04, 0x10), 0xE7) for base in (0x4001_3000, 0x4000_3800, 0x4000_3C00)),  # CR2, CRCPR
    *((base, (0x00, 0x04, 0x08, 0x0C, 0x20, 0x24), 0xFFFF_FFFF) for base in PORTS.values()),
    *((base, (0x14,), 0xFFFF) for base in PORTS.values()),  # ODR
    (EXTI, (0x00, 0x04, 0x08, 0x0C), 0x7F_FFFF), (SYSCFG, (0x08, 0x0C, 0x10, 0x14), 0xFFFF),
    (RCC, (0x10, 0x30, 0x34, 0x38, 0x40, 0x44), 0xFFFF_FFFF), (IWDG, (0x04,), 7), (IWDG, (0x08,), 0xFFF),
    (0xE000_E000, (0x014,), 0xFF_FFFF), (0xE000_E000, (0xD08,), 0xFFFF_FF80), (0xE000_E000, (0xD24, 0xD88), 0xF0_0000),
]  # fmt: skip
# Enabling register and bit of each peripheral's clock (chapters 7.3.10 to 7.3.14).
CLOCKS = {
    **{base: (0x30, place) for place, base in enumerate(PORTS.values())}, 0x4002_6000: (0x30, 21), 0x4002_6400: (0x30, 22),
    **{0x4000_0000 + 0x400 * place: (0x40, place) for place in range(9)},  # TIM2 to TIM7, TIM12 to TIM14
    0x4000_2C00: (0x40, 11), 0x4000_3800: (0x40, 14), 0x4000_3C00: (0x40, 15), 0x4000_4400: (0x40, 17),
    0x4000_4800: (0x40, 18), 0x4000_4C00: (0x40, 19), 0x4000_5000: (0x40, 20), 0x4000_5400: (0x40, 21),
    0x4000_5800: (0x40, 22), 0x4000_5C00: (0x40, 23), 0x4000_7000: (0x40, 28),
    0x4001_0000: (0x44, 0), 0x4001_0400: (0x44, 1), 0x4001_1000: (0x44, 4), 0x4001_1400: (0x44, 5), 0x4001_3000: (0x44, 12),
    SYSCFG: (0x44, 14), 0x4001_4000: (0x44, 16), 0x4001_4400: (0x44, 17), 0x4001_4800: (0x44, 18),
}  # fmt: skip


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_each_register_keeps_the_bits_that_it_has(bench: Bench) -> None:
    """All of them at once, with different values: none is another one."""
    rng = np.random.default_rng(3)
    places = {base + at: bits for base, registers, bits in KEPT for at in registers}
    for _ in range(2):
        written = {place: int(rng.integers(0, 1 << 32)) for place in places}
        for place, value in written.items():
            bench[place] = value
        read = {place: bench[place] & bits for place, bits in places.items()}
        assert read == {place: value & places[place] for place, value in written.items()}


def test_a_bit_that_does_not_exist_reads_as_0(bench: Bench) -> None:
    for place, bits in (
        (STREAMS[0] + 4, 0xFFFF), (0x4001_1008, 0xFFFF), (0x4000_5408, 0xFFFF), (0x4001_3004, 0xFFFF), (IWDG + 4, 7),
        (IWDG + 8, 0xFFF), (PORTS["C"] + 0x14, 0xFFFF), (0x4001_0028, 0xFFFF), (0xE000_E014, 0xFF_FFFF),
        (0xE000_ED08, 0xFFFF_FF80), (0xE000_E404, 0xF0F0_F0F0), (0xE000_ED18, 0xF0F0_F0F0),
    ):  # fmt: skip
        bench[place] = 0xFFFF_FFFF
        assert bench[place] == bits, hex(place)


@pytest.mark.long
@pytest.mark.parametrize("base", CLOCKS, ids=hex)
def test_a_peripheral_answers_the_core_with_its_own_clock_only(base: int) -> None:
    bench = Bench(bytes.fromhex("2068 2068"))  # ldr r0, [r4], twice
    register, bit = CLOCKS[base]
    for clocks, dead in ((~(1 << bit) & 0xFFFF_FFFF, 1), (1 << bit, 0)):
        bench[RCC + 0x30] = bench[RCC + 0x40] = bench[RCC + 0x44] = 0xFFFF_FFFF if dead else 0
        bench[RCC + register] = clocks
        bench.chip.set_register("r4", base)
        bench.chip.step()
        assert list(bench.chip.state.unknown[0 : bench.chip.state.unknown_count]) == [base | 1]
    assert bench.chip.state.unknown_count == 1


@pytest.mark.parametrize("bit", [8, 9, 10])
def test_any_of_three_clocks_lets_the_converters_answer(bit: int) -> None:
    bench = Bench(bytes.fromhex("2068 2068"))
    bench.chip.set_register("r4", 0x4001_2000)
    bench[RCC + 0x44] = 1 << bit
    bench.chip.step()
    assert (bench.chip.register("r0"), bench.chip.state.unknown_count) == (0x12, 0)


@pytest.mark.parametrize("base", [IWDG, EXTI, RCC, FLASH_REGISTERS, 0x4000_2800], ids=hex)
def test_what_needs_no_clock_always_answers(base: int) -> None:
    bench = Bench(bytes.fromhex("2068"))
    bench.chip.set_register("r4", base)
    bench.chip.step()
    assert bench.chip.state.unknown_count == 0


def test_what_firmware_waits_for_is_there(bench: Bench) -> None:
    """Clocks that are ready, the selected one, the voltage, an idle flash, converters that are done, an idle USB."""
    for register, bits, ready in (
        (0x00, (0, 16, 24, 26), 1), (0x70, (0,), 1), (0x74, (0,), 1), (0x08, (0, 1), 2),
    ):  # fmt: skip
        bench[RCC + register] = 0
        rest = bench[RCC + register]
        for bit in bits:
            bench[RCC + register] = 1 << bit
            assert bench[RCC + register] == rest | 1 << bit | 1 << bit + ready
    bench[FLASH_REGISTERS + 0x0C] = 0xFFFF
    bench[0x4000_7004] = 1
    fixed = {
        FLASH_REGISTERS + 0x0C: 0, 0x4000_7004: 0xC009, 0x4001_2000: 0x12, 0x4001_204C: 0x800, 0x5000_0010: 1 << 31,
        0xE000_ED00: 0x410F_C241, 0xE000_EF40: 0x1011_0021, 0xE000_EF34: 0xC000_0000, 0xE000_1000: 1,
    }  # fmt: skip
    assert {place: bench[place] for place in fixed} == fixed
    bench.wait(7)
    assert bench[0xE000_1004] == 7 * CYCLES_PER_US


def test_causes_of_resets_are_cleared_together(bench: Bench) -> None:
    bench.chip.reset(0xFE00_0000)
    bench[RCC + 0x74] = 1
    assert bench[RCC + 0x74] == 0xFE00_0003
    bench[RCC + 0x74] = 1 << 24
    assert bench[RCC + 0x74] == 0


def test_pins_follow_a_model(bench: Bench) -> None:
    """Outputs by ODR and BSRR, inputs from outside; pins for analog signals or peripherals have the level from outside."""
    rng = np.random.default_rng(4)
    base, mode, output, outside = PORTS["D"], 0, 0, 0
    bench[base] = 0
    for _ in range(300):
        value, kind = int(rng.integers(0, 1 << 32)), rng.integers(4)
        if kind == 0:
            mode = bench[base] = value
        elif kind == 1:
            bench[base + 0x14], output = value, value & 0xFFFF
        elif kind == 2:
            bench[base + 0x18], output = value, (output & ~(value >> 16) | value) & 0xFFFF
        else:
            pin = value % 16
            outside = outside & ~(1 << pin) | (value >> 4 & 1) << pin
            bench.chip.pin("D", pin, bool(value >> 4 & 1))
        driven = sum(1 << pin for pin in range(16) if mode >> 2 * pin & 3 == 1)
        assert bench[base + 0x14] == output
        assert bench[base + 0x10] == output & driven | outside & ~driven


@pytest.mark.parametrize(("code", "at", "value", "expected"), [
    ("2180", 0x18, 0x0180, 0x0FF0), ("2180", 0x1A, 0x0180, 0x0E70), ("2170", 0x18, 0x0001, 0x0FF1),
], ids=["strh to set", "strh to reset", "strb to set"])  # fmt: skip
def test_half_of_a_register_is_a_register(code: str, at: int, value: int, expected: int) -> None:
    bench, base = Bench(bytes.fromhex(code)), PORTS["B"]
    bench[RCC + 0x30], bench[base + 0x14] = 2, 0x0FF0
    bench.chip.set_register("r1", value)
    bench.chip.set_register("r4", base + at)
    bench.chip.step()
    assert bench[base + 0x14] == expected


@pytest.mark.parametrize("byte", range(4))
def test_a_byte_of_a_register_is_read_alone(byte: int) -> None:
    bench = Bench(bytes.fromhex("2078"))  # ldrb r0, [r4]
    bench[RCC + 0x40] = 0x4433_2211
    bench.chip.set_register("r4", RCC + 0x40 + byte)
    bench.chip.step()
    assert bench.chip.register("r0") == 0x11 * (byte + 1)


@pytest.mark.long
def test_interrupts_of_pins_follow_a_model(bench: Bench) -> None:
    rng = np.random.default_rng(6)
    mask, rising, falling, pending, sources, levels = 0, 0, 0, 0, [0] * 16, {}
    for _ in range(600):
        kind, value = rng.integers(9), int(rng.integers(0, 1 << 16))
        if kind == 0:
            mask = bench[EXTI] = value
        elif kind == 1:
            rising = bench[EXTI + 0x08] = value
        elif kind == 2:
            falling = bench[EXTI + 0x0C] = value
        elif kind == 3:
            bench[EXTI + 0x10] = value
            pending |= value & mask
        elif kind == 4:
            bench[EXTI + 0x14] = value
            pending &= ~value
        elif kind == 5:
            group = value % 4
            sources[4 * group : 4 * group + 4] = [int(port) for port in rng.integers(0, 4, 4)]
            bench[SYSCFG + 8 + 4 * group] = sum(sources[4 * group + one] << 4 * one for one in range(4))
        else:
            port, pin, high = value % 4, value >> 2 & 15, bool(value >> 8 & 1)
            edge = high != levels.get((port, pin), False)
            levels[port, pin] = high
            bench.chip.pin("ABCD"[port], pin, high)
            if edge and sources[pin] == port and (rising if high else falling) >> pin & 1:
                pending |= 1 << pin
        assert bench[EXTI + 0x14] == pending
        for word in (0, 1):
            bench[PENDING + 0x80 + 4 * word] = 0xFFFF_FFFF
        on = pending & mask
        wanted = {6 + pin for pin in range(5) if on >> pin & 1} | ({23} if on & 0x3E0 else set())
        wanted |= {40} if on & 0xFC00 else set()
        assert {irq for irq in range(64) if bench.is_pending(irq)} == wanted


@pytest.mark.long
@pytest.mark.parametrize("prescaler", range(8))
def test_a_watchdog_bites_after_its_time_unless_it_is_fed(bench: Bench, prescaler: int) -> None:
    bench[IWDG + 4], bench[IWDG + 8] = prescaler, 9
    us = round(4 * 2 ** min(prescaler, 6) * 10 / 0.032)
    assert bench.wait(2 * us) == bench.wait(0) == StopReason.TIME, "it was not started"
    bench[IWDG] = 0xCCCC
    for _ in range(2):
        assert bench.wait(us - 1) == StopReason.TIME
        bench[IWDG] = 0xAAAA
    bench[IWDG] = 0x5555
    assert bench.wait(us - 1) == StopReason.TIME
    assert bench.wait(1) & StopReason.WATCHDOG
    assert bench.wait(2 * us) == StopReason.TIME, "once"


def test_a_reset_watchdog_has_its_longest_reload(bench: Bench) -> None:
    bench[IWDG + 4], bench[IWDG + 8], bench[IWDG] = 1, 3, 0xCCCC
    bench.chip.reset(1 << 26)
    assert (bench[IWDG + 4], bench[IWDG + 8]) == (0, 0xFFF)
    assert bench.wait(1000) == StopReason.TIME


def test_a_chip_that_only_sleeps_has_nothing_to_do(bench: Bench) -> None:
    for _ in range(2):
        bench[0x4001_0034] = 5
        bench.wait(400_000)
        assert set(bench.chip.state.due) == {(1 << 64) - 1}, "nothing is planned"
        assert bench.chip.state.compare[0][0] == 5
        bench.chip.reset(1 << 26)


def test_sixteen_missing_peripherals_are_named(bench: Bench) -> None:
    missing = [0x4000_6000 + 0x400 * one for one in range(4)] + [
        0x4004_0000 + 0x400 * one for one in range(13)
    ]
    for base in missing:
        bench[base + 8] = 1
        assert bench[base + 4] == 0
    assert list(bench.chip.state.unknown) == missing[:16]
    assert bench.chip.state.unknown_count == 16
