"""The operator's input while a board flies: a line, an act, an event.

A request to the board is answered while poses are sent; the next line waits for the answer, but `stop` does not wait. A
refused request is one line and changes nothing. `say` prints answers at the terminal, `note` records actions.
"""

import shlex
from collections import deque
from collections.abc import Callable, Generator, Sequence
from difflib import get_close_matches
from functools import partial
from math import degrees, hypot, isfinite, radians

from firmware_py.table import OF_PROFILE, on_board
from firmware_py.wire.supervisor import State
from ground_station.config import GroundConfig
from ground_station.controls import Answer, ControlAction, ControlRequest, ControlsError, Settings
from ground_station.errors import LinkError, MocapError
from ground_station.program import LoopHook, Session, StationSession, fly, run_until, why
from ground_station.stops import stop_signals
from ground_station.terminal import Terminal
from ground_station.trajectory import Goal, Hold, Trajectory

HELP = """goal X Y Z [YAW]     fly to a place in W [m, deg]; without YAW it is unchanged
fly NAME             fly the trajectory of an experiment from here on
set NAME VALUE       change a parameter: set controller.gain_y -2.0, set extCtrl.y_P 2.0
get NAME             show a parameter
params [GROUP]       show all, or those whose names begin with GROUP
save                 keep the parameters for the board's next boot
reset                set changed parameters to the values that last flew well
arm                  recover where that is possible, and arm
stop                 emergency stop: flaps at hover, until the board reboots
mark TEXT            add a note to the record
help                 show this list"""
COMMANDS = tuple(line.split()[0] for line in HELP.splitlines())
LINES = 100  # waiting for execution
REACH = 1.0  # [m] from home, beyond which a goal is refused as a mistake: the tunnel is 1.2 m wide
# Values count as good after the robot has kept within this distance [m] of its goal for this long with them.
WELL, WELL_US = 0.10, 5_000_000

# A dialogue with the board; returns the action, empty if there is nothing to note.
Talk = Generator[ControlRequest, Settings, str]
FindTrajectory = Callable[[str], Callable[[Goal, int], Trajectory]]


