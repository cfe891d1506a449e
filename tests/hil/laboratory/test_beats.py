"""The loop in C flies what the time line of Python flies, bit for bit."""

from pathlib import Path

import pytest

from firmware_py.export.compilers import compilers
from hil.experiments import EXPERIMENTS
from hil.laboratory import robot
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import in_lockstep
from hil.laboratory.request import Options, Request
from hil.laboratory.run import fly

FLIGHTS: dict[str, Options] = {
    "silent": {"faults": ("imu.silent@0.2:0.15", "imu.freeze@0.6:0.1")},
    "busy": {"faults": ("cpu.load@0.1:0.4=0.7", "radio.cut@0.3:0.2")},
    "plain core": {"board": "python"},
    "serial": {"link": "mavlink"},
    "traced": {"trace": True, "duration_s": 0.3},
}


def flown(options: Options, folder: Path) -> tuple[str, bytes]:
    result = fly(Request.of(EXPERIMENTS["hover"], **{"duration_s": 0.8, **options}), folder)
    return result.hash, (folder / "schedule.parquet").read_bytes()


@pytest.mark.parametrize("options", FLIGHTS.values(), ids=FLIGHTS)
def test_a_flight_in_c_is_that_of_the_time_line(
    options: Options, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_c = flown(options, tmp_path / "c")
    monkeypatch.setattr(robot, "let_beat", lambda *_: False)
    assert flown(options, tmp_path / "python") == in_c


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
