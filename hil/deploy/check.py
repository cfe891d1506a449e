"""Flights that run every implementation of the flight core in parallel and compare them after every call.

The reference is the board of all other flights: the core as C for this machine. The targets are the same source as plain
Python, as C with less optimisation, and as machine code of the Cortex-M4. After its last step a flight makes the two
calls of a board whose controller has stopped and which then flies by another gyro.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Unpack

from firmware_py.config import LogicConfig
from firmware_py.core_runner import CoreBlocks, CoreRunner, RunnerFactory
from firmware_py.export.errors import ExportError
from firmware_py.export.side_by_side import ComparedTarget, SideBySide
from firmware_py.rtos import TaskError, WatchdogError
from firmware_py.wire.supervisor import Cause, State
from ground_station.errors import LinkError
from hil.board.board_firmware import PythonBoard
from hil.deploy.drill import DRILL, FAILURE
from hil.errors import LabError
from hil.laboratory.experiment import Experiment
from hil.laboratory.experiments import EXPERIMENTS, find_experiment
from hil.laboratory.experiments.position import HOVER
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import Fault, parse
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.request import Options, Request

DEFAULT = ("hover", "yaw-step")  # and the one with faults: 10 000 ticks in all
LATER_US = 1_000_000  # without a step of the supervisor: it has lost the controller
LONGEST_S = 60.0  # of an experiment with --all: `endurance` takes half an hour
FAULTY_S = 65.0
FAULTS = (
    "mocap.dropout@2:0.5", "mocap.outlier@5", "mocap.swap@8", "radio.cut@11:0.3", "push.y@14=2", "push.yaw@17=0.05",
    "imu.freeze@20", "imu.bias.r@23:3=10", "radio.loss@28:4=0.5", "mocap.latency@35:4=70", "servo.slow.2@42:4=0.5",
    "radio.jitter@48:4=15", "wind.occlusion@54=0.1", "imu.saturation@57:3=20",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Checked:
    """One flight and the results of its targets."""

    request: Request
    outcome: str  # completed, lost (and why), interrupted, error (and which)
    targets: tuple[ComparedTarget, ...]
    reached: frozenset[tuple[State, Cause]]  # by the supervisor

    @property
    def failed(self) -> bool:
        """Whether a board did not fly to the end."""
        return self.outcome.startswith("error")

    @property
    def equal(self) -> bool:
        """Whether all targets are equal bit for bit."""
        return all(target.divergence is None for target in self.targets)


def check_flight(
    request: Request,
    factories: Callable[[ExitStack], dict[str, RunnerFactory]],
    progress: Callable[[int, Flight], None],
) -> Checked:
    """Fly once with all targets beside the board; Ctrl-C ends the flight early with the outcome "interrupted".

    Raises `LabError` when a target cannot be started.
    """
    made: list[SideBySide] = []
    with ExitStack() as stack:
        targets = factories(stack)

        def side_by_side(blocks: CoreBlocks) -> CoreRunner:
            try:
                made.append(SideBySide(blocks, targets))
            except (ExportError, LinkError) as error:
                raise LabError(str(error)) from None
            return made[0]

        flight = lockstep_flight(request, executor=PythonBoard(side_by_side))
        try:
            end = flight.run(lambda now_us: progress(now_us, flight))
            outcome = "interrupted" if end.interrupted else f"lost: {end.lost}" if end.lost else "completed"
            made[0].blocks.data.fields.now_us += LATER_US
            for name in ("watch_control", "restart"):
                made[0].call(name)
        except WatchdogError as error:
            outcome = f"lost: {error}"
        except LinkError as error:
            outcome = f"error: board {error}"
        except TaskError as error:
            if not isinstance(error.__cause__, LinkError):
                raise
            outcome = f"error: board {error.__cause__}"
        finally:
            flight.close()
    reached = frozenset((State(state), Cause(cause)) for state, cause in made[0].reached)
    return Checked(request, outcome, tuple(made[0].targets), reached)


def reached(checked: Sequence[Checked]) -> tuple[str, str]:
    """Return the supervisor's states and causes that flights reached, and those that none reached, as text."""
    states, causes = map(set, zip(*{pair for one in checked for pair in one.reached}, strict=True))
    there = {_word(state): state in states for state in State}
    there |= {_word(cause): cause in causes for cause in Cause if cause}
    seen = (name for name, was_there in there.items() if was_there)
    return ", ".join(seen), ", ".join(name for name, was_there in there.items() if not was_there)


def _word(one: State | Cause) -> str:
    return one.name.lower().replace("_", " ")


def plan(
    experiment: str | None, every: bool, own_logic: bool = True, **options: Unpack[Options]
) -> list[Request]:
    """Return the flights to check: one experiment, every one, or by default hover and yaw step.

    All but the first also include a hover with the faults that act on the robot, and flights through the supervisor's
    states. Causes that only user logic has need targets built for it (`own_logic`), and a profile without any.
    """
    duration_s, faults = options.get("duration_s"), options.get("faults", ())
    if every and experiment is not None:
        raise LabError(f"{experiment} and --all: one or the other")
    if faults and experiment is None:
        raise LabError(f"--fault {faults[0]}: for which EXPERIMENT?")

    def request(one: Experiment, length_s: float | None, faults: Sequence[Fault | str] = ()) -> Request:
        chosen: Options = {**options, "duration_s": length_s, "faults": faults}
        return Request.of(one, **chosen)

    if experiment is not None:
        return [request(find_experiment(experiment), duration_s, faults)]
    if every:
        flights = [request(one, duration_s or min(one.duration_s, LONGEST_S)) for one in EXPERIMENTS.values()]
    else:
        flights = [request(find_experiment(name), duration_s) for name in DEFAULT]
    length_s, body = duration_s or FAULTY_S, flights[0].config.robot.body
    faulty = [one for one in map(parse, FAULTS) if one.start_s < length_s and KINDS[one.kind].acts_on(body)]
    flights += request(HOVER, length_s, faulty), request(DRILL, None)
    if own_logic and flights[0].config.logic == LogicConfig():
        flights.append(request(FAILURE, None))
    return flights