class Operator:
    """Call `take` for each line and `turn` in every turn of the station's loop.

    `find` returns the trajectory of a name, or raises `ControlsError`. `know`, if given, is called with every known value
    of a parameter, all of them at first.
    """

    def __init__(
        self,
        find: FindTrajectory,
        say: Callable[[str], None],
        note: Callable[[str], None],
        know: Callable[[Settings], None] | None = None,
    ) -> None:
        self._find = find
        self._say = say
        self._note = note
        self._know = know
        self._is_learning = know is not None  # all parameters are still to be requested
        self._lines: deque[str] = deque()
        self._talk: Talk | None = None
        self._line = ""  # being executed
        self._set: dict[str, float] = {}  # changed values, by the names of the link
        self._good: dict[str, float] = {}  # those of them that last flew well
        self._well_since_us: int | None = None
        self.known: Sequence[str] = tuple(OF_PROFILE)  # names of parameters, for completion

    def queue_line(self, line: str) -> None:
        """Queue a line for execution."""
        if line.strip() == "stop":
            self._lines.clear()
            self._lines.append(line)
            self._talk = None
        elif len(self._lines) < LINES:
            self._lines.append(line)
        else:
            self._say(f"{line}: {LINES} lines wait already; it is dropped")

    def process_lines(self, session: StationSession, now_us: int) -> None:
        """Continue the present line, or begin the next."""
        self._watch(session, now_us)
        if self._talk is not None:
            answer = session.link.answer(now_us)
            if answer is not None:
                self._on_answer(session, now_us, answer)
        elif self._lines:
            self._begin(self._lines.popleft(), session, now_us)
        elif self._is_learning and session.link.supervisor_state is not None:
            self._is_learning = False
            self._line, self._talk = "parameters", self._learn()
            self._go_on(session, now_us, None)

    def _begin(self, line: str, session: StationSession, now_us: int) -> None:
        line = self._line = line.strip()
        try:
            words = line.split(None, 1) if line.startswith("mark ") else shlex.split(line)
            if not words:
                return
            self._execute(words[0], words[1:], session, now_us)
        except (ControlsError, ValueError) as error:
            self._refuse(str(error))

    def _execute(self, command: str, words: list[str], session: StationSession, now_us: int) -> None:
        """Execute a line at once, or begin its dialogue with the board."""
        at_once: dict[str, Callable[[], str]] = {
            "goal": lambda: self._goal(words, session, now_us),
            "fly": lambda: self._fly(words, session, now_us),
            "mark": lambda: f"mark {_words(words, 'mark TEXT', 1)[0].strip()}",
            "help": self._help,
        }
        talks: dict[str, Callable[[list[str]], Talk]] = {
            "set": self._write,
            "get": self._read,
            "params": self._list,
            "reset": self._reset,
            **dict.fromkeys(("save", "arm", "stop"), partial(self._ask, command)),
        }
        if command in at_once:
            self._finish(at_once[command]())
        elif command in talks:
            self._talk = talks[command](words)
            self._go_on(session, now_us, None)
        else:
            near = get_close_matches(command, COMMANDS, 1)
            hint = f"did you mean {near[0]}?" if near else "help lists the commands"
            raise ControlsError(f"unknown; {hint}")

    def _on_answer(self, session: StationSession, now_us: int, answer: Answer) -> None:
        try:
            if answer.error:
                raise ControlsError(answer.error)
            if self._know is not None:
                self._know(answer.values)
            self._go_on(session, now_us, answer.values)
        except ControlsError as error:
            self._refuse(str(error))

    def _refuse(self, why: str) -> None:
        self._talk = None
        self._say(f"{self._line}: {why}")

    def _go_on(self, session: StationSession, now_us: int, values: Settings | None) -> None:
        assert self._talk is not None
        try:
            request = next(self._talk) if values is None else self._talk.send(values)
        except StopIteration as done:
            self._talk = None
            self._finish(done.value)
        else:
            session.link.ask(now_us, request)

    def _finish(self, done: str) -> None:
        """Record and show an action, if there is something to note."""
        if done:
            self._note(done)
            self._say(done)

    # The commands

    def _goal(self, words: list[str], session: StationSession, now_us: int) -> str:
        numbers = [_number(word) for word in words]
        if len(numbers) not in (3, 4):
            raise ControlsError("expected goal X Y Z [YAW], metres in W and degrees")
        place = (numbers[0], numbers[1], numbers[2])
        home = session.plan.home.p_WG
        if max(abs(a - b) for a, b in zip(place, home, strict=True)) > REACH:
            raise ControlsError(f"more than {REACH:g} m from home, {' '.join(f'{x:g}' for x in home)}")
        yaw = radians(numbers[3]) if len(numbers) == 4 else session.plan.at(now_us).yaw
        session.plan.steer(Hold(Goal(place, yaw)))
        return f"goal {' '.join(f'{x:g}' for x in place)} m, yaw {degrees(yaw):.4g} deg"

    def _fly(self, words: list[str], session: StationSession, now_us: int) -> str:
        (name,) = _words(words, "fly NAME", 1)
        session.plan.steer(self._find(name)(session.plan.home, now_us))
        return f"fly {name}"

    def _write(self, words: list[str]) -> Talk:
        typed, text = _words(words, "set NAME VALUE", 2)
        (name, factor), value = on_board(typed), _number(text)
        ((known, before),) = yield ControlRequest(ControlAction.READ, name)
        ((known, after),) = yield ControlRequest(ControlAction.WRITE, name, factor * value)
        self._good.setdefault(known, before)
        self._set[known] = after
        self._well_since_us = None
        own = f" ({known} {after:.6g})" if known != typed else ""
        return f"set {typed} {after / factor:.6g}, was {before / factor:.6g}{own}"

    def _read(self, words: list[str]) -> Talk:
        (typed,) = _words(words, "get NAME", 1)
        name, factor = on_board(typed)
        ((known, value),) = yield ControlRequest(ControlAction.READ, name)
        own = f" ({known} {value:.6g})" if known != typed else ""
        self._say(f"{typed} {value / factor:.6g}{own}")
        return ""

    def _learn(self) -> Talk:
        yield ControlRequest(ControlAction.LIST)
        return ""

    def _list(self, words: list[str]) -> Talk:
        group = words[0].lower() if words else ""
        values = yield ControlRequest(ControlAction.LIST, group)
        self.known = tuple(dict.fromkeys((*self.known, *(name for name, _ in values))))
        chosen = [f"{name} {value:.6g}" for name, value in values if name.lower().startswith(group)]
        if not chosen:
            raise ControlsError(f"params {words[0]}: no parameter begins with that")
        for line in chosen:
            self._say(line)
        return ""

    def _ask(self, command: str, words: list[str]) -> Talk:
        _words(words, command, 0)
        if command == "stop":
            self._note("stop")  # acknowledged or not
        yield ControlRequest(ControlAction(command))
        done = {"save": "saved", "arm": "armed", "stop": "stopped"}
        return done[command]

    def _reset(self, words: list[str]) -> Talk:
        _words(words, "reset", 0)
        changed = {name: value for name, value in self._good.items() if self._set[name] != value}
        if not changed:
            raise ControlsError("nothing to reset: the values that are set are those that last flew well")
        for name, value in changed.items():
            ((_, self._set[name]),) = yield ControlRequest(ControlAction.WRITE, name, value)
            self._well_since_us = None  # the others have not flown with it
        return "reset " + ", ".join(f"{name} {value:.6g}" for name, value in changed.items())

    def _help(self) -> str:
        for line in HELP.splitlines():
            self._say(line)
        return ""

    def _watch(self, session: StationSession, now_us: int) -> None:
        """Remember values that have flown well for a while."""
        frame, flying = session.ground.frame, session.link.supervisor_state == State.FLYING
        goal = session.plan.at(now_us).p_WG
        near = frame is not None and hypot(*(a - b for a, b in zip(frame.p_WB, goal, strict=True))) <= WELL
        if not (flying and near):
            self._well_since_us = None
        elif self._well_since_us is None:
            self._well_since_us = now_us
        elif now_us - self._well_since_us >= WELL_US and self._talk is None:
            self._good.update(self._set)


