"""Going back in time: a chip's saved state comes back whole, and a search ends where it has to."""

import os
import select
import signal
import socket
import sys
import threading
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hil.emulator.stm32f405 import checkpoints, gdb, image
from hil.emulator.stm32f405.backwards import NEAR, PERIOD, TRAIL, Goal, Position, Search
from hil.emulator.stm32f405.checkpoints import (
    LIMIT,
    SIZE_BYTES,
    Checkpoint,
    Checkpoints,
    _written_files,
    why_none,
)
from hil.emulator.stm32f405.chip import SOFTWARE
from hil.laboratory.lockstep import debugger
from support.flight_backwards import Flight
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


ASSERTION, NULL_CALL = 3, 5  # of `enum planted`
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


def children(pid: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.long
def test_time_runs_backwards_through_the_instants_at_which_it_ran_forward(tmp_path: Path) -> None:
    flight = Flight(tmp_path / "log")
    begin, line = flight.instant(), b"0,%x,2" % flight.place("send_line")
    assert flight.ask(b"Z" + line) == b"OK"
    there = [flight.stop(b"c")[0] for _ in range(7)]
    assert len(children(*children(flight.pid))) == 2  # checkpoints, 50 ms apart
    assert [flight.stop(b"bc") for _ in range(2)] == [(instant, b"T05") for instant in there[-2:-4:-1]]
    steps = [flight.stop(b"bs")[0] for _ in range(3)]
    assert len({there[-3], *steps}) == 4
    assert [flight.stop(b"s")[0] for _ in range(3)] == [*steps[-2::-1], there[-3]]
    assert flight.stop(b"c")[0] == there[-2]
    assert flight.stop(b"bs")[0] not in (*there, *steps)
    assert flight.stop(b"s")[0] == there[-2]
    assert flight.ask(b"z" + line) == b"OK"
    assert [flight.stop(packet) for packet in (b"bc", b"bs")] == [(begin, b"T05replaylog:begin")] * 2
    assert flight.ask(b"Z" + line) == b"OK"
    assert [flight.stop(b"c")[0] for _ in range(7)] == there
    assert flight.end() == 7
    assert flight.path.read_text() == "".join(f"{number}\n" for number in range(1, 131))


@pytest.mark.long
def test_the_way_back_passes_each_access_of_a_watchpoint_and_ends_at_the_last_change(tmp_path: Path) -> None:
    flight = Flight(tmp_path / "log")
    ticks = flight.place("xTickCount")
    watched = b"T05watch:%x" % ticks
    assert flight.ask(b"Z2,%x,4" % ticks) == b"OK"

    def tick(packet: bytes) -> tuple[int, bytes]:
        (_, memory, _), report = flight.stop(packet)
        return int.from_bytes(bytes.fromhex(memory[:8].decode()), "little"), report

    assert [tick(b"c") for _ in range(5)] == [(number, watched) for number in range(5)]
    assert tick(b"bc") == (4, watched)  # behind the access: GDB itself steps back over it
    assert [tick(packet) for packet in (b"bs", b"bc", b"bs", b"c")] == [
        (3, b"T05"), (3, watched), (2, b"T05"), (3, watched),
    ]  # fmt: skip
    assert flight.ask(b"M%x,4:40000000" % ticks) == b"OK"
    assert [tick(b"c") for _ in range(2)] == [(65, watched), (66, watched)]
    assert [tick(packet) for packet in (b"bc", b"bs", b"bc", b"bs")] == [
        (66, watched), (65, b"T05"), (65, watched), (64, b"T05"),
    ]  # fmt: skip
    assert [tick(b"bc") for _ in range(2)] == [(64, b"T05replaylog:begin")] * 2
    assert flight.end() == 7


@pytest.mark.long
@pytest.mark.parametrize(("planted", "at", "before"), [
    (NULL_CALL, "Stuck_Handler", "go_wrong"), (ASSERTION, "assertFail", "go_wrong"),
])  # fmt: skip
def test_a_crash_stops_once_and_the_way_back_leads_to_its_instruction(
    tmp_path: Path, planted: int, at: str, before: str
) -> None:
    flight = Flight(tmp_path / "log", planted)
    crash = flight.stop(b"c")
    assert crash[1] == b"T06"

    def pc() -> int:
        return int.from_bytes(bytes.fromhex(flight.ask(b"pf").decode()), "little")

    assert pc() == flight.place(at)
    flight.ask(b"bs")
    assert flight.image.function_at(pc()) == before
    assert flight.stop(b"s") == (crash[0], b"T05")
    assert flight.end() == 7
    lines = flight.path.read_text().split()
    assert lines.count("crash") == 1  # reported as if there had been no debugger
    assert [line for line in lines if line != "crash"] == [f"{number}" for number in range(1, 131)]


@pytest.mark.long
@pytest.mark.parametrize(("how", "code"), [
    ("interrupted", 130), ("killed", -signal.SIGKILL), ("killed by the debugger", 130), ("hung up", 7),
    ("out of memory", 128 + signal.SIGKILL),
])  # fmt: skip
def test_no_process_of_a_flight_outlives_it(tmp_path: Path, how: str, code: int) -> None:
    flight = Flight(tmp_path / "log")
    assert flight.ask(b"Z0,%x,2" % flight.place("send_line")) == b"OK"
    flight.stop(b"c")
    (flying,) = children(flight.pid)
    assert len(children(flying)) == 1  # the checkpoint at its begin
    if how == "out of memory":
        os.kill(flying, signal.SIGKILL)
    else:
        flight.stop(b"bc")
    if number := {"interrupted": signal.SIGINT, "killed": signal.SIGKILL}.get(how):
        os.kill(flight.pid, number)
    elif how == "hung up":
        flight.line.shutdown(socket.SHUT_RDWR)
    assert flight.end(b"k" if how == "killed by the debugger" else b"") == code


def test_a_flight_that_ends_before_the_process_that_woke_it_has_its_own_exit_code() -> None:
    pid = os.fork()
    if not pid:
        for number, *_ in _written_files():
            os.close(number)
        flown, ends = Checkpoints(), os._exit
        flown.begin()
        if flown.leave_copy((0,), 0) is None:
            os._exit = lambda code: (select.select([], [], [], 0.2), ends(code))  # type: ignore[assignment,return-value]
            flown.wake(flown.kept[0], {"go": "back"})
        flown.finish()
        ends(7)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7


def test_checkpoints_are_the_closer_the_nearer_to_the_present_and_the_oldest_stays() -> None:
    checkpoints, others = Checkpoints(), dict[int, socket.socket]()
    for number in range(1, 10 * LIMIT):
        ours, others[number] = socket.socketpair()
        checkpoints.kept.append(Checkpoint((number,), number * PERIOD, 1, ours))  # 1 is no child of ours
        checkpoints._thin_out(number * PERIOD)
        kept = [one.position[0] for one in checkpoints.kept]
        assert (len(kept), kept[0], kept[-1]) == (min(number, LIMIT), 1, number)
        ages = [number - one for one in kept]
        assert all(older - younger <= 1 + 0.4 * older for older, younger in pairwise(ages))
    told_to_end = {number: other.recv(SIZE_BYTES) for number, other in others.items() if number not in kept}
    assert set(told_to_end.values()) == {bytes(SIZE_BYTES)}
    checkpoints.clear()
    assert [others[number].recv(SIZE_BYTES) for number in kept] == [bytes(SIZE_BYTES)] * len(kept)
    assert (checkpoints.kept, checkpoints._ended) == ([], [])
    for other in others.values():
        other.close()


def test_files_that_may_be_written_get_their_length_back_and_no_others(tmp_path: Path) -> None:
    with ExitStack() as stack:
        before, files = _written_files(), {}
        for mode in ("rb", "r+b", "wb", "ab"):
            (tmp_path / mode).write_bytes(b"content")
            files[mode] = stack.enter_context((tmp_path / mode).open(mode, buffering=0))
        files["r+b"].seek(3)
        files["wb"].write(b"four")
        for end in socket.socketpair():
            stack.enter_context(end)
        found = {number: (size, place) for number, size, place in _written_files()}
        expected = {"r+b": (7, 3), "wb": (4, 4), "ab": (7, 7)}
        known = {number: (size, place) for number, size, place in before}
        assert found == known | {files[mode].fileno(): one for mode, one in expected.items()}


def test_a_process_with_threads_cannot_be_copied_nor_any_of_another_system(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(threading, "active_count", lambda: 2)
    assert why_none() == "the flight's process is copied for it, which its other threads would not survive"
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    assert why_none() == ""
    monkeypatch.setattr(sys, "platform", "darwin")
    assert why_none() == "the flight's process is copied for it, which darwin cannot"


@pytest.mark.parametrize(
    ("forbidden", "copies", "said"),
    [("", "", []), ("it is real", "", ["it is real"]), ("", "threads", ["threads"])],
)
def test_a_debugger_has_checkpoints_unless_something_forbids_them(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    forbidden: str,
    copies: str,
    said: list[str],
) -> None:
    opened: list[Any] = []

    def server(port: int, waiting: Any, kept: Any, from_us: int) -> Any:
        opened.append((port, type(kept), from_us))
        waiting(port + 1)
        return SimpleNamespace(close=lambda: opened.append("closed"))

    monkeypatch.setattr(gdb, "GdbServer", server)
    monkeypatch.setattr(checkpoints, "why_none", lambda: copies)
    monkeypatch.setattr(image, "has_symbols", lambda path: path.suffix == ".elf")
    with ExitStack() as stack:
        assert debugger(None, Path("cf2.bin"), stack) is None
        debugger(3333, Path("my cf2.elf"), stack, forbidden, 70)
    assert opened == [(3333, type(None) if said else Checkpoints, 70), "closed"]
    assert capsys.readouterr().out.splitlines() == [
        *(f"--gdb 3333: time runs forward only: {why}" for why in said),
        "waiting for gdb-multiarch 'my cf2.elf' -ex 'target remote 127.0.0.1:3334'",
    ]
