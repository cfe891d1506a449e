"""Executes the panel's commands during a flight in lockstep: time, goal, faults, parameters, notes.

A line takes effect at the next row of the log and is an operator's event: such a flight's request cannot repeat it.
"""

from math import isfinite, radians

from firmware_py.table import OF_PROFILE, CoreParameter
from firmware_py.wire import parameters
from firmware_py.wire.crtp import PORT_PARAMETERS, Packet, decode
from ground_station.controls import ControlsError, Dialogue, Exchange, Script
from ground_station.operator import REACH
from ground_station.trajectory import Goal, Hold
from hil.board.image_settings import board_values
from hil.errors import LabError, hint
from hil.laboratory.faults import parse
from hil.laboratory.files.recorder import OPERATOR
from hil.laboratory.flight import RECORD_PERIOD_US, RECORD_PHASE_US, Flight
from hil.live.feed import LiveView

STEP_MS_MOST = 60_000


class PanelCommands:
    """Executes the lines of a panel during a flight, at the instants of its rows, which changes nothing else."""

    def __init__(self, view: LiveView, flight: Flight, lockstep: bool = True) -> None:
        self._view, self._flight, self._lockstep = view, flight, lockstep
        self._paused = False
        first_us = (flight.now_us // RECORD_PERIOD_US + 1) * RECORD_PERIOD_US + RECORD_PHASE_US
        flight.events.every(RECORD_PERIOD_US, first_us, self._look)
        self._until_us: int | None = None  # of a step
        self._dialogue: Dialogue[Packet] = Dialogue()  # with the board, about a parameter
        self._asked = ""  # the line of it
        self._listens = False
        view.know([*board_values(flight.config).items()])

    def _look(self, now_us: int) -> None:
        """Execute the new lines, and wait while the flight is paused."""
        if self._until_us is not None and now_us >= self._until_us:
            self._paused, self._until_us = True, None
        for line in self._view.lines():
            self._take(line, now_us)
        if (answer := self._dialogue.answer(now_us)) is not None:
            self._view.know(answer.values)
            if answer.error:
                self._view.answer(now_us, f"{self._asked}: {answer.error}")
            else:
                self._flight.note(OPERATOR, self._asked)
        if self._paused:
            self._flight.lab.clock.pause(lambda: self._wait_paused(now_us))

    def _wait_paused(self, now_us: int) -> None:
        self._flight.show_rows()
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
            if word == "set":
                self._set(line, rest.strip(), now_us)
                return  # it is noted when the board has it
            self._do(word, rest.strip(), now_us)
        except LabError as error:
            self._view.answer(now_us, str(error))
            return
        self._flight.note(OPERATOR, line)
        if self._paused:
            self._flight.show_rows()

    def _do(self, word: str, rest: str, now_us: int) -> None:
        if word in ("pause", "step") and not self._lockstep:
            raise LabError(f"{word}: the ground station is a program of its own, which cannot pause")
        if word in ("pause", "go"):
            self._paused = word == "pause"
        elif word == "step":
            (milliseconds,) = _numbers(rest or "10", (1,), "step MS")
            if not 10 <= milliseconds <= STEP_MS_MOST:
                raise LabError(f"step {rest}: expected 10..{STEP_MS_MOST} ms")
            self._until_us = now_us + round(1000 * milliseconds)
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

    def _set(self, line: str, rest: str, now_us: int) -> None:
        """Begin to set a parameter; `_look` takes the answer."""
        name, _, text = rest.partition(" ")
        (value,) = _numbers(text, (1,), "set NAME VALUE")
        one = OF_PROFILE.get(name)
        if one is None:
            raise LabError(f"set {name}: no such parameter; {hint(name, OF_PROFILE)}")
        low, high = one.bounds
        wanted = value / one.scale
        if not (low <= value <= high and (one.scalar.is_float or one.scalar.cast(wanted) == wanted)):
            whole = "" if one.scalar.is_float else ", whole numbers"
            raise LabError(f"{line}: expected {low:g}..{high:g}{whole}")
        if self._dialogue.busy:
            raise LabError(f"{line}: the board has not answered {self._asked!r} yet")
        if not self._listens:
            self._flight.line.listen(self._receive)
            self._listens = True
        self._asked = line
        self._dialogue.begin(now_us, self._written(one, wanted))

    def _receive(self, now_us: int, data: bytes) -> None:
        if self._dialogue.busy:
            self._dialogue.receive(now_us, decode(data))

    def _written(self, one: CoreParameter, value: float) -> Script[Packet]:
        """Set it by its name, which every board with CRTP understands, and return the value."""
        request = parameters.encode_set_by_name(parameters.SetByName(one.name, one.scalar, value))
        begin = parameters.encode_set_by_name_reply(one.name, parameters.OK)[:-1]

        def status(got: Packet) -> int | None:
            return got.data[-1] if got.port == PORT_PARAMETERS and got.data[:-1] == begin else None

        code = yield Exchange(lambda now_us: self._flight.line.command(now_us, request), status)
        if code != parameters.OK:
            raise ControlsError(
                f"the board has no {one.name}" if code == parameters.ENOENT else "the board refuses it"
            )
        return ((one.name, value),)


def _numbers(text: str, counts: tuple[int, ...], usage: str) -> list[float]:
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) not in counts or not all(map(isfinite, numbers)):
        raise LabError(f"{usage.split()[0]} {text}: expected {usage}")
    return numbers
