"""The common time line of robot, cameras, link and station: firmware runs up to the next hardware event, then that happens.

With a wall clock every event waits for its time, and bytes from outside arrive in between. IMU samples are events, so
the firmware acts at most a millisecond late there; its own time is exact. Without one, a robot that `beats` takes the
samples up to the next other event by itself.
"""

from collections.abc import Callable

from hil.board.clock import Clock, FreeRunning
from hil.emulator.events import EndlessInstantError, EventQueue
from hil.errors import refusing
from hil.laboratory.robot import Robot

NEVER_US = 1 << 62
WARM_UP_US = 20_000  # run before any clock starts: the first run on a machine compiles
FREE = FreeRunning()
PROGRESS_PERIOD_US = 250_000

Progress = Callable[[int], None]  # (now_us)


class Laboratory:
    """A robot on its time line; `add` it before `run`. `end_at` may be called while it runs."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.events = EventQueue()
        self.now_us = 0
        self._limit(NEVER_US, NEVER_US)
        self._robot: Robot | None = None

    def add(self, robot: Robot) -> None:
        """Let a robot's firmware run."""
        self._robot = robot

    def run(self, progress: Progress | None = None) -> None:
        """Execute events and firmware in order of time, until `end_us`; may be called again.

        Raises `LabError` when an experiment plans endless events at one instant.
        """
        with refusing("", EndlessInstantError):
            self._run(progress)

    def run_to(self, us: int) -> None:
        """Run like `run`, to an instant at most, for laboratories that run in turn on clocks that do not wait."""
        self._limit(self.end_us, us)
        try:
            self.run()
        finally:
            self._limit(self.end_us, NEVER_US)

    def _limit(self, end_us: int, pause_us: int) -> None:
        self.end_us, self._pause_us, self._until_us = end_us, pause_us, min(end_us, pause_us)

    def _run(self, progress: Progress | None) -> None:
        clock, next_progress_us = self.clock, self.now_us
        self._run_firmware()
        while self.now_us < min(WARM_UP_US, self._until_us):
            self._step(FREE)
        clock.start(self.now_us)
        while self.now_us < self._until_us:
            self._step(clock)
            if progress is not None and self.now_us >= next_progress_us:
                progress(self.now_us)
                next_progress_us = self.now_us + PROGRESS_PERIOD_US
        self._run_firmware()

    def end_at(self, us: int) -> None:
        """End `run` at an instant."""
        self._limit(us, self._pause_us)

    def stop(self) -> None:
        """End `run` after the current instant."""
        self._limit(self.now_us, self._pause_us)

    def _step(self, clock: Clock) -> None:
        """Run the firmware up to the hardware's next event or an earlier input from outside, then that."""
        robot = self._robot
        beats = robot is not None and robot.beats and not clock.paced  # by itself
        until_us = clock.wait_until(self._next_event_us(beats))
        if robot is not None:
            robot.run(self.now_us, until_us - 1)
        now_us = min(until_us, self._next_event_us(beats))  # a task may have triggered an earlier event
        if robot is not None:
            robot.advance(now_us)
        if now_us == until_us:
            clock.serve(now_us)
        self.events.run(now_us, beats)
        self.now_us = now_us
        if clock.paced:  # answers to what is outside do not wait for the next event
            self._run_firmware()

    def _next_event_us(self, beats: bool) -> int:
        """Return the time of the next hardware event that the robot does not run by itself, or the end."""
        next_us, end_us = self.events.other_us if beats else self.events.next_us, self._until_us
        return end_us if next_us is None or next_us > end_us else next_us

    def _run_firmware(self) -> None:
        """Run the firmware of this instant."""
        if self._robot is not None:
            self._robot.run(self.now_us)
