"""Servers answer random clients as they did, on a time of the test: cameras, ports, dongles, other processes, lines.

If a change is meant: make approve.
"""

import errno
import select
import socket
import struct
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pytest

from firmware_py.rtos import WatchdogError
from firmware_py.wire.memories import CONFIG_SIZE, RadioSettings, encode_config
from ground_station.mocap import MocapFrame
from ground_station.sources.natnet import MessageId, ServerInfo, decode, packet
from ground_station.unused import Reason
from hil.board.clock import FreeRunning
from hil.board.dongle import VirtualDongle
from hil.board.markers import Sighting
from hil.config import load_config
from hil.emulator.crazyflie.config import RadioConfig
from hil.emulator.crazyflie.nrf51 import AirSettings, Band, Nrf51, Power, peer_packet
from hil.emulator.crazyflie.shockburst import Air
from hil.emulator.events import EventQueue
from hil.errors import LabError
from hil.laboratory.faults import parse
from hil.servers import dongle_plugin, motive, server, swarm, tcp_port, usb_dongle
from hil.servers.built_in_station import HiddenLink
from hil.servers.dongle_server import PROTOCOL, _UsbCable
from hil.servers.failures import TABLE
from hil.servers.live_faults import LiveFaults
from hil.servers.motive import Streaming, VirtualMotive
from hil.servers.natnet_bytes import encode_frame, encode_models, encode_server_info
from hil.servers.serial_server import Address, parse_addresses
from hil.servers.served_robot import ServedRobot
from hil.servers.server import Endpoints, OpenEndpoints, Server, Service
from hil.servers.tcp_port import TcpPort
from hil.servers.udp_server import UdpServer
from support.approved import approve, judge, tiers
from support.random_use import Random, by_seed, hash_of
from support.watching import Watcher

ANSWERS = Path(__file__).with_name("servers.json")
SEEDS = range(1, 4)
PATIENCE_S = 20.0
HOME = bytes.fromhex("E7E7E7E7E7")


@contextmanager
def replaced(*changes: tuple[Any, str, Any]) -> Iterator[None]:
    """Replace attributes of modules meanwhile."""
    with pytest.MonkeyPatch.context() as patch:
        for place, name, value in changes:
            patch.setattr(place, name, value)
        yield


def arrived(source: Any) -> None:
    """Wait until a socket is readable."""
    assert select.select([source], [], [], PATIENCE_S)[0]


def failing(error: Exception) -> Callable[..., None]:
    """Return a function that raises an error."""

    def fail(*of: object) -> None:
        raise error

    return fail


class Clock(FreeRunning):
    """The clock of a server that never waits; nothing comes from outside by itself."""

    began_us = 0

    def __init__(self, pauses: Any, index: int) -> None:
        self.readers: dict[Any, Any] = {}

    def standstill_us(self, now_us: int) -> int:
        return 0