def fly_with(
    operator: Operator,
    settings: GroundConfig,
    session: Session,
    say: Callable[[str], None],
    duration_s: float | None,
    hooks: Sequence[LoopHook] = (),
    names: Sequence[str] = (),
) -> tuple[str, bool]:
    """Fly with an operator at the terminal, whose lines `names` complete, until a signal of `STOPS` or for a duration.

    Return why the flight failed, empty if it did not, and whether it was interrupted.
    """
    stops = stop_signals()
    terminal = Terminal(lambda: (*COMMANDS, *names, *operator.known))

    def steer(live: StationSession, now_us: int) -> None:
        for line in terminal.lines():
            operator.queue_line(line)
        operator.process_lines(live, now_us)

    failure = ""
    try:
        stopping = run_until(lambda: bool(stops), duration_s)
        fly(settings, session, say, stopping, [*hooks, steer])
    except (LinkError, MocapError, OSError, ImportError) as error:
        failure = why(error, session.uri)
    finally:
        terminal.close()
        for notice in session.records.notices():  # of the files' last bytes
            say(notice)
    return failure, bool(stops)


def _words(words: list[str], usage: str, count: int) -> list[str]:
    if len(words) != count:
        raise ControlsError(f"expected {usage}")
    return words


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ControlsError(f"{text!r} is not a number") from None
    if not isfinite(value):
        raise ControlsError(f"{text!r} is not a finite number")
    return value
