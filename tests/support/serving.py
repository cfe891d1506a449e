"""`floaty serve` as a process of its own, for the tests of what talks to it."""

import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from support.paths import VECTORS

FLOATY = (sys.executable, "-m", "hil.commands")
CAMERAS = f"replay:{VECTORS / 'hover_frame.csv'}"  # one frame, for those who need no more

PATIENCE_S = 60.0  # for what comes sooner or later, however busy the machine is
STANDSTILL = re.compile(r"time stood still for (\d+) ms")
SERVED: list["Served"] = []  # those of this test session


@dataclass(eq=False)
class Served:
    """A running server and what it said so far."""

    process: "subprocess.Popen[bytes]"
    lines: list[str] = field(default_factory=list)
    standstills_ms: list[int] = field(default_factory=list)  # that it told
    _rest: bytes = b""

    @property
    def radio_uris(self) -> list[str]:
        return self.line("radio ")

    @property
    def udp_uris(self) -> list[str]:
        return self.line("udp ")

    @property
    def environment(self) -> dict[str, str]:
        """The variables that a program needs to find the virtual dongle, if there is one."""
        words = [word for line in self.lines if line.startswith("use ") for word in line.split()]
        return {**os.environ, **dict(word.split("=", 1) for word in words if "=" in word)}

    def line(self, start: str) -> list[str]:
        """The words after the first one of the line that starts so."""
        return next(line for line in self.lines if line.startswith(start)).split()[1:]

    def wait_for(self, pattern: str, timeout_s: float) -> str:
        """The first line, from now or before, that matches."""
        deadline = time.monotonic() + timeout_s
        while True:
            for line in self.lines:
                if re.search(pattern, line):
                    return line
            ready, _, _ = select.select([self.process.stdout], [], [], max(0.0, deadline - time.monotonic()))
            assert ready, f"no line {pattern!r} within {timeout_s} s: {self.lines}"
            assert self._read(), f"the server ended: {self.lines}"

    @property
    def motive(self) -> str:
        """What `--mocap` calls its cameras."""
        return self.line("motive ")[0]

    def type(self, line: str) -> None:
        self.process.stdin.write(line.encode() + b"\n")
        self.process.stdin.flush()

    def listen(self) -> None:
        """Take what it said and nobody waited for."""
        if not self.process.stdout.closed:
            while select.select([self.process.stdout], [], [], 0.0)[0] and self._read():
                pass

    def _read(self) -> bool:
        """Take a piece of its output; False at the end."""
        data = os.read(self.process.stdout.fileno(), 65536)
        *lines, self._rest = (self._rest + data).split(b"\n")
        self.lines += [line.decode() for line in lines]
        self.standstills_ms += [
            int(found[1])
            for line in self.lines[len(self.lines) - len(lines) :]
            if (found := STANDSTILL.search(line))
        ]
        return bool(data)

    def forget(self) -> None:
        """Let `wait_for` look only at what comes from now on."""
        self.lines = [
            line
            for line in self.lines
            if line.split()[:1] in (["radio"], ["udp"], ["use"], ["mavlink"], ["motive"])
        ]

    def interrupt(self) -> int:
        """Press Ctrl-C, read what it says in the end, and return the exit code."""
        self.process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + PATIENCE_S
        while select.select([self.process.stdout], [], [], max(0.0, deadline - time.monotonic()))[0]:
            if not self._read():
                break
        return self.process.wait(PATIENCE_S)


def free_port() -> int:
    """A UDP port that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def started(*arguments: str | Path, environment: dict[str, str] | None = None) -> Iterator[Served]:
    """A command as a process of its own, whose terminal is a pipe."""
    process = subprocess.Popen(
        [*FLOATY, *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=environment,
    )
    running = Served(process)
    try:
        yield running
    finally:
        running.listen()
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


@contextmanager
def serve(*arguments: str, motive: bool = False) -> Iterator[Served]:
    """A server, with or without Motive, on a free port."""
    cameras = ("--set", "capture.port=0") if motive else ("--no-motive",)
    with started("serve", *cameras, *arguments) as served:
        SERVED.append(served)
        served.wait_for("^serving", PATIENCE_S)
        yield served


@contextmanager
def station(lab: Served, uri: str, *arguments: str | Path, mocap: str = "") -> Iterator[Served]:
    """Run the ground station as its own process: any link, the cameras of a laboratory or others."""
    command = ("station", "--link", uri, "--mocap", mocap or lab.motive, *arguments)
    with started(*command, environment=lab.environment) as typed:
        yield typed