class Cameras(Random):
    """A Motive that sees three bodies, and clients of every kind, some too many."""

    def frames(self, found: VirtualMotive) -> None:
        """Let some bodies' frames arrive, in any order and late."""
        self.t_us += self.pick(0, 3_000, 5_000, 6_000, 10_000, 10_000)
        for body in self.rng.permutation([1, 2, 3])[: 1 + self.below(3)].tolist():
            t_us = self.t_us + self.pick(0, 0, 0, 1_000, -6_000)
            place, turn = (tuple(self.rng.integers(-99, 99, count).tolist()) for count in (3, 4))
            valid = self.pick(True, True, True, False)
            frame = MocapFrame(
                t_us - 500 * body, place, turn, valid, self.pick(None, t_us + 2_000),
                unused=(self.pick(Reason.FROZEN, Reason.NOT_TRACKED), ()),
            )  # fmt: skip
            seen = self.rng.random(3) < 0.7
            points, ghosts = (
                self.rng.integers(-9, 9, (count, 3)).astype(float) for count in (3, self.below(2))
            )
            sighting = Sighting(points, seen, 0.5 * seen, ghosts, 0.25 * body, None)
            found.stream_frame(
                body, frame, t_us + self.pick(4_000, 9_000), self.pick(None, sighting), 500 * body
            )

    def request(self) -> bytes:
        """Return what a client may ask."""
        text = self.pick(
            b"Bitstream", b"Bitstream,3.1", b"Bitstream,4.1.0.0", b"Bitstream,2.9", b"Other", b"Bitstream,"
        )
        return self.pick(
            packet(MessageId.CONNECT, self.data(0, 9)), packet(MessageId.CONNECT), packet(MessageId.KEEPALIVE),
            packet(MessageId.REQUEST_MODELDEF), packet(MessageId.DISCONNECT), packet(MessageId.FRAME),
            packet(MessageId.ECHO_REQUEST, self.data(8, 8, 7)), packet(MessageId.REQUEST, text + b"\0"),
            packet(MessageId.REQUEST, text), packet(MessageId.REQUEST, bytes(self.pick(256, 257))),
            struct.pack("<HH", MessageId.REQUEST, 12) + b"short", self.data(1, 3),
        )  # fmt: skip

    def told(self, seed: int) -> dict[str, str]:
        now = Made(us=50_000)
        self.t_us = 0
        readers: dict[Any, Any] = {}
        clients = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(18)]
        names: dict[Any, str] = {}
        for number, client in enumerate(clients):
            client.bind(("127.0.0.1", 0))
            names[client.getsockname()] = f"client {number}"

        def sent(sender: object, data: bytes, to: tuple[str, int]) -> None:
            content: Any = data.hex()
            if int.from_bytes(data[:2], "little") == MessageId.SERVER_INFO:
                info = decode(data, (4, 1))
                content = replace(info, data_port=info.data_port - found.port)
            if sender not in found._groups[1:]:
                name = names.get(to) or (to[0], to[1] - found.port)
                self.log.note(f"sent {int.from_bytes(data[:2], 'little')}", name, content)

        with replaced((motive, "clock_us", lambda: now.us), (motive, "_send", sent)):
            version, up = self.pick((3, 1), (4, 1)), self.pick("y", "z")
            settings = Streaming(0, version, seed == SEEDS[-1], up)
            period_us = (10_000, 4_000, 16_000)[seed % 3]
            found = VirtualMotive(settings, 3, readers, np.arange(6.0).reshape(2, 3), period_us)
            ((source, read),) = readers.items()
            for _ in range(400):
                now.us += self.pick(0, 1_000, 7_000)
                if self.pick(True, False):
                    client = clients[self.below(self.pick(3, 18))]
                    request = self.request()
                    client.sendto(request, ("127.0.0.1", found.port))
                    arrived(source)
                    read(0)
                    self.log.note("asked", names[client.getsockname()], request.hex(), found.malformed)
                else:
                    self.frames(found)
                if self.below(150) == 0:
                    found.lose(self.pick(2, 3))
            frame, model = found._models, found._missing
            for version in ((3, 0), (3, 1), (4, 0), (4, 1)):
                self.log.note("models", encode_models(frame, version).hex())
                whole = motive.Frame(7, tuple(model.values()), ((1.0, 2.0, 3.0),), (), 1.5, 1, 2, 3, 4)
                self.log.note("frames", encode_frame(whole, version).hex())
            info = ServerInfo("Motive", (1, 2, 3, 4), (5, 6, 7, 8), 9, 10, True, "11.12.13.14")
            self.log.note("info", encode_server_info(info).hex())
            found.close()
        for client in clients:
            client.close()
        return self.log.told()


class Datagrams(Random):
    """A board's UDP port and three clients, one of which leaves now and then."""

    def told(self, seed: int) -> dict[str, str]:
        readers: dict[Any, Any] = {}
        clients: list[socket.socket] = []

        def named(text: str) -> str:
            for number, client in enumerate(clients):
                text = text.replace("{}:{}".format(*client.getsockname()), f"client {number}")
            return text.replace(str(port), "PORT")

        def client() -> socket.socket:
            fresh = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            fresh.connect(("127.0.0.1", port))
            fresh.setblocking(False)
            return fresh

        port = 0
        own = UdpServer(
            0, readers, lambda us, data: self.log.note("received", us, data.hex()),
            lambda text: self.log.note("said", named(text)),
        )  # fmt: skip
        port, now_us = own.port, 0
        clients = [client() for _ in range(3)]
        for _ in range(600):
            now_us += self.pick(0, 10_000, 60_000, 99_999, 100_000, 500_000, 1_000_001)
            what = self.pick(
                "packet", "packet", "packet", "packet", "send", "session", "leave", "power", "end"
            )
            number = self.below(3)
            if what == "packet" and readers:
                data = self.pick(b"\xff", b"\xf3", b"\xff\0", b"\x30a", self.data(1, 31, 32), b"\xff\5\1")
                clients[number].send(data)
                while select.select([*readers], [], [], 0)[0]:
                    readers[next(iter(readers))](now_us)
            elif what == "send":
                own.send(self.data(1, 31))
            elif what == "session":
                self.log.note(what, now_us, own.has_session(now_us))
            elif what == "leave":
                clients[number].close()
                clients[number] = client()
            elif what == "power":
                self.pick(own.close, own.open)()
                own.open()
                while readers and select.select([*readers], [], [], 0)[0]:
                    readers[next(iter(readers))](now_us)
            elif what == "end":
                own.end_session()
            heard = []
            for one in clients:
                try:
                    while True:
                        heard.append(one.recv(64).hex())
                except OSError as error:
                    heard.append(errno.errorcode[error.errno or 0])
            self.log.note("heard", now_us, own.ignored, *heard)
        own.close()
        for one in clients:
            one.close()
        return self.log.told()


