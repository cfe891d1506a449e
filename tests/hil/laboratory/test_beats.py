"""The loop in C flies what the time line of Python flies, bit for bit."""

import hashlib
from collections.abc import Callable, Generator
from pathlib import Path

import pytest

from firmware_py.export.compilers import compilers
from firmware_py.rtos import Kernel
from firmware_py.tasks import FlightTasks
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import in_lockstep
from hil.laboratory.request import Options, Request
from hil.laboratory.run import fly

RELEASE = ("flight.release_us=200000",)
FLIGHTS: dict[str, Options] = {
    "silent": {"faults": ("imu.silent@0.2:0.15", "imu.freeze@0.6:0.1")},
    "busy": {"faults": ("cpu.load@0.1:0.4=0.7", "radio.cut@0.3:0.2")},
    "plain core": {"board": "python", "duration_s": 0.1},
    "serial": {"link": "mavlink"},
    "traced": {"trace": True, "duration_s": 0.3},
}


def greedy(kernel: Kernel) -> Generator[int, None, None]:
    """Block interrupts, so that samples are missed."""
    while True:
        yield from kernel.delay(70)
        kernel.enter_critical()
        yield from kernel.work(2500)
        yield from kernel.exit_critical()


def with_greedy_task(flight: Flight) -> None:
    kernel = flight.robot.firmware.scheduler
    assert isinstance(kernel, Kernel)
    kernel.create_task("GREEDY", 3, greedy, kernel)


def without_power(flight: Flight) -> None:
    """Cut the power for a while; nothing is measured then."""
    board, kept = flight.robot.board, []
    flight.events.at(400_300, lambda _: flight.robot.cut_power())
    flight.events.at(401_000, lambda _: kept.extend(board.imu.tolist()))
    flight.events.at(450_000, lambda _: kept.append(board.imu.tolist() == kept))
    flight.events.at(450_700, lambda now_us: (flight.robot.boot(now_us), kept.append(True)))
    flight.events.at(500_000, lambda _: kept.append(board.imu.tolist() != kept[:6]))
    flight.events.at(500_000, lambda _: flight.note("lab", f"kept: {kept[6:]}"))


CHANGES: dict[str, Callable[[Flight], None]] = {"greedy": with_greedy_task, "no power": without_power}


def flown(options: Options, folder: Path, change: Callable[[Flight], None] | None = None) -> tuple[str, ...]:
    def made(*arguments: object) -> Flight:
        flight = in_lockstep(*arguments)  # type: ignore[arg-type]
        if change is not None:
            change(flight)
        return flight

    request = Request.of(EXPERIMENTS["hover"], **{"duration_s": 0.8, "overrides": RELEASE, **options})
    result = fly(request, folder, flight_of=made)
    schedule = hashlib.sha256((folder / "schedule.parquet").read_bytes()).hexdigest()
    return result.hash, schedule, (folder / "events.jsonl").read_text()


@pytest.mark.long
@pytest.mark.parametrize("options", FLIGHTS.values(), ids=FLIGHTS)
def test_a_flight_in_c_is_that_of_the_time_line(
    options: Options, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_c = flown(options, tmp_path / "c")
    monkeypatch.setattr(FlightTasks, "take_beats", lambda *_: False)
    assert flown(options, tmp_path / "python") == in_c


@pytest.mark.long
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_changed_board_is_the_same_in_c_and_on_the_time_line(
    change: Callable[[Flight], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_c = flown({}, tmp_path / "c", change)
    assert change is not without_power or "kept: [True, True, True]" in in_c[2]
    assert in_c[0] != flown({}, tmp_path / "usual")[0]
    monkeypatch.setattr(FlightTasks, "take_beats", lambda *_: False)
    assert flown({}, tmp_path / "python", change) == in_c


@pytest.mark.long
@pytest.mark.skipif(not any(compilers()), reason="no C compiler")
def test_the_robot_takes_every_sample_by_itself(tmp_path: Path) -> None:
    """Otherwise the same flight takes twice as long."""
    events_ran = 0

    def made(*arguments: object) -> Flight:
        flight = in_lockstep(*arguments)  # type: ignore[arg-type]
        sample = flight.robot._sample

        def count(now_us: int) -> None:
            nonlocal events_ran
            events_ran += 1
            sample(now_us)

        flight.events._beat_callback = count
        return flight

    fly(Request.of(EXPERIMENTS["hover"], duration_s=0.5), tmp_path / "run", flight_of=made)
    assert events_ran < 20  # those at the instant of another event
