"""Going back in time: a chip's saved state comes back whole, and a search ends where it has to."""

import pytest

from hil.emulator.stm32f405.backwards import NEAR, PERIOD, TRAIL, Goal, Position, Search
from hil.emulator.stm32f405.chip import SOFTWARE
from support.stm32_machine import FirmwareOnChip

END = Position(1, 500, 3, 0x0800_1000, 9_000, 8_000)
BEFORE, BEHIND = (Position(1, 500 + by, 3, 0x0800_1000, 9_000, 8_000) for by in (-1, 1))


def seen(machine: FirmwareOnChip) -> tuple[object, ...]:
    """Everything that the firmware, a debugger or a device can read."""
    chip = machine.chip
    names = [
        *(f"r{number}" for number in range(13)),
        "sp",
        "lr",
        "pc",
        "xpsr",
        "msp",
        "psp",
        "control",
        "basepri",
    ]
    registers = tuple(chip.register(name) for name in names)
    return (
        registers, chip.ram.tobytes(), chip.ccm.tobytes(), machine.eeprom.tobytes(), chip.state.now, chip.state.sleeping,
        chip.state.instructions, chip.resets, chip.read(0x4000_0000, 0x30), chip.passages.sum(),
    )  # fmt: skip


@pytest.mark.parametrize("at_us", [1, 3_217, 20_000])
def test_a_restored_chip_runs_on_as_it_did_from_there(at_us: int) -> None:
    machine = FirmwareOnChip()
    machine.chip.record()

    def run(us: int) -> None:
        while machine.chip.now_us < us:
            machine.run(us)

    run(at_us)
    saved, then = machine.chip.save(), seen(machine)
    run(at_us + 7_000)
    first = seen(machine)
    assert first != then
    machine.eeprom[:] = 0
    machine.chip.reset(SOFTWARE)
    run(at_us + 9_000)
    machine.chip.restore(saved)
    assert seen(machine) == then
    run(at_us + 7_000)
    assert seen(machine) == first


def test_breakpoints_and_watchpoints_stay_when_a_chip_is_restored() -> None:
    machine = FirmwareOnChip()
    tick, count = (machine.image.symbol(name).address for name in ("tick", "xTickCount"))
    saved = machine.chip.save()
    machine.chip.breakpoints.add(tick)
    machine.run(5_000)
    assert machine.chip.register("pc") == tick
    machine.chip.restore(saved)
    machine.run(5_000)
    assert (machine.chip.register("pc"), machine.peek("xTickCount")) == (tick, 0)
    machine.chip.breakpoints.clear()
    machine.chip.watch(2, count, 4, True)
    machine.chip.restore(saved)
    machine.run(5_000)
    assert machine.chip.state.watch_address == count


def test_an_end_is_reached_by_the_instant_of_its_instruction_or_the_one_behind() -> None:
    for goal in Goal:
        search = Search(goal, END)
        after = goal is Goal.AFTER
        assert [search.is_over(one) for one in (BEFORE, END, BEHIND)] == [False, not after, True]
        at_end = goal in (Goal.THERE, Goal.AFTER)
        assert [search.may_begin(one) for one in (BEFORE, END, BEHIND)] == [True, at_end, False]
        assert search.slow_from == (8_000 if goal is Goal.STEP else 9_000)
        search.note(BEFORE, 0x2000_0000)
        search.note(END, 0x2000_0004)
        assert (search.found, search.watched) == (
            (BEFORE, 0x2000_0000) if goal is Goal.STOP else (None, None)
        )
        assert Search.of(search.stored()) == search


def test_the_trail_has_the_last_instants_each_once() -> None:
    search = Search(Goal.STEP, END)
    passed = [Position(1, number, 3, 0x0800_1000, number, number) for number in range(TRAIL + 5)]
    for one in passed:
        search.pass_by(one)
        search.pass_by(one)
    search.pass_by(passed[2])
    assert search.trail == passed[-TRAIL:]
    assert Search.of(search.stored()) == search


FAR = 80 * PERIOD


@pytest.mark.parametrize(
    ("last", "after", "due"),
    [
        (0, 10 * PERIOD - 1, False), (0, 10 * PERIOD, True), (FAR - 16 * PERIOD, 2 * PERIOD - 1, False),
        (FAR - 16 * PERIOD, 2 * PERIOD, True), (FAR - 4 * PERIOD, PERIOD - 1, False), (FAR - 4 * PERIOD, PERIOD, True),
        (FAR - 3 * NEAR, 2 * NEAR - 1, False), (FAR - 3 * NEAR, 2 * NEAR, True), (FAR - NEAR, NEAR, False),
        (FAR - NEAR - 1, NEAR + 1, True), (FAR - NEAR - 1, NEAR + 2, False),
    ],
)  # fmt: skip
def test_checkpoints_are_an_eighth_of_the_way_apart_at_least_a_period_and_one_is_near_the_end(
    last: int, after: int, due: bool
) -> None:
    search = Search(Goal.THERE, Position(0, 1, 0, 0, FAR, FAR))
    assert search.is_due(last, last + after) is due