class Connections(Random):
    """A TCP port of at most four clients, which connect, speak, are silent or not understood, and leave."""

    def told(self, seed: int) -> dict[str, str]:
        readers: dict[Any, Any] = {}
        ends: dict[str, socket.socket] = {}

        def join(client: tcp_port.TcpClient) -> Callable[[int, bytes], None]:
            self.log.note("joined", names[client.name])
            return lambda us, data: self.log.note("received", us, names[client.name], data.hex())

        def say(text: str) -> None:
            words = text.replace(str(port.port), "PORT")
            for name, number in names.items():
                words = words.replace(name, number)
            self.log.note("said", words)

        names: dict[str, str] = {}
        left: set[str] = set()
        with replaced((tcp_port, "CLIENTS_MAX", 4)):
            port = TcpPort(("127.0.0.1", 0), readers, PROTOCOL, join, say)
            now_us = 0
            for number in range(300):
                now_us += self.pick(0, 1, 10_000, 300_000, 300_000, 999_999, 1_000_000)
                clients = [*port.clients]
                what = self.pick(
                    "connect",
                    "connect",
                    "speak",
                    "speak",
                    "speak",
                    "leave",
                    "send",
                    "pause",
                    "listen",
                    "offer",
                )
                one = clients[self.below(len(clients))] if clients else None
                if what == "connect":
                    end = socket.create_connection(("127.0.0.1", port.port))
                    name = "{}:{}".format(*end.getsockname())
                    names[name], ends[name] = f"client {number}", end
                    (listener,) = [source for source in readers if source is port._listener]
                    arrived(listener)
                    readers[listener](now_us)
                elif one is None:
                    continue
                elif what in ("speak", "leave"):
                    if what == "leave" or one.name in left:
                        ends[one.name].shutdown(socket.SHUT_WR)
                        left.add(one.name)
                    else:
                        ends[one.name].sendall(self.pick(b"C", b"W", b"T", b"GET", b"GET") + self.data(0, 4))
                    if one._socket in readers:
                        arrived(one._socket)
                        readers[one._socket](now_us)
                elif what == "send":
                    one.send(now_us, self.data(4))
                elif what == "offer":
                    self.log.note(what, one.offer(self.data(4)))
                elif what == "pause":
                    one.pause()
                else:
                    one.listen(partial(self.log.note, "heard"))
                self.log.note("clients", *(names[client.name] for client in port.clients), len(readers))
            for _ in range(2):
                port.close()
            self.log.note("closed", len(readers), len(port.clients))
        for end in ends.values():
            end.close()
        return self.log.told()


class Cable(Random):
    """A client sends frames to a dongle in pieces, and a board answers; now and then the client has to wait."""

    def told(self, seed: int) -> dict[str, str]:
        events, board = EventQueue(), Made(battery_V=3.5)
        for name in ("start", "stop", "greet", "received", "polled", "retuned"):
            setattr(board, name, partial(self.log.note, f"board {name}"))
        config = RadioConfig(uplink_loss=0.2, downlink_loss=0.1)
        uniform = lambda: float(self.rng.random())  # noqa: E731
        chip = Nrf51(
            AirSettings(80, 2_000_000, HOME), bytes(6), 3, Band(events, uniform), board, Air.of(config)
        )
        dongle = VirtualDongle(config, events, self.rng, chip)
        client = Made(listening=True)
        client.pause = lambda: setattr(client, "listening", False)
        client.listen = lambda receive: setattr(client, "listening", True)
        client.send = lambda us, data: self.log.note("sent", us, data.hex(), client.listening)
        cable, sequence, waiting = _UsbCable(client, dongle, lambda us: us + 7), 0, b""
        for _ in range(700):
            sequence = (sequence + 1) & 0xFF
            null = bytes((0xF3 | self.below(4) << 2,))
            kind, data = self.pick(
                (b"C", bytes((1, self.pick(80, 80, 81), 0))),
                (b"C", b"\2\0\0" + self.pick(HOME, HOME, b"\xff\xe7\xe7\xe7\xe7")),
                (b"C", bytes((3, 2, 0))), (b"C", bytes((6, self.below(4), 0))),
                (b"C", bytes((16, self.pick(1, 1, 1, 0), 0))),
                (b"C", b"\1"), (b"T", b""), (b"W", b""), (b"W", null), (b"W", null), (b"W", self.data(1, 5, 31)),
                (b"W", null + b"\5\1"), (b"W", self.data(40)), (b"Q", b"1"), (b"W", bytes((255, 254, 255))),
            )  # fmt: skip
            waiting += dongle_plugin.frame(kind, sequence, data)
            if client.listening:
                cut = self.pick(len(waiting), len(waiting), self.below(len(waiting)))
                cable.receive(events.now_us, waiting[:cut])
                waiting = waiting[cut:]
            events.run(events.now_us + self.pick(0, 0, 100, 900, 5_000))
            self.log.note("state", events.now_us, cable._awaited, len(cable._received), client.listening)
            chip.send(events.now_us, self.data(3)) if self.below(3) == 0 else None
        return self.log.told()


