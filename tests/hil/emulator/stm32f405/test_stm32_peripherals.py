"""The chip's peripherals by their registers, as ST's reference manual RM0090 has them; code only sleeps."""

from struct import pack

import numpy as np
import pytest

pytest.importorskip("unicorn")

from hil.emulator.stm32f405.chip import CYCLES_PER_US, FLASH, RAM, StopReason
from hil.errors import LabError
from support.stm32_bench import Bench

TIM3 = 0x4000_0400


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_compare_register_is_seen_from_outside_when_it_changes() -> None:
    bench = Bench(bytes.fromhex("2160 ffe7 2160 ffe7"))  # str r1, [r4]; b on; twice
    bench[0x4002_3840] = 2
    bench.chip.set_register("r1", 25522)
    bench.chip.set_register("r4", TIM3 + 0x34)
    assert [bench.chip.run(1680) for _ in range(2)] == [StopReason.COMPARE, StopReason.TIME]
    assert bench.chip.state.compare[2][0] == 25522


def test_a_store_into_flash_changes_nothing_and_the_next_instruction_follows() -> None:
    bench = Bench(
        bytes.fromhex("c0f80010 0132 0160 0132")
    )  # str.w r1, [r0]; adds r2, #1; str r1, [r0]; adds r2, #1
    bench.chip.set_register("r0", FLASH + 0x100)
    bench.chip.set_register("r1", 0x1234)
    bench.wait(10)
    assert [bench.chip.register(name) for name in ("r0", "r1", "r2")] == [FLASH + 0x100, 0x1234, 2]
    assert bench[FLASH + 0x100] == 0xFFFF_FFFF


def test_only_a_jump_that_is_taken_refills_the_pipeline() -> None:
    def cycles(branch: str) -> int:  # cmp r0, r0; the branch over the nop; nop; subs r1, #1; bne to cmp
        bench = Bench(bytes.fromhex(f"8042 {branch} 00bf 0139 fad1"))
        bench.chip.set_register("r1", 100)
        bench.wait(100)
        return int(bench.chip.state.now - bench.chip.state.sleeping)

    assert cycles("00d0") - cycles("00d1") == 100 * (3 - 1)  # beq is taken and skips the nop, bne is not


@pytest.mark.parametrize("place", [RAM + 0x3001, RAM + 0x3005])
def test_code_in_ram_takes_a_cycle_per_half_word_and_a_refill_per_jump(place: int) -> None:
    bench = Bench(bytes.fromhex("2047"))  # bx r4
    bench.chip.write(RAM + 0x3000, bytes.fromhex("00bf 00bf 00bf 00bf 2847"))  # nop, four times; bx r5
    before, executed = bench.chip.state.now, bench.chip.state.instructions
    bench.chip.set_register("r4", place)
    bench.chip.set_register("r5", (FLASH + 10) | 1)
    bench.wait(10)
    taken = bench.chip.state.now - before - bench.chip.state.sleeping
    halves = 5 - (place - RAM - 0x3001) // 2
    assert taken - 2 * 3 - halves in (5, 6, 7), "bx, wfi and the jump behind it"
    assert bench.chip.state.instructions - executed == 2 + halves


def test_there_is_room_for_sixteen_devices(bench: Bench) -> None:
    for number in range(16):
        assert bench.chip.add_device(1 + number % 3, number, np.zeros(1, np.uint8)) == number
    with pytest.raises(LabError, match="more devices"):
        bench.chip.add_device(1, 16, np.zeros(1, np.uint8))


@pytest.mark.long
@pytest.mark.parametrize("lines", [3, 64, 65, 90])
def test_a_line_of_flash_waits_unless_it_is_among_the_64_used_last(lines: int) -> None:
    """Random jumps, by a table in memory, between lines that each have one: ldr pc, [r4], #4."""
    rng, line = np.random.default_rng(lines), bytes.fromhex("54f804fb") + bytes.fromhex("00bf") * 6
    way = [*range(lines), *rng.integers(0, lines, 1000).tolist(), *range(lines)]

    def cycles(cached: bool) -> int:
        bench = Bench(bytes.fromhex("00bf") * 4 + line * lines)
        places = [(FLASH + 16 + 16 * one) | 1 for one in (*way, lines)]  # the last one sleeps
        bench.chip.write(RAM + 0x2000, pack(f"<{len(places)}I", *places))
        bench.chip.set_register("r4", RAM + 0x2004)
        bench.chip.set_register("pc", places[0])
        if cached:
            bench.chip.empty_flash_cache()
        bench.wait(1000)
        return int(bench.chip.state.now - bench.chip.state.sleeping)

    used: list[int] = []
    misses = 0
    for one in (*way, lines):
        misses += one not in used[-64:]
        used = [other for other in used if other != one] + [one]
    assert cycles(cached=True) - cycles(cached=False) == 5 * misses


