"""One flight of one robot: the experiment's script and faults, recording, event log, and outcome.

The line makes the robot and connects it to the ground: `hil.laboratory.lockstep` models link and ground station on the
same time line, `hil.servers.linked` connects the robot to a ground station in another process.
"""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from firmware_py.signals import COUNTERS
from firmware_py.wire.supervisor import Cause
from ground_station.trajectory import Trajectory
from hil.board.board_firmware import Executor
from hil.board.clock import Clock
from hil.emulator.events import EventQueue
from hil.laboratory.channels import excitation_channel, fault_channel, flight_channels
from hil.laboratory.faults import Switchboard
from hil.laboratory.files.recorder import SETTINGS, Correct, Recorder
from hil.laboratory.laboratory import Laboratory, Progress
from hil.laboratory.request import Request
from hil.laboratory.robot import PYTHON_BOARD, Robot, Site, Streams
from hil.laboratory.schedule import WINDOW_US, ScheduleTrace
from hil.world.body import Channel

RECORD_PERIOD_US = 10_000
RECORD_PHASE_US = 250  # just after the controller
DROP_NOTE_PERIOD_US = 1_000_000
BROKEN = COUNTERS.index("resets")  # of the estimate
NOT_FINITE = (Cause.CONTROLLER_NOT_FINITE, Cause.ESTIMATOR_NOT_FINITE)


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a flight ended."""

    end_us: int
    lost: str | None  # cause of a crash
    interrupted: bool


class Line(Protocol):
    """A robot, what is between it and the ground, and the ground."""

    correct: Correct | None  # adds to the log what others have recorded

    @property
    def robot(self) -> Robot:
        """The robot at its end."""

    @property
    def trajectory(self) -> Trajectory:
        """The trajectory that the ground station flies."""

    def steer(self, trajectory: Trajectory) -> None:
        """Fly another trajectory from now on. Raises `LabError` where the ground station is another program."""

    def channels(self) -> tuple[tuple[Channel, ...], tuple[Channel, ...]]:
        """Return the channels to record: of the line itself, and of the ground station."""

    def begin(self, release: Callable[[int], None]) -> None:
        """Have the release planned, for an instant that is not over: once, now or when the robot is ready."""

    def command(self, now_us: int, packet: bytes) -> None:
        """Hand the board a CRTP packet of the operator."""

    def listen(self, receive: Callable[[int, bytes], object]) -> None:
        """Pass what the board sends to an operator. Raises `LabError` where the ground station is another program."""

    def new_messages(self, now_us: int) -> list[tuple[str, str]]:
        """Return the messages since the last call: (source, text)."""

    def finish(self, lab: Laboratory) -> None:
        """Let the ground station end in an orderly manner after the flight."""

    def close(self) -> None:
        """Release all resources."""


LineOf = Callable[[Request, Site, Laboratory], Line]  # makes the line of a flight


class Flight:
    """A robot in its tunnel with all that its flight needs; `run` it."""

    def __init__(
        self, request: Request, clock: Clock, line_of: LineOf, executor: Executor = PYTHON_BOARD
    ) -> None:
        self.config = request.config
        self.experiment = request.experiment
        self.faults = request.planned_faults
        self.lab = Laboratory(clock)
        self.lost: str | None = None
        self.logic_failed: str | None = None  # how own logic or the core's estimate failed, and when
        self.over = False
        self._recorder: Recorder | None = None
        self._early: list[tuple[str, str]] = []  # messages from before there was a recorder
        self._release_us: int | None = None
        self._duration_us = round(request.duration_s * 1e6)
        self._trace_all = request.bench.trace
        self._broken_estimates = 0  # since the boot
        self._drops_noted: dict[str, int] = {}
        self._next_drop_note_us = 0
        site = Site(request.config, self.events, Streams.of_seed(request.seed), self.note, executor)
        self.line = line_of(request, site, self.lab)
        with ExitStack() as failing:
            failing.callback(self.line.close)  # which has opened files
            self.robot = self.line.robot
            self.lab.add(self.robot)
            self.switchboard = Switchboard(self.robot)
            request.experiment.prepare(self.robot)
            self.switchboard.prepare(self.faults)
            flashed = self.robot.firmware.flashed
            for text in flashed.notes if flashed is not None else ():
                self.note(SETTINGS, text)
            self.schedule = ScheduleTrace(self.robot.firmware.scheduler)
            self._resets_before = 0  # the release
            self.line.begin(self._plan)
            self.robot.watch(0)
            self.events.every(RECORD_PERIOD_US, RECORD_PHASE_US, self._record)
            failing.pop_all()

    @property
    def events(self) -> EventQueue:
        """The queue of hardware events."""
        return self.lab.events

    @property
    def now_us(self) -> int:
        """The present instant of the simulation."""
        return max(self.lab.now_us, self.events.now_us, self.robot.board.now_us)

    @property
    def resets(self) -> int:
        """How often the board was reset since the release."""
        return self.robot.resets - self._resets_before

    @property
    def end_us(self) -> int:
        """When the flight ends, as far as that is known."""
        return self.lab.end_us

    @property
    def release_us(self) -> int:
        """When the robot is released, once that is planned: its script knows."""
        assert self._release_us is not None
        return self._release_us

    def _plan(self, release_us: int) -> None:
        """Plan everything that counts from the release; it may be now."""
        self._release_us = release_us
        end_us = release_us + self._duration_us
        self.lab.end_at(end_us)
        self.events.at(release_us, self._release)
        self.experiment.script(self)
        self.switchboard.plan(self.faults, release_us, end_us)
        start_us = 0 if self._trace_all and release_us > self.now_us else release_us
        self.events.at(start_us, self.schedule.begin)
        self.events.at(end_us if self._trace_all else start_us + WINDOW_US, self.schedule.end)

    def channels(self) -> tuple[Channel, ...]:
        more = [fault_channel(self.switchboard.active)] if self.faults else []
        if any(self.config.excitation.rms):
            more.append(excitation_channel(self.robot.firmware))
        return flight_channels(self.robot, self.line.trajectory, *self.line.channels(), more)

    def run(self, progress: Progress | None = None, recorder: Recorder | None = None) -> Outcome:
        """Fly to the end, the crash, or Ctrl-C, into a log of `channels`; it is left open for the caller to close."""
        interrupted = False
        self.record_in(recorder)
        try:
            self.lab.run(progress)
        except KeyboardInterrupt:
            interrupted = True
        return self.end(interrupted)

    def record_in(self, recorder: Recorder | None) -> None:
        """Write rows and events into a log of `channels` from now on."""
        self._recorder = recorder
        if recorder is not None:
            self.robot.on_boot(lambda: recorder.read_from(self.channels()))
        early, self._early = self._early, []  # where nothing is recorded, they go there again
        for source, text in early:
            self.note(source, text)

    def end(self, interrupted: bool = False) -> Outcome:
        """Return how the flight ended; its line ends, too."""
        if interrupted:
            self.note("lab", "interrupted by the user")
        flashed = self.robot.firmware.flashed
        for text in flashed.known_findings if flashed is not None else ():
            self.note("board", f"known in Bitcraze's firmware, without effect on the flight: {text}")
        outcome = Outcome(self.now_us, self.lost, interrupted)
        self.over = True
        self.line.finish(self.lab)
        return outcome

    def _release(self, now_us: int) -> None:
        self.robot.release()
        self._resets_before = self.robot.resets
        if self._recorder is not None:
            self._recorder.released(now_us)
        self.note("lab", "released")

    def _record(self, now_us: int) -> None:
        if self.over:
            return
        lost = self.robot.advance_truth(now_us)
        if self._recorder is not None:
            self._recorder.row(now_us)
        self.robot.firmware.check_watchdog()
        self._watch_logic(now_us)
        self._watch_estimate(now_us)
        self._note_drops(now_us)
        for source, text in self.line.new_messages(now_us):
            self.note(source, text)
        for line in self.lab.clock.notices():
            self.note("lab", line)
        if lost is not None:
            self.lost = lost
            self.lab.end_at(now_us)
            self.note("lab", f"lost: {lost}")

    def _watch_logic(self, now_us: int) -> None:
        """Note which of the user's modules first returned NaN or infinity."""
        cause = self.robot.firmware.signals.supervisor.cause
        if self.logic_failed is None and cause in NOT_FINITE:
            what = self.robot.firmware.overrun or f"own {cause.name.lower().replace('_', ' ')}"
            self.logic_failed = f"{what} at {now_us * 1e-6:.2f} s of simulated time: failsafe"
            self.note("lab", self.logic_failed)

    def _watch_estimate(self, now_us: int) -> None:
        """Note when the core's estimate was NaN or infinite: the core begins it again without a message."""
        counters = self.robot.firmware.signals.counters  # empty for firmware without the core
        count = int(counters[BROKEN]) if len(counters) else 0
        if count > self._broken_estimates:
            text = (
                f"the estimate was NaN or infinite at {now_us * 1e-6:.2f} s of simulated time and began again"
            )
            self.note("board", text)
            self.logic_failed = self.logic_failed or text
        self._broken_estimates = count

    def _note_drops(self, now_us: int) -> None:
        """Report which queue drops, at most once per second."""
        scheduler = self.robot.firmware.scheduler
        for queue in scheduler.queues if scheduler is not None else ():
            if queue.dropped > self._drops_noted.get(queue.name, 0) and now_us >= self._next_drop_note_us:
                self.note("board", f"queue {queue.name} is full: {queue.dropped} dropped so far")
                self._drops_noted[queue.name] = queue.dropped
                self._next_drop_note_us = now_us + DROP_NOTE_PERIOD_US

    def note(self, source: str, text: str) -> None:
        """Write a line into the event log."""
        if self._recorder is not None:
            self._recorder.note(self.now_us, source, text)
        else:
            self._early.append((source, text))

    def show_rows(self) -> None:
        """Show who looks on the rows so far."""
        if self._recorder is not None:
            self._recorder.pass_rows()

    def write_schedule(self, folder: Path) -> None:
        """Write the scheduler's trace."""
        self.schedule.end(self.now_us)
        self.schedule.write(folder)

    def close(self) -> None:
        """Close what the line has opened."""
        self.line.close()