class Bus(Random):
    """A program's requests to the device node of a dongle, with any numbers, while the server may be gone."""

    def told(self, seed: int) -> dict[str, str]:
        memory, orders = bytearray(self.data(0x4000)), deque[bytes]()

        def sendall(data: bytes) -> None:
            kind, place, size = usb_dongle.WORDS.unpack(data[:24])
            self.log.note(f"order {kind}", place, size, data[24:].hex())
            if kind == usb_dongle.READ_MEMORY and size:
                orders.append(bytes(memory[place % 0x3000 : place % 0x3000 + size]))
            elif kind == usb_dongle.WRITE_MEMORY:
                memory[place % 0x3000 : place % 0x3000 + size] = data[24:]
            elif kind == usb_dongle.RUN:
                orders.append(
                    usb_dongle.WORDS.pack(usb_dongle.RESULT, self.pick(0, 5, 2**32 - 1, 2**64 - 1), 9)
                )

        def recv(size: int) -> bytes:
            piece, rest = orders[0][:size], orders[0][size:]
            cut = 1 + self.below(len(piece)) if piece else 0
            orders[0] = piece[cut:] + rest
            if not orders[0]:
                orders.popleft()
            return piece[:cut]

        answers: list[bytes | OSError] = []

        def read(timeout_s: float) -> bytes:
            self.log.note("read", timeout_s)
            answer = answers.pop(0) if answers else TimeoutError()
            if isinstance(answer, OSError):
                raise answer
            dongle.awaits_answer = False
            return answer

        def act(kind: str, data: bytes) -> None:
            self.log.note(kind, data.hex())
            if self.below(30) == 0:
                raise ConnectionResetError
            if kind == "write":
                dongle.awaits_answer = True
                answers[:] = self.pick([b"\1" + self.data(0, 3, 31)], [TimeoutError(), b"\0"], [], [b"\1ab"])

        dongle: Any = Made(
            control=partial(act, "control"), write=partial(act, "write"), read=read, awaits_answer=False
        )
        dongle.close = partial(self.log.note, "closed")

        def connect() -> Any:
            self.log.note("connect")
            if self.below(6) == 0:
                raise ConnectionRefusedError
            return dongle

        pack, urbs = struct.pack, range(0x1000, 0x1400, 0x100)
        program: Any = Made(sendall=sendall, recv=recv, close=partial(self.log.note, "closed"))
        with replaced((usb_dongle.time, "sleep", partial(self.log.note, "slept"))):
            device = usb_dongle.OpenDevice(program, connect)
            for _ in range(500):
                if device._gone and self.below(4) == 0:
                    device = usb_dongle.OpenDevice(program, connect)
                place, size, way = self.pick(*urbs), self.pick(0, 2, 8, 20, 64), self.pick(0x01, 0x81)
                numbers = (usb_dongle.CONTROL, usb_dongle.BULK, usb_dongle.BULK, usb_dongle.SUBMIT, usb_dongle.SUBMIT,
                           usb_dongle.DISCARD, usb_dongle.REAP_NOW, usb_dongle.REAP_NOW, usb_dongle.CAPABILITIES,
                           usb_dongle.GET_DRIVER, usb_dongle.SPEED, usb_dongle.ACCEPTED[0], 0x1234)  # fmt: skip
                number = self.pick(*numbers, *([usb_dongle.REAP] if device._ready else []))
                request = (
                    self.pick(0x40, 0x40, 0xC0, 0x80),
                    self.pick(1, 2, 3, 6),
                    self.pick(0x100, 0x200, 0x301, 80, 0x302),
                )
                if number == usb_dongle.CONTROL:
                    memory[place : place + 24] = pack("=BBHHHI4xQ", *request, 0, size, 100, 0x2000)
                elif number == usb_dongle.BULK:
                    memory[place : place + 24] = pack("=III4xQ", way, size, self.pick(0, 30), 0x2000)
                elif number == usb_dongle.SUBMIT:
                    kind = self.pick(2, 3, 3, 3, 0)
                    memory[place : place + 56] = usb_dongle.URB.pack(
                        kind, way, 7, 0, 0x2000, 8 + size, 7, 0, 0, 0, 0, 0
                    )
                    memory[0x2000:0x2008] = pack("=BBHHH", *request, 0, size) if kind == 2 else self.data(8)
                words = (self.pick(1, 1, 1, 1, 1, 1, 1, 2), number, place)
                orders.append(usb_dongle.WORDS.pack(*words))
                self.log.note(
                    "answer", *words, device.answer(), len(device._reading), list(device._ready), device._gone
                )
            orders.append(b"")
            self.log.note("end", device.answer())
        return self.log.told()


