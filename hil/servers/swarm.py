"""Robots 2, 3, ... of `floaty serve --boards N`: each runs in a separate process, forked from that of robot 1.

Each process opens its robot's connections. A pipe to robot 1's process carries what all share: where clients find the
robot, lines for the user, poses for Motive, packets between boards, and typed lines. A message is the name of a call and
its arguments.
"""

import multiprocessing
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection

from ground_station.stops import STOPS
from hil.crazyflie.nrf51 import AirSettings
from hil.errors import LabError
from hil.servers.live_faults import LiveFaults
from hil.servers.motive import VirtualMotive
from hil.servers.server import Doors, Opened, Server, Service, show

FORK = multiprocessing.get_context("fork")  # a robot starts in 0.1 s with what is loaded already
END_TIMEOUT_S = 10.0  # for a process to end in order
Call = Callable[..., None]


class Swarm:
    """The processes of all robots but the first, of which `plan` is; `say` gets lines for the user."""

    def __init__(self, plan: Service, count: int, doors: Doors, say: Call) -> None:
        self._pipes: dict[int, Connection] = {}
        self._processes: list[multiprocessing.process.BaseProcess] = []
        self._opened: dict[int, Opened] = {}
        self._say = say
        self._calls: dict[str, Call] = {"say": say, "opened": self._opened.__setitem__, "fail": _fail}
        for number in range(2, count + 1):
            near, far = FORK.Pipe()
            self._pipes[number] = near
            process = FORK.Process(target=self._serve, args=(replace(plan, number=number), doors, far))
            self._processes.append(process)
            process.start()
            far.close()

    def wait(self) -> list[Opened]:
        """Wait until the robots are open to clients. Raises `LabError` if one cannot be."""
        for number in self._pipes:
            while number not in self._opened:
                self._read(number, 0)
        return list(self._opened.values())

    def listen(self, server: Server, answer: Call, motive: VirtualMotive | None) -> None:
        """Start the robots beside the first, which `server` has; their answers to typed lines go to `answer`."""

        def hear(number: int, settings: AirSettings, packet: bytes) -> None:
            server.hear_peer(settings, packet)
            self.to_peers(settings, packet, number)

        self._calls |= {"answer": answer, "hear": hear}
        if motive is not None:
            self._calls["take"] = motive.take
        for number, pipe in self._pipes.items():
            server.clock.readers[pipe.fileno()] = partial(self._read, number)
            pipe.send(("type", ("",)))

    @property
    def terminals(self) -> dict[int, Callable[[str], None]]:
        """Return what takes the lines that are typed for a robot, by its number."""
        return {number: partial(self._type, number) for number in self._pipes}

    def _type(self, number: int, line: str) -> None:
        self._pipes[number].send(("type", (line,)))

    def to_peers(self, settings: AirSettings, packet: bytes, sender: int = 1) -> None:
        """Pass a board's packet to those of the other processes."""
        for number, pipe in self._pipes.items():
            if number != sender:
                pipe.send(("hear", (settings, packet)))

    def close(self) -> None:
        """Let the processes end in order."""
        for pipe in self._pipes.values():
            with suppress(OSError):
                pipe.send(("end", ()))
        for pipe, process in zip(self._pipes.values(), self._processes, strict=True):
            with suppress(EOFError, OSError):
                while pipe.poll(END_TIMEOUT_S):
                    name, arguments = pipe.recv()
                    if name == "say":
                        self._say(*arguments)
                process.kill()
            pipe.close()
            process.join()
        self._pipes, self._processes = {}, []

    def _read(self, number: int, now_us: int) -> None:
        try:
            name, arguments = self._pipes[number].recv()
        except (EOFError, OSError):
            raise LabError(f"robot {number}: its process has ended") from None
        self._calls[name](*arguments)

    def _serve(self, plan: Service, doors: Doors, pipe: Connection) -> None:
        """Serve a robot in this process."""
        for number in STOPS:  # robot 1's process ends the others
            signal.signal(number, signal.SIG_IGN)
        for other in self._pipes.values():
            other.close()
        with suppress(BrokenPipeError):
            try:
                _serve_apart(plan, doors, pipe)
            except LabError as error:
                pipe.send(("fail", (str(error),)))


def _fail(text: str) -> None:
    raise LabError(text)


def _serve_apart(plan: Service, doors: Doors, pipe: Connection) -> None:
    def calling(name: str) -> Call:
        return lambda *arguments: pipe.send((name, arguments))

    def read(now_us: int) -> None:
        try:
            name, arguments = pipe.recv()
        except (EOFError, ConnectionResetError):  # robot 1's process was killed
            name, arguments = "end", ()
        calls[name](*arguments)

    def end() -> None:
        ended.append(plan.number)
        del server.clock.readers[pipe.fileno()]

    ended: list[int] = []
    server = Server(plan, calling("say"), None, partial(calling("hear"), plan.number))
    faults = LiveFaults(server, calling("answer"))
    calls: dict[str, Call] = {
        "type": lambda line: faults.take(line, server.lab.now_us),
        "hear": server.hear_peer,
        "end": end,
    }
    try:
        opened = server.open(doors)
        if doors.motive:
            show(server.robot, server.clock, partial(calling("take"), plan.number))
        calling("opened")(plan.number, opened)
        server.clock.readers[pipe.fileno()] = read
        read(0)  # an empty line when robot 1 starts
        server.run(lambda: bool(ended))
    finally:
        server.close()
