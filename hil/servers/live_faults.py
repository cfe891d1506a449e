"""Faults typed into the terminal of a running server: each line acts at once."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import IO

from hil.errors import LabError
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import parse
from hil.servers.server import Server

READ_SIZE = 4096
HELP = """[N] KIND[:DURATION][=SIZE]  lets a fault act on robot N (1) from now on: push.y=2, 2 mocap.dropout:0.5
[N] clear                   ends all faults of robot N
kinds                       the kinds of faults
help                        this"""


class LiveFaults:
    """Reads lines; `say` answers."""

    def __init__(self, server: Server, say: Callable[[str], None]) -> None:
        self._server = server
        self._say = say
        self._rest = b""

    def listen(self, stream: IO[str]) -> None:
        """Take lines from a stream from now on, until its end; a stream without a file is left alone."""
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
            *lines, self._rest = (self._rest + data).split(b"\n")
            for line in lines:
                self.take(line.decode(errors="replace").strip(), now_us)

        if os.isatty(descriptor) or not os.path.samestat(os.fstat(descriptor), os.stat(os.devnull)):
            readers[descriptor] = read

    def take(self, line: str, now_us: int) -> None:
        """Do what a line says; a line that says nothing possible changes nothing and is answered."""
        if line == "help":
            self._say(HELP)
        elif line == "kinds":
            self._say(" ".join(KINDS))
        elif line:
            try:
                self._act(line, now_us)
            except LabError as error:
                self._say(str(error))

    def _act(self, line: str, now_us: int) -> None:
        first, _, rest = line.partition(" ")
        boards = self._server.switchboards
        number, text = (int(first), rest.strip()) if first.isdecimal() else (1, line)
        if not 1 <= number <= len(boards):
            raise LabError(f"robot {number}: expected 1..{len(boards)}")
        board = boards[number - 1]
        if text == "clear":
            for fault in board.active.copy():
                board.end(fault, now_us)
            return
        name = text.partition(":")[0].partition("=")[0]
        board.act(parse(f"{name}@0{text[len(name) :]}"), now_us)