class Lines(Random):
    """A program's dongle with lines to two processes of a server, of which the second may end; and sleeps that follow it."""

    def told(self, seed: int) -> dict[str, str]:
        ends: list[Any] = []

        def create(address: tuple[str, int], timeout_s: float) -> Any:
            number = len(ends)
            self.log.note("connected", number, address, timeout_s)
            if address[1] == 3:
                raise ConnectionRefusedError
            end: Any = Made(received=b"", ended=False, setsockopt=lambda *of: None, settimeout=lambda s: None)
            end.close = partial(self.log.note, "closed", number)

            def sendall(data: bytes) -> None:
                self.log.note("sent", number, data.hex())
                if end.ended:
                    raise ConnectionResetError
                if data[:1] == b"W" and self.below(8):
                    end.received += dongle_plugin.frame(
                        b"R", data[1], self.pick(b"\0", b"\1", b"\1") + self.data(0, 3)
                    )
                if data[:1] == b"T":
                    self.stood_us += self.pick(0, 0, 30_000)
                    end.received += dongle_plugin.frame(b"R", data[1], self.stood_us.to_bytes(8))

            def recv(size: int) -> bytes:
                if end.ended:
                    return b""
                if not end.received:
                    raise TimeoutError
                cut = 1 + self.below(len(end.received))
                piece, end.received = end.received[:cut], end.received[cut:]
                return piece

            end.sendall, end.recv = sendall, recv
            if number % 4 == 0 or address[1] == 9:
                end.received = dongle_plugin.frame(
                    b"P", 0, bytes((0, 2, 0, 3, 0, 4)) if address[1] == 1 else b""
                )
            ends.append(end)
            return end

        self.stood_us = 0
        with replaced((dongle_plugin.socket, "create_connection", create)):
            dongle = dongle_plugin.Connection("host", 1)
            for _ in range(400):
                what = self.pick("control", "write", "write", "read", "read", "read")
                if what == "control":
                    dongle.control(self.pick(
                        bytes((1, self.pick(80, 90), 0)), b"\2\0\0" + self.data(5), bytes((16, self.pick(0, 1, 1), 0)),
                        bytes((0x23, self.pick(0, 0, 1, 2), 0)),
                    ))  # fmt: skip
                elif what == "write":
                    dongle.write(
                        bytes((8, self.pick(0x02, 0x12, 0x12), self.pick(80, 90))) + HOME + self.data(1, 9)
                    )
                else:
                    try:
                        self.log.note(what, dongle.read(0.5).hex())
                    except TimeoutError:
                        self.log.note(what, "nothing")
                self.log.note(
                    "awaits", dongle.awaits_answer, len(dongle._lines), len(dongle._found), len(dongle._asked)
                )
                if self.below(150) == 0 and len(ends) > 2:
                    ends[self.pick(1, 2)].ended = True
            dongle.close()
            clock = dongle_plugin.SimulatedClock(("host", 9), partial(self.log.note, "slept"))
            for _ in range(40):
                clock.sleep(self.pick(0.01, 0.05, 0.049, 0.3))
                if self.below(9) == 0:
                    ends[-1].ended = True
            clock.close()
        return self.log.told()