def test_where_nothing_is_nothing_can_be_read(bench: Bench) -> None:
    with pytest.raises(LabError, match="0x60000000, 4 bytes: no memory there"):
        bench.chip.read(0x6000_0000, 4)


# IWDG, SPI2, SPI3, I2C2, I2C3, TIM8, TIM9.
# TIM2 to TIM5, USART2, I2C1, TIM1, USART6, SPI1, SYSCFG, EXTI, GPIOA to GPIOD, RCC, DMA1, DMA2; SysTick, NVIC, SCB.
PERIPHERALS = (
    0x4000_3000, 0x4000_3800, 0x4000_3C00, 0x4000_5800, 0x4000_5C00, 0x4001_0400, 0x4001_4000,
    0x4000_0000, 0x4000_0400, 0x4000_0800, 0x4000_0C00, 0x4000_4400, 0x4000_5400, 0x4001_0000, 0x4001_1400, 0x4001_3000,
    0x4001_3800, 0x4001_3C00, 0x4002_0000, 0x4002_0400, 0x4002_0800, 0x4002_0C00, 0x4002_3800, 0x4002_6000, 0x4002_6400,
)  # fmt: skip
SYSTEM = (0xE000_E010, 0xE000_E100, 0xE000_E200, 0xE000_E400, 0xE000_ED04)
CORE = (*(f"r{number}" for number in range(13)), "sp", "pc", "primask", "basepri", "faultmask", "control")


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_a_reset_chip_is_like_a_fresh_one(bench: Bench, seed: int) -> None:
    """Whatever was written to its registers, and while it runs on."""

    def seen(one: Bench) -> dict[int | str, int]:
        registers: dict[int | str, int] = {name: one.chip.register(name) for name in CORE}
        places = [
            base + 4 * word for base in PERIPHERALS + SYSTEM for word in range(24 if base < SYSTEM[0] else 4)
        ]
        return registers | {place: one[place] for place in (*places, 0x5006_0808)}  # also a random number

    rng = np.random.default_rng(seed)
    fresh = Bench()
    for base in rng.permutation(PERIPHERALS + SYSTEM[:4]).tolist():
        for word in rng.integers(0, 24 if base < SYSTEM[0] else 4, 12).tolist():
            if base + 4 * word != 0x4002_3C00:
                bench[base + 4 * word] = int(rng.integers(1, 1 << 32) & rng.integers(1, 1 << 32))
    for name in CORE[:13]:
        bench.chip.set_register(name, 0x1234)
    for name, value in (("basepri", 0x10), ("faultmask", 1), ("primask", 1), ("control", 2)):
        bench.chip.set_register(name, value)
    bench.chip.run(5 * CYCLES_PER_US)
    assert seen(bench) != seen(fresh)
    fresh.chip.run(bench.chip.state.now)
    for one in (bench, fresh):
        one.chip.reset(0x0C00_0000)
    # The manuals' values: VTOR, CCR, status of USART2 and SPI1, reload of TIM2 and TIM3, cause, RCC.
    places = (
        0xE000_ED08,
        0xE000_ED14,
        0x4000_4400,
        0x4001_3008,
        0x4000_002C,
        0x4000_042C,
        0x4002_3874,
        0x4002_3800,
    )
    values = (FLASH, 0x200, 0xC0, 2, 0xFFFF_FFFF, 0xFFFF, 0x0C00_0000, 0x83)
    assert [bench[place] for place in places] == list(values)
    assert [bench.chip.register(name) for name in CORE] == [*13 * [0], RAM + 0x1000, FLASH + 8, 0, 0, 0, 0]
    for _ in range(3):
        assert set(seen(bench).items()) == set(seen(fresh).items())
        for one in (bench, fresh):
            one.chip.run(fresh.chip.state.now + 100 * CYCLES_PER_US)


def test_random_numbers_are_always_ready_differ_and_are_those_of_any_other_chip(bench: Bench) -> None:
    status, data = 0x5006_0804, 0x5006_0808
    ours, theirs = ([(one[status], one[data]) for _ in range(100)] for one in (bench, Bench()))
    assert ours == theirs
    assert {ready for ready, _ in ours} == {1}  # neither an error of the clock nor of the seed
    numbers = [number for _, number in ours]
    assert len(set(numbers)) == 100
    assert 40 < np.mean([number.bit_count() for number in numbers]) / 32 * 100 < 60
