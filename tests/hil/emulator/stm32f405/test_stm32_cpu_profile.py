"""Where the cycles of an image go: all of them, to the functions and tasks that the firmware itself counts."""

import re
from types import SimpleNamespace as Record

import numpy as np
import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from firmware_py.export.elf import FLASH
from hil.emulator.stm32f405.cpu_profile import ROOT, Calls, HandlerTimes, Part, Reader
from support.stm32_machine import Profiled

ASSERTION, MASKING, NESTED, SLEEP = 3, 2, 3, 5  # a mistake and three scenarios


def calls_of(calls: Calls, name: str) -> int:
    return calls.calls * (calls.name == name) + sum(calls_of(child, name) for child in calls.children)


def asleep(calls: Calls) -> int:
    return calls.asleep + sum(map(asleep, calls.children))


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_every_cycle_and_call_is_charged_to_the_task_that_the_firmware_counts(compiler: str) -> None:
    firmware = Profiled(compiler)
    profile = firmware.run_with_samples(300_000)
    roots = {one.name.split()[-1]: one for one in profile.roots}
    assert sum(one.total for one in profile.roots) == profile.cycles == firmware.chip.state.now
    assert profile.lost == 0
    assert calls_of(roots["REPORT"], "send_line") == firmware.peek("lines_sent") > 5
    for task in range(2):
        entered = calls_of(roots[f"SPIN-{task}"], "check_fp_registers")
        assert entered - 1 <= firmware.peek("fp_rounds", task) <= entered
    assert calls_of(roots["SysTick_Handler"], "tick") == firmware.peek("xTickCount")
    tasks = {one.name: one for one in profile.tasks}
    assert len(tasks["FILTER"].cycles) == pytest.approx(firmware.peek("samples_taken"), abs=1)
    filtering = tasks["FILTER"]
    # All that it took outside its activations is the one that has not ended.
    assert filtering.cycles.sum() <= roots["FILTER"].total
    assert filtering.cycles.sum() == pytest.approx(roots["FILTER"].total, rel=0.01)
    longest = filtering.longest
    assert longest.us == pytest.approx((filtering.end_us - filtering.begin_us).max())
    assert sum(part.cycles for part in longest.parts) == longest.cycles
    assert longest.cycles + sum(cycles for _, cycles in longest.others) == round(168 * longest.us)
    assert longest.parts[0].name == "filter"
    assert longest.parts[0].hottest.startswith("firmware.c:")
    called = {part.name: part.callers for part in tasks["REPORT"].longest.parts}
    assert called["report"] == ""
    if compiler == "gcc":  # clang puts the call in line
        assert re.fullmatch(r"report \(firmware\.c:\d+\)", called["delay"])
    handlers = {one.name.split()[-1]: one for one in profile.handlers}
    assert handlers["SysTick_Handler"].count == firmware.peek("xTickCount")
    for one in handlers.values():
        assert one.percentiles[0] <= one.percentiles[1] <= one.percentiles[2] <= one.worst
        assert one.cycles == roots[one.name.split()[-1]].total
    (masked,) = profile.masked
    assert masked.by == "BASEPRI"
    assert 20 < masked.cycles < 1000


@pytest.mark.long
def test_cycles_add_up_across_a_reset() -> None:
    firmware = Profiled("clang", planted=ASSERTION)
    profile = firmware.run_with_samples(100_000)
    assert sum(one.total for one in profile.roots) == firmware.chip.state.now
    assert sum(calls_of(one, "Reset_Handler") for one in profile.roots) > 1


@pytest.mark.long
@pytest.mark.parametrize("scenario", [MASKING, NESTED])
def test_masked_interrupts_and_nested_exceptions_are_seen(scenario: int) -> None:
    firmware = Profiled("gcc", scenario=scenario)
    firmware.run(5_000)
    profile = Reader(firmware.image, firmware.chip, [], 0).read()
    assert sum(one.total for one in profile.roots) == firmware.chip.state.now
    masked = {one.by: one for one in profile.masked}
    assert "exceptions.c" in masked["PRIMASK or FAULTMASK"].begin
    assert masked["PRIMASK or FAULTMASK"].cycles < 200
    assert ("BASEPRI" in masked) == (scenario == MASKING)


def test_sleep_is_charged_once_to_the_function_that_waits() -> None:
    """Two waits for the next tick of a millisecond."""
    firmware = Profiled("gcc", scenario=SLEEP)
    firmware.run(5_000)
    profile = Reader(firmware.image, firmware.chip, [], 0).read()
    assert sum(map(asleep, profile.roots)) == firmware.chip.state.sleeping
    assert firmware.chip.state.sleeping == pytest.approx(2 * 168_000, rel=0.01)


def test_a_function_has_the_callers_of_its_longest_call_and_the_cycles_of_all() -> None:
    """`rest` is called by `first` for 30 cycles and by `second` for 7, in the longest activation of a task."""
    first, second, rest = 1, 2, 3
    nodes = [Record(function=of, site=site, parent=up) for of, site, up in (
        (ROOT, 0, 0), (first, 0x10, 0), (second, 0x20, 0), (rest, 0x30, 1), (rest, 0x40, 2), (ROOT + 1, 0, 0),
    )]  # fmt: skip
    worst = Record(
        node=[4, 3, 1, 2, 5],
        recent=[7, 30, 2, 1, 9],
        count=5,
        others=[0, 50, 60],
        begin=1680,
        end=1848,
        cycles=40,
    )
    reader = Reader.__new__(Reader)
    reader._profile, reader._tasks, reader._ahead_us = Record(worst=[worst]), ("A", "B", "C"), 4
    reader._functions = [
        Record(name=name, address=FLASH + 16 * at, size=16)
        for at, name in enumerate(("first", "second", "rest"))
    ]
    reader._line_cycles = np.array(8 * [0] + 8 * [1] + [0, 5, 0, 2, 3, 3, 0, 3])
    reader._image = Record(debug=Record(line_at=lambda address: f"c:{(address - FLASH) // 4}"))
    found = reader._longest(nodes, 0)
    assert found.parts == (
        Part("rest", 37, "c:10", "first (c:11)"),
        Part("first", 2, "", ""),
        Part("second", 1, "c:4", ""),
    )
    assert found.others == (("C", 60), ("B", 50))
    assert (found.begin_us, found.us, found.cycles) == (6.0, 1.0, 40)


@pytest.mark.parametrize(("worst", "last"), [(75, 75), (90, 79)])
def test_percentiles_are_ends_of_bins_of_an_eighth_of_an_octave_but_never_above_the_worst(
    worst: int, last: int
) -> None:
    """Of 100 runs, 50 take at most 11 cycles, 95 at most 51, and 99 at most 79."""
    counts = [0] * 40
    counts[3], counts[10], counts[20], counts[25], counts[30] = 50, 40, 5, 4, 1
    reader = Reader.__new__(Reader)
    reader._tasks, reader._ahead_us = (), 2
    runs = Record(count=100, cycles=900, worst=worst, when=1680, bin=counts)
    reader._profile = Record(service=[Record(count=0), runs])
    reader._chip = Record(state=Record(vtor=FLASH), read=lambda at, size: (at + 1).to_bytes(4, "little"))
    reader._image = Record(function_at=lambda address: f"at {address - FLASH}")
    (found,) = reader._handler_times()
    assert found == HandlerTimes("exception 1 at 4", 100, 900, worst, 8.0, (11, 51, last))