class Processes(Random):
    """Robot 1's end of the pipes to three other robots' processes, which say anything, and end."""

    def told(self, seed: int) -> dict[str, str]:
        def process(target: Any, args: Any) -> Any:
            plan, endpoints, _ = args
            own = {name: partial(self.log.note, name, plan.number) for name in ("kill", "join")}
            return Made(start=partial(self.log.note, "start", plan.number, endpoints), **own)

        def pipe() -> tuple[Any, Any]:
            near, far = deque[Any](), deque[Any]()
            closed: list[int] = []

            def recv() -> Any:
                if not near:
                    raise EOFError if number % 2 else ConnectionResetError
                return near.popleft()

            def send(message: Any) -> None:
                if closed:
                    raise OSError
                far.append(message)

            number = len(fars)
            here = Made(recv=recv, send=send, poll=lambda s: True, fileno=lambda: number)
            here.close = partial(self.log.note, "close", number)
            there = Made(near=near, far=far, closed=closed, close=lambda: None)
            fars.append(there)
            return here, there

        fars: list[Any] = []
        hears = partial(self.log.note, "server hears")
        own: Any = Made(clock=Made(readers={}), hear_peer=hears)
        cameras: Any = Made(stream_frame=partial(self.log.note, "frame"), lose=partial(self.log.note, "lost"))
        with replaced((swarm, "FORK", Made(Pipe=pipe, Process=process))):
            robots = swarm.Swarm(Service(load_config()), 4, Endpoints(udp=0), partial(self.log.note, "said"))
            for number, far in enumerate(fars, 2):
                far.near += [
                    ("say", (f"robot {number}",)),
                    ("opened", (number, OpenEndpoints(f"radio {number}", 0, "", ""))),
                ]
            if seed == 2:
                fars[1].near[0] = ("fail", ("no port",))
            try:
                self.log.note("opened", robots.wait())
            except LabError as error:
                self.log.note("opened", error)
            robots.room.rows[:] = 1.0
            robots.listen(own, partial(self.log.note, "answered"), self.pick(cameras, None))
            terminals = robots.terminals
            for _ in range(80):
                number, settings = self.pick(2, 3, 4), AirSettings(self.below(9), 2_000_000, HOME)
                what = self.pick("call", "call", "call", "type", "peers", "end")
                if what == "call":
                    fars[number - 2].near.append(self.pick(
                        ("say", ("hello",)), ("answer", ("fine",)), ("hear", (number, settings, self.data(2))),
                        ("take", (number, "frame", 7, None, 0)) if cameras in vars(robots).values() else ("say", ("take",)),
                    ))  # fmt: skip
                    if number - 2 in own.clock.readers:
                        own.clock.readers[number - 2](0)
                elif what == "type":
                    try:
                        terminals[number]("status")
                    except LabError as error:
                        self.log.note("typed", error)
                elif what == "peers":
                    robots.to_peers(settings, self.data(3))
                elif self.below(4) == 0 and number - 2 in own.clock.readers:
                    fars[number - 2].near.clear()
                    fars[number - 2].closed.append(1)
                    own.clock.readers[number - 2](0)
                self.log.note("readers", *own.clock.readers, *robots.terminals, robots.room.rows.sum(axis=1))
            fars[0].near.append(("say", ("goodbye",)))
            for _ in range(2):
                robots.close()
                self.log.note("closed", *robots.terminals, *robots._processes)
            for far in fars:
                self.log.note("far", *far.far)
        return self.log.told()


class Apart(Random):
    """The process of robot 2 or 3: what it obeys, and what it passes to robot 1's."""

    def told(self, seed: int) -> dict[str, str]:
        settings = AirSettings(80, 2_000_000, bytes.fromhex("FFE7E7E7E7"))
        messages = deque[Any]()
        for _ in range(30):
            messages.append(self.pick(
                None, None, ("hear", (settings, peer_packet(self.data(3)))),
                *(("type", (line,)) for line in ("status", "2 status", "3 status", "clear", "2 push.y:0.1", "3 push.y:0.1")),
            ))  # fmt: skip
        messages += [("type", ("status",)), *([("end", ())] if seed == 1 else [])]

        taken: list[Any] = [("type", ("",))]

        class Served(Clock):
            """It reads a message every 50 ms, in the end that robot 1's process is gone."""

            def serve(self, now_us: int) -> None:
                if now_us % 50_000 == 0 and self.readers:
                    taken.append(messages.popleft() if messages else "gone")
                    for read in [*self.readers.values()] if taken[-1] is not None else ():
                        read(now_us)

        def recv() -> Any:
            message = taken.pop()
            self.log.note("read", message)
            if message == "gone":
                raise EOFError if seed == 2 else ConnectionResetError
            return message

        def send(message: tuple[str, tuple[Any, ...]]) -> None:
            name, arguments = message
            self.log.note(
                name,
                *(
                    one.t_us if isinstance(one, MocapFrame) else one
                    for one in arguments
                    if not isinstance(one, Sighting)
                ),
            )

        pipe: Any = Made(recv=recv, send=send, fileno=lambda: 99)
        plan = Service(load_config(), number=self.pick(2, 3), faults=(parse("imu.silent:0.1", live=True),))
        room = swarm.SharedRoom(plan.config, 3)
        with replaced((server, "Paced", Served)):
            endpoints = Endpoints(station=self.pick(None, "corrections"), motive=self.pick(True, False))
            swarm._serve_apart(plan, endpoints, pipe, room)
        self.log.note("room", *(room.rows != swarm.SharedRoom(plan.config, 3).rows).any(axis=1))
        return self.log.told()


