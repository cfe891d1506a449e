"""What is pressed in the panel while a flight in lockstep is watched: time, goal, faults, notes.

A line acts at the next row of the log and is an event of the operator's: such a flight cannot be repeated by its request.
"""

from math import isfinite, radians

from ground_station.operator import REACH
from ground_station.trajectory import Goal, Hold
from hil.errors import LabError
from hil.laboratory.faults import parse
from hil.laboratory.flight import RECORD_PERIOD_US, RECORD_PHASE_US, Flight
from hil.laboratory.recorder import OPERATOR
from hil.live.feed import LiveView

STEP_MS_MOST = 60_000


class Hand:
    """Carries out the lines of a panel at a flight that flies; at the instants of its rows, which changes nothing else."""

    def __init__(self, view: LiveView, flight: Flight, lockstep: bool = True) -> None:
        self._view, self._flight, self._lockstep = view, flight, lockstep
        self._paused = False
        first_us = (flight.now_us // RECORD_PERIOD_US + 1) * RECORD_PERIOD_US + RECORD_PHASE_US
        flight.events.every(RECORD_PERIOD_US, first_us, self._look)
        self._until_us: int | None = None  # of a step

    def _look(self, now_us: int) -> None:
        """Do what was pressed, and stand still while the flight is paused."""
        if self._until_us is not None and now_us >= self._until_us:
            self._paused, self._until_us = True, None
        for line in self._view.lines():
            self._take(line, now_us)
        if self._paused:
            self._flight.lab.clock.pause(lambda: self._stand(now_us))

    def _stand(self, now_us: int) -> None:
        self._flight.show()
        while self._paused:
            lines = self._view.wait()
            if not lines:  # the panel has gone
                self._paused = False
            for line in lines:
                self._take(line, now_us)

    def _take(self, line: str, now_us: int) -> None:
        word, _, rest = line.partition(" ")
        if word == "stop":
            raise KeyboardInterrupt
        try:
            self._do(word, rest.strip(), now_us)
        except LabError as error:
            self._view.answer(now_us, str(error))
            return
        self._flight.note(OPERATOR, line)
        if self._paused:
            self._flight.show()

    def _do(self, word: str, rest: str, now_us: int) -> None:
        if word in ("pause", "step") and not self._lockstep:
            raise LabError(f"{word}: the ground station is a program of its own, which does not stand still")
        if word in ("pause", "go"):
            self._paused = word == "pause"
        elif word == "step":
            (milliseconds,) = _numbers(rest or "10", (1,), "step MS")
            if not 10 <= milliseconds <= STEP_MS_MOST:
                raise LabError(f"step {rest}: expected 10..{STEP_MS_MOST} ms")
            self._until_us = now_us + max(RECORD_PERIOD_US, round(1000 * milliseconds))
            self._paused = False
        elif word == "goal":
            x, y, z, *yaw = _numbers(rest, (3, 4), "goal X Y Z [YAW], metres in W and degrees")
            home = self._flight.config.flight.home
            if max(abs(a - b) for a, b in zip((x, y, z), home, strict=True)) > REACH:
                raise LabError(
                    f"goal {rest}: more than {REACH:g} m from home, {' '.join(f'{one:g}' for one in home)}"
                )
            turn = radians(yaw[0]) if yaw else self._flight.line.trajectory.at(now_us).yaw
            self._flight.line.steer(Hold(Goal((x, y, z), turn)))
        elif word == "clear":
            for fault in self._flight.switchboard.active.copy():
                self._flight.switchboard.end(fault, now_us)
        elif word != "mark":
            self._flight.switchboard.act(parse(f"{word} {rest}".strip(), live=True), now_us)


def _numbers(text: str, counts: tuple[int, ...], usage: str) -> list[float]:
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) not in counts or not all(map(isfinite, numbers)):
        raise LabError(f"{usage.split()[0]} {text}: expected {usage}")
    return numbers
