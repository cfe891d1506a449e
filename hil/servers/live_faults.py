"""Faults typed into the terminal of a running server: each line acts at once."""

import difflib
import os
from collections.abc import Callable, Mapping
from typing import IO

from firmware_py.wire.supervisor import Cause
from hil.errors import LabError
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import Fault, parse
from hil.laboratory.robot import Robot
from hil.servers.server import Server

READ_SIZE = 4096
LINE_MAX = 200  # characters
HELP = """[N] KIND[:DURATION][=SIZE]  lets a fault act on robot N (1) from now on: push.y=2, 2 mocap.dropout:0.5
[N] clear                   ends all faults of robot N
[N] status                  what robot N does, its faults, and where its radio is
[N] restart                 switches board N off and on: its radio returns to the settings in its EEPROM
kinds                       the kinds of faults
help                        this"""
COMMANDS = ("clear", "status", "restart", "kinds", "help")


class LiveFaults:
    """Reads lines for a server's robot; answers by `say`. `others` take the lines for other robots, by their numbers."""

    def __init__(
        self,
        server: Server,
        say: Callable[[str], None],
        others: Mapping[int, Callable[[str], None]] | None = None,
    ) -> None:
        self._server = server
        self._say = say
        self._others = others or {}
        self._rest = b""

    def listen(self, stream: IO[str]) -> None:
        """Read lines from a stream until its end; ignore a stream without a file."""
        try:
            descriptor = stream.fileno()
        except (OSError, ValueError):
            return
        readers = self._server.clock.readers

        def read(now_us: int) -> None:
            data = os.read(descriptor, READ_SIZE)
            if not data:
                del readers[descriptor]
                return
            *lines, rest = (self._rest + data).split(b"\n")
            self._rest = rest[: LINE_MAX + 1]  # what is too long already stays so
            for line in lines:
                self.execute_line(line.decode(errors="backslashreplace").strip(), now_us)

        if os.isatty(descriptor) or not os.path.samestat(os.fstat(descriptor), os.stat(os.devnull)):
            readers[descriptor] = read

    def execute_line(self, line: str, now_us: int) -> None:
        """Execute a line; answer an invalid line without changing anything."""
        if line == "help":
            for listed in HELP.splitlines():
                self._say(listed)
        elif line == "kinds":
            self._say(" ".join(KINDS))
        elif len(line) > LINE_MAX:
            self._say(f"{line[:20]}…: expected at most {LINE_MAX} characters")
        elif line:
            try:
                self._act(line, now_us)
            except LabError as error:
                self._say(str(error))

    def _act(self, line: str, now_us: int) -> None:
        first, _, rest = line.partition(" ")
        board, served, robot = self._server.switchboard, self._server.served, self._server.robot
        number, text = (int(first), rest.strip()) if first.isdecimal() else (1, line)
        if number in self._others:
            self._others[number](line)
            return
        if number != served.number:
            raise LabError(f"robot {number}: expected 1..{1 + len(self._others)}")
        if text == "status":
            faults = ", ".join(map(str, board.active)) or "none"
            self._say(f"robot {number}: {_status(robot)}; faults: {faults}; {served.uri}")
        elif text == "restart":
            served.nrf51.power_cycle(now_us)
        elif text == "clear":
            for fault in board.active.copy():
                board.end(fault, now_us)
        else:
            board.act(_fault(text), now_us)
            if not robot.free:
                self._say(f"robot {number} is held: what moves it has no effect before it is released")


def _fault(text: str) -> Fault:
    """Parse a line as a fault; otherwise raise a `LabError` that also names the commands."""
    try:
        return parse(text, live=True)
    except LabError as error:
        near = difflib.get_close_matches(text, COMMANDS, 1)
        if near and text not in KINDS:
            raise LabError(f"{text!r} is unknown; did you mean {near[0]}?") from None
        raise LabError(f"{error}; help lists what can be typed") from None


def _status(robot: Robot) -> str:
    """Return a robot's state, in a few words."""
    if not robot.powered:
        return "without power"
    supervisor = robot.firmware.signals.supervisor
    cause = "" if supervisor.cause is Cause.NONE else f", {supervisor.cause.name.lower().replace('_', ' ')}"
    return f"{'free' if robot.free else 'held'}, {supervisor.state.name.lower()}{cause}"