class Robot(Random):
    """A served robot that flies in its room, is switched off, moved to other channels, fails and is repaired."""

    def told(self, seed: int) -> dict[str, str]:
        def say(text: str) -> None:
            self.log.note("said", own.lab.now_us if lab else 0, text.replace(folder, "FOLDER"))

        def to_peers(*of: object) -> None:
            self.log.note("peers", *of)

        lab: list[Server] = []
        config = load_config(overrides=("radio.uplink_loss=0.0",))
        faults = (parse("push.y=0.2", live=True),)
        with TemporaryDirectory() as folder, replaced((server, "Paced", Clock)):
            plan = Service(config, number=self.pick(1, 2), faults=faults, state=Path(folder))
            watcher = Watcher() if seed == 3 else None
            own = Server(plan, say, watcher, to_peers)
            lab.append(own)
            own.open(Endpoints(station=self.pick("corrections", "poses")))
            live, chip = LiveFaults(own, say, {3: partial(self.log.note, "robot 3")}), own.served.nrf51
            own.lab.end_at(2_500_000)
            own.lab.run()
            for _ in range(40):
                now_us = own.lab.now_us
                what = self.pick(
                    "type", "type", "type", "hear", "hear", "hear", "fail", "fail", "button", "peer", "eeprom", "hang"
                )  # fmt: skip
                if what == "type":
                    number = self.pick(*(6 * [f"{plan.number} "]), "", "3 ", "7 ")
                    line = self.pick("status", "restart", "clear", "push.y=0.3", "imu.silent:0.3", "mocap.dropout:2", "help",
                                     "kinds", "statsu", "nothing", "push.y=x", "servo.stuck.1=0.4", "status",
                                     "battery.sag")  # fmt: skip
                    live.execute_line(number + line, now_us)
                elif what == "hear":
                    null = b"\xff"
                    data = self.pick(
                        null, null + b"\3\1" + self.pick(b"P", b"P", self.data(1)), null + b"\3\2" + bytes((self.below(4),)),
                        null + b"\xfe\2", null + b"\xfe\3",
                        null + b"\xfe\1", null + b"\xfe\xff", null + b"\xfe\xf0" + bytes((self.below(2),)),
                        null + b"\xfe\4", b"\x30\1",
                        null + b"\5\1", b"\x50\2\1", self.data(5),
                    )  # fmt: skip
                    self.log.note(
                        what, now_us, chip.hear(now_us, data).hex() if chip.power is not Power.OFF else "off"
                    )
                elif what == "fail":
                    unit = self.pick(*TABLE, 99)
                    numbers = int(unit), self.pick(0, 1, 1, 2, 3, 4, 5, 6, 7, 9), self.pick(0, 0, 1, 2, 5, -1)
                    self.log.note(what, *numbers, own._fail(now_us, *numbers))
                elif what == "button":
                    chip.press_button(now_us)
                elif what == "peer":
                    own.hear_peer(
                        AirSettings(80, 2_000_000, bytes.fromhex("FFE7E7E7E7")), peer_packet(self.data(4))
                    )
                elif what == "hang":
                    hang = failing(WatchdogError("task", now_us, "hangs"))
                    with replaced((type(own.robot.firmware), "check_watchdog", hang)):
                        own.lab.end_at(now_us + 10_000)
                        own.lab.run()
                else:
                    own.served._eeprom[self.below(64)] ^= self.below(256)
                own.lab.end_at(
                    now_us
                    + self.pick(10_000, 300_000, 1_100_000)
                    + self.pick(0, 4_000_000) * (chip.power is Power.OFF)
                )
                own.lab.run()
                kept = next(Path(folder).iterdir(), None)
                known = 0 if kept is None else hash_of(kept.read_bytes()[:64])
                body, signals = own.robot.body, own.robot.firmware.signals
                self.log.note(
                    "state", own.lab.now_us, chip.power, own.robot.free, own.robot.powered, body.lost, known
                )
                self.log.note(
                    "flight",
                    signals.supervisor.state,
                    signals.supervisor.cause,
                    *map(str, own.switchboard.active),
                )
            own.close()
            for batch in watcher.batches if watcher is not None else ():
                self.log.note("rows", batch.num_rows, batch.schema.names, sorted(batch.schema.metadata or {}))
            for note in watcher.notes if watcher is not None else ():
                self.log.note("notes", *note)
        return self.log.told()


class Hidden(Random):
    """The link of the built-in station to a board that boots now and then, with or without an image and its parameters."""

    def told(self, seed: int) -> dict[str, str]:
        config, events = load_config("crazyflie" if seed % 2 else "floaty"), EventQueue()
        scalar = Made(pack=lambda value: struct.pack("<f", value), type=7, code=7)
        table = dict.fromkeys(config.pilot.values, Made(scalar=scalar))
        firmwares = [
            Made(flashed=flashed) for flashed in (Made(parameters=table), None, Made(parameters=table))
        ]
        robot: Any = Made(config=config, events=events, booted_us=0, firmware=firmwares[0])
        robot.packet_received = lambda us, data: self.log.note("received", us, data.hex())
        from hil.servers import built_in_station

        with replaced(
            (built_in_station, "encode_set_by_name", lambda one: repr((one.name, one.value)).encode())
        ):
            link, now_us = HiddenLink(robot, seed == 3), 0
            for number in range(60):
                now_us += self.pick(10_000, 300_000, 1_000_000)
                events.run(now_us)
                if self.below(6) == 0:
                    robot.firmware, robot.booted_us = self.pick(*firmwares), self.pick(0, now_us)
                if self.pick(True, False):
                    link.start_telemetry(now_us)
                else:
                    place = tuple(self.rng.integers(-9, 9, 3).tolist())
                    link.send(
                        now_us,
                        MocapFrame(now_us - 9_000, place, (1.0, 0.0, 0.0, 0.0), True),
                        built_in_station.WORLD,
                    )
                self.log.note("latency", number, link.latency.us, link.receive(now_us, b"any"))
        return self.log.told()


