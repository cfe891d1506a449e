"""Robots 2, 3, ... of `floaty serve --boards N`: each runs in a separate process, forked from that of robot 1.

Each process opens its robot's connections. A pipe to robot 1's process carries where clients find the robot, lines for the
user, poses for Motive, packets between boards, and typed lines. A message is the name of a call and its arguments. Where the
robots are, and how long time stood still, is in memory that they share (`SharedRoom`). A robot whose process ends is
reported; the others continue.
"""

import multiprocessing
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection

from ground_station.stops import STOPS
from hil.emulator.crazyflie.nrf51 import AirSettings
from hil.errors import LabError
from hil.servers.live_faults import LiveFaults
from hil.servers.motive import VirtualMotive
from hil.servers.server import Endpoints, OpenEndpoints, Server, Service, show
from hil.servers.shared_room import SharedRoom

FORK = multiprocessing.get_context("fork")  # a robot starts in 0.1 s with what is loaded already
END_TIMEOUT_S = 10.0  # for a process to end in order
Call = Callable[..., None]


class Swarm:
    """The processes of all robots but the first, of which `plan` is; `say` gets lines for the user."""

    def __init__(self, plan: Service, count: int, endpoints: Endpoints, say: Call) -> None:
        self._pipes: dict[int, Connection] = {}
        self._processes: dict[int, multiprocessing.process.BaseProcess] = {}
        self._opened: dict[int, OpenEndpoints] = {}
        self._say = say
        self.room = SharedRoom(plan.config, count)
        self._calls: dict[str, Call] = {"say": say, "opened": self._opened.__setitem__, "fail": _fail}
        for number in range(2, count + 1):
            near, far = FORK.Pipe()
            self._pipes[number] = near
            process = FORK.Process(target=self._serve, args=(replace(plan, number=number), endpoints, far))
            self._processes[number] = process
            process.start()
            far.close()

    def wait(self) -> list[OpenEndpoints]:
        """Wait until the robots are open to clients. Raises `LabError` if one cannot be."""
        for number in self._pipes:
            while number not in self._opened:
                try:
                    self._read(number)
                except LabError as error:
                    raise LabError(f"robot {number}: {error}") from None
        return list(self._opened.values())

    def listen(self, server: Server, answer: Call, motive: VirtualMotive | None) -> None:
        """Start the robots beside the first, which `server` has; their answers to typed lines go to `answer`."""

        def hear(number: int, settings: AirSettings, packet: bytes) -> None:
            server.hear_peer(settings, packet)
            self.to_peers(settings, packet, number)

        def read(number: int, now_us: int) -> None:
            try:
                self._read(number)
            except LabError as error:
                self._say(f"robot {number}: {error}; the others continue")
                del server.clock.readers[self._pipes[number].fileno()]
                self._pipes.pop(number).close()
                self._processes[number].kill()
                self.room.leave(number)
                if motive is not None:
                    motive.lose(number)

        self._calls |= {"answer": answer, "hear": hear}
        if motive is not None:
            self._calls["take"] = motive.stream_frame
        for number, pipe in self._pipes.items():
            server.clock.readers[pipe.fileno()] = partial(read, number)
            self._send(number, "type", "")

    @property
    def terminals(self) -> dict[int, Callable[[str], None]]:
        """Return what takes the lines that are typed for a robot, by its number."""
        return {number: partial(self._type, number) for number in self._pipes}

    def _type(self, number: int, line: str) -> None:
        if number not in self._pipes:
            raise LabError(f"robot {number}: its process has ended")
        self._send(number, "type", line)

    def _send(self, number: int, name: str, *arguments: object) -> None:
        with suppress(OSError):  # its process has ended, which `listen` reports
            self._pipes[number].send((name, arguments))

    def to_peers(self, settings: AirSettings, packet: bytes, sender: int = 1) -> None:
        """Pass a board's packet to those of the other processes."""
        for number in self._pipes:
            if number != sender:
                self._send(number, "hear", settings, packet)

    def close(self) -> None:
        """Let the processes end in order."""
        for number in self._pipes:
            self._send(number, "end")
        for number, pipe in self._pipes.items():
            with suppress(EOFError, OSError):
                while pipe.poll(END_TIMEOUT_S):
                    name, arguments = pipe.recv()
                    if name == "say":
                        self._say(*arguments)
                self._processes[number].kill()
            pipe.close()
        for process in self._processes.values():
            process.join()
        self._pipes, self._processes = {}, {}

    def _read(self, number: int) -> None:
        """Execute the next call of a robot's process. Raises `LabError` when it has ended or fails."""
        try:
            name, arguments = self._pipes[number].recv()
        except (EOFError, OSError):
            raise LabError("its process has ended") from None
        self._calls[name](*arguments)

    def _serve(self, plan: Service, endpoints: Endpoints, pipe: Connection) -> None:
        """Serve a robot in this process."""
        for number in STOPS:  # robot 1's process ends the others
            signal.signal(number, signal.SIG_IGN)
        for other in self._pipes.values():
            other.close()
        with suppress(BrokenPipeError):
            try:
                _serve_apart(plan, endpoints, pipe, self.room)
            except LabError as error:
                pipe.send(("fail", (str(error),)))


def _fail(text: str) -> None:
    raise LabError(text)


def _serve_apart(plan: Service, endpoints: Endpoints, pipe: Connection, room: SharedRoom) -> None:
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
    server = Server(plan, calling("say"), None, partial(calling("hear"), plan.number), room)
    faults = LiveFaults(server, calling("answer"))
    calls: dict[str, Call] = {
        "type": lambda line: faults.execute_line(line, server.lab.now_us),
        "hear": server.hear_peer,
        "end": end,
    }
    try:
        opened = server.open(endpoints)
        if endpoints.motive:
            show(server.robot, server.clock, partial(calling("take"), plan.number))
        calling("opened")(plan.number, opened)
        server.clock.readers[pipe.fileno()] = read
        read(0)  # an empty line when robot 1 starts
        server.run(lambda: bool(ended))
    finally:
        server.close()
