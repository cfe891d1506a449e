"""The timers and SysTick by their registers, as RM0090 has them (chapters 17 to 20 and the vector table of chapter 12)."""

import numpy as np
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
TIM7, CLEARED = TIMERS[7][0], 0xE000_E280


@pytest.fixture
def bench() -> Bench:
    return Bench()


def start(bench: Bench, timer: int, prescaler: int = 83, period: int = 99, control: int = ENABLED) -> None:
    bench[timer + PSC], bench[timer + ARR] = prescaler, period
    bench[timer + EGR] = 1  # the prescaler is taken over
    bench[timer + SR] = 0
    bench[timer + CR1] = control


@pytest.mark.long
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


@pytest.mark.long
@pytest.mark.parametrize("number", TIMERS)
def test_a_timer_counts_and_requests_as_a_model(number: int) -> None:
    """Whatever is written in between; the model counts tick by tick."""
    base, cycles, irq = TIMERS[number]
    bench, rng = Bench(), np.random.default_rng(number)
    count, period, divider, control, enabled, flag = 0, 99, 84, 0, 0, 0
    start(bench, base, divider - 1, period, control)
    for _ in range(120):
        kind = rng.integers(9)
        if kind == 0:
            control = bench[base + CR1] = int(rng.integers(8))
        elif kind == 1:
            flag &= int(rng.integers(2))
            bench[base + SR] = flag
        elif kind == 2:
            divider = int(rng.choice((7, 21, 42, 84)))
            bench[base + PSC] = divider - 1
            bench[base + EGR] = 1
            count, flag = 0, flag | (control & (UPDATE_DISABLED | UPDATE_BY_OVERFLOW_ALONE) == 0)
        elif kind == 3:
            enabled = bench[base + DIER] = int(rng.integers(2))
        elif kind == 4:
            count = bench[base + CNT] = int(rng.integers(period + 1))
        elif kind == 5:  # below the count a new period begins
            period = bench[base + ARR] = max(1, int(rng.choice((count, rng.integers(1, 300)))))
            count = 0 if count > period else count
        else:
            us = int(rng.integers(1, 60))
            bench.wait(us)
            for _ in range(us * CYCLES_PER_US // (cycles * divider) * (control & ENABLED)):
                flag |= count == period and not control & UPDATE_DISABLED
                count = 0 if count == period else count + 1
        found = [bench[base + place] for place in (CNT, SR, CR1, DIER, PSC, ARR)]
        assert found == [count, flag, control, enabled, divider - 1, period]
        bench[CLEARED] = bench[CLEARED + 4] = 0xFFFF_FFFF
        assert bench.is_pending(irq) == bool(flag and enabled)


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


@pytest.mark.parametrize(("control", "per_us"), [(5, 168), (1, 21)])
def test_systick_counts_down_and_flags_its_periods(bench: Bench, control: int, per_us: int) -> None:
    """With the core's clock or an eighth of it; COUNTFLAG is cleared by reading."""
    load, left = 100 * per_us - 1, 0
    bench[0xE000_E014], bench[0xE000_E018], bench[0xE000_E010] = load, 0, control
    for us in (0, 40, 59, 1, 100, 99, 250, 3):
        bench.wait(us)
        left += us
        assert bench[0xE000_E018] == load - left * per_us % (load + 1)
        assert bench[0xE000_E010] == control | (left >= 100) << 16
        assert bench[0xE000_E010] == control
        left %= 100
    for place, flag in (
        (0xE000_E010, 1),
        (0xE000_E018, 0),
    ):  # a write to the count clears it, one to its control does not
        bench.wait(101)
        bench[place] = control
        assert bench[0xE000_E010] == control | flag << 16
        assert bench[0xE000_E018] == load, "it counts from the reload value"