def addresses(seed: int) -> dict[str, str]:
    """Return what each text for a serial line's end opens for one to three boards."""
    own = Random(seed)
    hosts = ("", "localhost", "10.0.0.2", "::1", "a:b")
    for kind in ("pty", "udp", "tcp", "ssh", ""):
        for rest in (None, "", *hosts[1:], "/tmp/x", "0", "1", "65533", "65534", "65535", "65536", "123456", "-1", "²",
                     *(f"{host}:{port}" for host in hosts for port in ("", "0", "9", "65535", "x"))):  # fmt: skip
            text = kind if rest is None else f"{kind}:{rest}"
            for count in (1, 2, 3):
                try:
                    own.log.note(kind, text, parse_addresses(text, count))
                except LabError as error:
                    own.log.note(kind, text, error)
    return own.log.told()


def opened() -> dict[str, str]:
    """Return what robots 1 to 3 open for each kind of endpoint, and what of it they close."""
    own = Random(0)

    def serving(name: str, result: object) -> Callable[..., object]:
        def serve(served: ServedRobot, *arguments: Any) -> object:
            shown = (one for one in arguments if isinstance(one, int | Sequence | Address))
            own.log.note(name, served.number, *shown)
            return result

        return serve

    changes = (("serve_radio", 7), ("serve_udp", "udp"), ("serve_mavlink", "line"))
    patched = [(ServedRobot, name, serving(name, result)) for name, result in changes]
    stations = [(server, "fly_built_in", lambda robot, *of: own.log.note("station", *of))]
    for number in (1, 2, 3):
        with TemporaryDirectory() as folder, replaced(*patched, *stations, (server, "Paced", Clock)):
            robot = Server(
                Service(load_config(), number=number, mavlink=number < 3, state=Path(folder)), print
            )
            lines = parse_addresses("tcp:5000", 3)
            for endpoints in (
                Endpoints(), Endpoints(udp=0), Endpoints(udp=1000), Endpoints(radio=0), Endpoints(radio=19_000),
                Endpoints(mavlink=lines), Endpoints(station="poses"), Endpoints(station="corrections"),
            ):  # fmt: skip
                own.log.note("opened", number, robot.open(endpoints, [8, 9]))
            served = robot.served
            closed = partial(own.log.note, "closed", number)
            served.udp, served._dongles = (
                Made(close=partial(closed, "udp")),
                Made(close=partial(closed, "dongles")),
            )  # type: ignore[assignment]
            served._line_end = Made(close=partial(closed, "line"), send=partial(own.log.note, "line"))  # type: ignore[assignment]
            served._eeprom[100] = number
            for _ in range(2):
                robot.close()
                served._from_line(0, b"data")
            own.log.note("kept", *(hash(one.read_bytes()[100]) for one in Path(folder).iterdir()))
            served._eeprom[:CONFIG_SIZE] = encode_config(RadioSettings(30 + number, 1, 0xE7E7E7E755))
            robot.close()
            again = Server(Service(load_config(), number=number, state=Path(folder)), print).served
            own.log.note("moved", again.uri, again.nrf51.settings)
            own.log.note(
                "uris", served.uri, served.robot.config.mavlink.system, served.channels()[0].quantities
            )
            own.log.note(
                "loader", served.nrf51.bootloader.stm32.flash[0x4000:0x4004].hex(), served.udp_radio._config
            )
    return own.log.told()


KINDS = (Cameras, Datagrams, Connections, Cable, Bus, Lines, Processes, Apart, Robot, Hidden)
FOUND: dict[str, Callable[[], dict[str, str]]] = {
    **by_seed(KINDS, SEEDS, lambda kind, seed: kind(seed).told(seed)),
    "opened": opened,
    "addresses": lambda: addresses(0),
}


# They reach no line that the others do not.
LONG = ["Robot 1", "Cameras 2", "Cameras 3"]


@pytest.mark.parametrize("name", tiers(FOUND, LONG))
def test_a_server_answers_random_clients_as_it_did(name: str) -> None:
    judge(ANSWERS, name, FOUND[name]())


if __name__ == "__main__":
    approve(ANSWERS, FOUND)
