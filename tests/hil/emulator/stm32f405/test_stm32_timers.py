"""The timers and SysTick by their registers, as RM0090 has them (chapters 17 to 20 and the vector table of chapter 12)."""

import pytest

pytest.importorskip("unicorn")

from hil.emulator.stm32f405.chip import CYCLES_PER_US
from support.stm32_bench import Bench

CR1, DIER, SR, EGR, CNT, PSC, ARR = 0x00, 0x0C, 0x10, 0x14, 0x24, 0x28, 0x2C
ENABLED, UPDATE_DISABLED, UPDATE_BY_OVERFLOW_ALONE = 1, 2, 4
# Address, core cycles per cycle of its clock, interrupt of its update.
TIMERS = {
    1: (0x4001_0000, 1, 25), 2: (0x4000_0000, 2, 28), 3: (0x4000_0400, 2, 29), 4: (0x4000_0800, 2, 30),
    5: (0x4000_0C00, 2, 50), 6: (0x4000_1000, 2, 54), 7: (0x4000_1400, 2, 55), 8: (0x4001_0400, 1, 44),
    9: (0x4001_4000, 1, 24), 10: (0x4001_4400, 1, 25), 11: (0x4001_4800, 1, 26), 12: (0x4000_1800, 2, 43),
    13: (0x4000_1C00, 2, 44), 14: (0x4000_2000, 2, 45),
}  # fmt: skip
TIM7 = TIMERS[7][0]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def start(bench: Bench, timer: int, prescaler: int = 83, period: int = 99, control: int = ENABLED) -> None:
    bench[timer + PSC], bench[timer + ARR] = prescaler, period
    bench[timer + EGR] = 1  # the prescaler is taken over
    bench[timer + SR] = 0
    bench[timer + CR1] = control


@pytest.mark.parametrize("number", TIMERS)
def test_each_timer_has_its_clock_its_width_and_its_interrupt(bench: Bench, number: int) -> None:
    base, cycles, irq = TIMERS[number]
    wide = number in (2, 5)
    assert bench[base + ARR] == (0xFFFF_FFFF if wide else 0xFFFF)
    bench[base + CR1] = ENABLED
    bench.wait(1000)
    count = 1000 * CYCLES_PER_US // cycles
    assert bench[base + CNT] == (count if wide else count % 0x1_0000)
    bench[base + ARR] = 0x12_0063
    assert bench[base + ARR] == (0x12_0063 if wide else 0x63)
    bench[base + CR1] = 0
    bench[base + CNT] = bench[base + SR] = 0
    bench[base + DIER], bench[base + CR1] = 1, ENABLED
    assert not bench.is_pending(irq)
    bench.wait((0x12_0064 if wide else 0x64) * cycles // CYCLES_PER_US + 1)
    assert bench.is_pending(irq)


def test_a_flag_is_cleared_by_writing_0_and_kept_by_writing_1(bench: Bench) -> None:
    start(bench, TIM7)
    bench.wait(150)
    bench[TIM7 + SR] = 1
    assert bench[TIM7 + SR] & 1 == 1
    bench[TIM7 + SR] = 0
    assert bench[TIM7 + SR] & 1 == 0


@pytest.mark.parametrize(("control", "flag"), [(UPDATE_DISABLED, 0), (UPDATE_BY_OVERFLOW_ALONE, 1)])
def test_an_overflow_is_an_update_unless_updates_are_disabled(bench: Bench, control: int, flag: int) -> None:
    start(bench, TIM7, control=ENABLED | control)
    bench.wait(150)
    assert bench[TIM7 + SR] & 1 == flag


@pytest.mark.parametrize(("control", "flag"), [(0, 1), (UPDATE_DISABLED, 0), (UPDATE_BY_OVERFLOW_ALONE, 0)])
def test_an_update_by_software_sets_the_flag_unless_it_may_not(bench: Bench, control: int, flag: int) -> None:
    bench[TIM7 + CR1] = control
    bench[TIM7 + EGR] = 1
    assert bench[TIM7 + SR] & 1 == flag


def test_a_counter_that_is_set_overflows_after_the_rest_of_its_period(bench: Bench) -> None:
    start(bench, TIM7)
    bench[TIM7 + DIER], bench[TIM7 + CNT] = 1, 90
    bench.wait(9)
    assert not bench.is_pending(55)
    bench.wait(2)
    assert bench.is_pending(55)


def test_a_period_below_the_count_begins_a_new_one(bench: Bench) -> None:
    start(bench, TIM7)
    bench.wait(80)
    bench[TIM7 + ARR] = 49
    assert bench[TIM7 + CNT] == 0
    bench.wait(30)
    assert bench[TIM7 + CNT] == 30
    assert bench[TIM7 + SR] & 1 == 0
    bench.wait(25)
    assert bench[TIM7 + SR] & 1 == 1


def test_a_prescaler_acts_from_the_next_update_on(bench: Bench) -> None:
    start(bench, TIM7)
    bench[TIM7 + DIER] = 1
    bench[TIM7 + PSC] = 167
    bench.wait(60)
    assert bench[TIM7 + CNT] == 60
    bench.wait(60)
    assert bench[TIM7 + CNT] == 10


def test_systick_keeps_its_period_while_code_runs_in_long_blocks() -> None:
    bench = Bench(bytes.fromhex("00bf") * 500 + bytes.fromhex("0ae6"))  # 500 nop; b to the first
    bench[0xE000_E014] = 16_799  # 100 us
    bench[0xE000_E018], bench[0xE000_E010] = 0, 5
    begin = bench.chip.state.now
    bench.wait(10_050)
    late = (bench.chip.state.now - begin) % 16_800
    assert 16_799 - bench[0xE000_E018] == pytest.approx(late, abs=20)


def test_countflag_of_systick_is_set_by_a_period_and_cleared_by_reading(bench: Bench) -> None:
    bench[0xE000_E014], bench[0xE000_E018], bench[0xE000_E010] = 16_799, 0, 5
    assert bench[0xE000_E010] == 5
    bench.wait(101)
    assert bench[0xE000_E010] == 5 | 1 << 16
    assert bench[0xE000_E010] == 5
    bench.wait(100)
    assert bench[0xE000_E010] == 5 | 1 << 16, "it goes on counting"
