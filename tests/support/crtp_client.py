"""A client of the board's CRTP services that speaks in bytes: requests in, replies out, in simulated time."""

import struct

from firmware_py.firmware import Firmware
from firmware_py.wire import crtp
from firmware_py.wire.parameters import TYPE_EXTENDED, TYPE_READ_ONLY
from firmware_py.wire.scalars import LOG_SCALARS, PARAMETER_SCALARS
from ground_station.links.crtp_controls import TocEntry
from hil.config import load_config
from hil.emulator.events import EventQueue
from support.firmware_bench import FirmwareBench

PARAM, MEM, LOG, LOC, SUPERVISOR, PLATFORM, LINK = 2, 4, 5, 6, 9, 13, 15


class CrtpClient(FirmwareBench):
    """A bench with a radio partner; `reboot` keeps only what survives a power cycle."""

    def __init__(self) -> None:
        super().__init__()
        self.run(20_000)
        self.sent.clear()

    def reboot(self) -> None:
        self.now_us = 0
        self.events = EventQueue()
        self.events.at(1000, self._sample)
        self.firmware = Firmware(load_config(), self)
        self.sent.clear()
        self.run(20_000)

    def send(self, port: int, channel: int, data: bytes) -> None:
        raw = crtp.encode(crtp.Packet(port, channel, data))
        self.firmware.radio_received(raw)

    def packets(self, port: int, channel: int) -> list[bytes]:
        packets = (crtp.decode(raw) for _, raw in self.sent)
        return [packet.data for packet in packets if (packet.port, packet.channel) == (port, channel)]

    def ask(self, port: int, channel: int, data: bytes, wait_us: int = 3000) -> list[bytes]:
        self.sent.clear()
        self.send(port, channel, data)
        self.run(self.now_us + wait_us)
        return self.packets(port, channel)

    def one(self, port: int, channel: int, data: bytes) -> bytes:
        (reply,) = self.ask(port, channel, data)
        return reply

    def toc(self, port: int) -> dict[str, tuple[int, int]]:
        """Number and type byte by name."""
        count = struct.unpack_from("<H", self.one(port, 0, b"\x03"), 1)[0]
        table = {}
        for number in range(count):
            reply = self.one(port, 0, struct.pack("<BH", 2, number))
            assert reply[:3] == struct.pack("<BH", 2, number)
            group, name, rest = reply[4:].split(b"\0")
            assert rest == b""
            table[f"{group.decode()}.{name.decode()}"] = (number, reply[3])
        return table

    def entries(self) -> dict[str, TocEntry]:
        """What a client makes of the table of parameters."""
        return {
            name: TocEntry(
                number, PARAMETER_SCALARS[kind & 0x0F], not kind & TYPE_READ_ONLY, bool(kind & TYPE_EXTENDED)
            )
            for name, (number, kind) in self.toc(PARAM).items()
        }

    def read(self, table: dict[str, tuple[int, int]], name: str) -> float:
        number, kind = table[name]
        reply = self.one(PARAM, 1, struct.pack("<H", number))
        assert reply[:3] == struct.pack("<HB", number, 0)
        return PARAMETER_SCALARS[kind & 0x0F].unpack(reply[3:])

    def write(self, table: dict[str, tuple[int, int]], name: str, value: float) -> float:
        """Write and return the value that the reply says is in force."""
        number, kind = table[name]
        scalar = PARAMETER_SCALARS[kind & 0x0F]
        data = struct.pack("<H", number) + struct.pack("<" + scalar.format, value)
        reply = self.one(PARAM, 2, data)
        assert reply[:2] == struct.pack("<H", number)
        return scalar.unpack(reply[2:])

    def create(self, block: int, *items: tuple[int, int]) -> int:
        """Make a log block of (type, id) as cflib does, with the type twice, and return the status."""
        packed = b"".join(struct.pack("<BH", kind << 4 | kind, number) for kind, number in items)
        data = bytes((6, block)) + packed
        reply = self.one(LOG, 1, data)
        assert reply[:2] == bytes((6, block))
        return reply[2]

    def log(self, table: dict[str, tuple[int, int]], *names: str) -> list[float]:
        """The present values of log variables, each as its own type, by blocks that are sent once."""
        values = []
        for name in names:
            number, kind = table[name]
            assert self.create(200, (kind, number)) == 0
            assert self.one(LOG, 1, bytes((3, 200, 0))) == bytes((3, 200, 0))
            self.run(self.now_us + 3000)
            (data,) = self.packets(LOG, 2)
            assert data[0] == 200
            values.append(LOG_SCALARS[kind].unpack(data[4:]))
            assert self.one(LOG, 1, bytes((2, 200))) == bytes((2, 200, 0))
        return values
