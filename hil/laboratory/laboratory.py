"""The common time line of robots, cameras, links and stations: hardware events advance time, then firmware runs.

Without a wall clock the firmware runs up to the next hardware event. With one, every event waits for its time, and bytes
from outside arrive in between.
"""

from collections.abc import Callable

from hil.clock import Clock, FreeRunning
from hil.errors import refusing
from hil.events import EndlessInstantError, EventQueue
from hil.laboratory.robot import Robot

NEVER_US = 1 << 62
WARM_UP_US = 20_000  # run before any clock starts: the first run on a machine compiles
FREE = FreeRunning()
PROGRESS_PERIOD_US = 250_000

Progress = Callable[[int], None]  # (now_us)


class Laboratory:
    """Robots on one time line; `add` them before `run`. `end_at` may be called while it runs."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.events = EventQueue()
        self.robots: list[Robot] = []
        self.now_us = 0
        self.end_us = NEVER_US

    def run(self, progress: Progress | None = None) -> None:
        """Execute events and firmware in order of time, until `end_us`; may be called again.

        Raises `LabError` when an experiment plans endless events at one instant.
        """
        with refusing("", EndlessInstantError):
            self._run(progress)

    def _run(self, progress: Progress | None) -> None:
        clock, next_progress_us = self.clock, self.now_us
        self._run_firmware()
        while self.now_us < min(WARM_UP_US, self.end_us):
            self._step(FREE)
        clock.start(self.now_us)
        alone = not clock.paced and len(self.robots) == 1
        while self.now_us < self.end_us:
            if alone:
                self._step_alone()
            else:
                self._step(clock)
            if progress is not None and self.now_us >= next_progress_us:
                progress(self.now_us)
                next_progress_us = self.now_us + PROGRESS_PERIOD_US
        self._run_firmware()

    def end_at(self, us: int) -> None:
        """End `run` at an instant."""
        self.end_us = us

    def stop(self) -> None:
        """End `run` after the current instant."""
        self.end_us = self.now_us

    def _step_alone(self) -> None:
        """Run the only robot's firmware up to the hardware's next event, then that event."""
        robot = self.robots[0]
        robot.run(self.now_us, self._next_event_us() - 1)
        now_us = self._next_event_us()
        robot.advance(now_us)
        self.events.run(now_us)
        self.now_us = now_us

    def _step(self, clock: Clock) -> None:
        events = self.events
        now_us = self._next_event_us()
        robot, wake_us, other_us = self._first_to_wake()
        if robot is not None and wake_us < now_us:
            if clock.paced:
                now_us = wake_us
            else:
                robot.run(max(wake_us, min(now_us, other_us) - 1))
                if other_us < now_us or (events.next_us is not None and events.next_us < now_us):
                    return  # another robot is next, or a task has triggered an earlier hardware event
        if clock.paced:
            now_us = clock.wait_until(now_us)
        for robot in self.robots:
            robot.advance(now_us)
        if clock.paced:
            clock.serve(now_us)
        events.run(now_us)
        self.now_us = now_us
        self._run_firmware()

    def _next_event_us(self) -> int:
        """Return the next hardware event's time, or the end."""
        next_us, end_us = self.events.next_us, self.end_us
        return end_us if next_us is None or next_us > end_us else next_us

    def _run_firmware(self) -> None:
        """Run the firmware of this instant."""
        for robot in self.robots:
            robot.run(self.now_us)

    def _first_to_wake(self) -> tuple[Robot | None, int, int]:
        """Return the robot whose firmware acts first, its time, and the time of the next robot."""
        first, first_us, next_us = None, NEVER_US, NEVER_US
        for robot in self.robots:
            wake_us = robot.next_wake_us
            if wake_us is None:
                continue
            if wake_us < first_us:
                first, first_us, next_us = robot, wake_us, first_us
            elif wake_us < next_us:
                next_us = wake_us
        return first, first_us, next_us
