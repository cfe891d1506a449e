"""The parts of a Crazyflie around its microcontroller answer random use as they did, at the same instants.

The radio chip with its boot loader, its end of the serial line, the decks' sensors and memories, the barometer. If a
change is meant: make approve.
"""

import json
import struct
import warnings
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.emulator.crazyflie import syslink
from hil.emulator.crazyflie.barometer import CONFIG, Barometer
from hil.emulator.crazyflie.bootloader import Bootloader
from hil.emulator.crazyflie.config import LAST_ADDRESS, RadioConfig
from hil.emulator.crazyflie.crazyflie import _check_board
from hil.emulator.crazyflie.log_table import log_numbers, log_table, parameter_table
from hil.emulator.crazyflie.nrf51 import BROADCAST, RATES, AirSettings, Band, Nrf51, Power, peer_packet
from hil.emulator.crazyflie.parts import Parts
from hil.emulator.crazyflie.radio_line import RadioLine
from hil.emulator.crazyflie.release_file import released_firmware
from hil.emulator.crazyflie.shockburst import Air
from hil.emulator.events import EVENTS_AT_ONE_INSTANT, EndlessInstantError, EventQueue
from hil.emulator.stm32f405.chip import OTP
from hil.errors import LabError
from hil.world.body import Carrier
from support.approved import Log, approve, judge
from support.deck_bench import DeckBench
from support.random_use import Random, by_seed, hash_of
from support.stm32_bench import Bench

USES = Path(__file__).with_name("parts.json")
SEEDS = range(1, 4)
HOME = bytes.fromhex("E7E7E7E7E7")
SYSLINK = (
    *(getattr(syslink, name) for name in dir(syslink) if isinstance(getattr(syslink, name), int)),
    0x41,
)


class RadioChip(Random):
    """The radio chip on the air, at power-on and off, and in its boot loader; it is its own processor."""

    battery_V = 3.75

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.events = EventQueue()
        air = Air.of(RadioConfig(uplink_loss=0.3, uplink_bit_error_rate=1e-3))
        self.air = Band(
            self.events, lambda: float(self.rng.random()), lambda *to: self.log.note("peers", *to)
        )
        settings = AirSettings(80, 2_000_000, HOME)
        self.chip = Nrf51(settings, bytes.fromhex("0110A7F10AC0"), 3, self.air, self, air)

    def __getattr__(self, name: str) -> Any:
        """Note what reaches the processor."""
        if name not in ("start", "stop", "greet", "received", "polled", "retuned"):
            raise AttributeError(name)
        return lambda *of: self.log.note(f"processor {name}", *of)

    def packet(self) -> bytes:
        """Return a packet that the chip, its boot loader, the processor or nobody understands."""
        null = 0xF3 | self.below(4) << 2
        place = struct.pack("<HH", self.pick(0, 0, 9, 20, 1023), self.pick(0, 25, 1000, 1023))
        return self.pick(
            bytes((null,)), bytes((self.below(256),)), bytes((null, 5, self.below(2))), bytes((null, 5)),
            bytes((self.below(16) << 4 | self.below(16),)) + self.data(0, 1, 5, 30),
            bytes((null, 0xFE, self.pick(1, 2, 3, 4, 0xF0, 0xFF, 0xFF, 9))) + self.pick(b"", b"\0", b"\1", b"\2ab"),
            bytes((0xFF, 0xFE, self.pick(2, 3, 3, 0xFF)),), bytes((0xFF, 0xFE, 0xF0, self.below(2))),
            bytes((0xFF, 0xFE, 0xF0)) + self.pick(b"", b"\0", b"\0\0", b"\1\1"), bytes((null, 0xFE)),
            bytes((0xFF, 0xFE, 0xF0)) + self.pick(b"\0\0", b"\1\1"),
            bytes((null, 3, self.pick(1, 1, 2, 2, 3), self.pick(0, 1, 2, 3, 80, 125, 126))), bytes((null, 3, 1)),
            bytes((null, 0x80 | self.below(16))) + self.data(0, 1, 9), bytes((null, self.below(256), 7, 7)),
            bytes((0xFF, self.pick(0xFE, 0xFF), self.pick(0x10, 0x12))),
            bytes((0xFF, self.pick(0xFE, 0xFF), self.pick(0x14, 0x1C))) + place + self.data(0, 25),
            bytes((0xFF, self.pick(0xFE, 0xFF), 0x18))
            + struct.pack("<HHH", self.pick(0, 0, 1, 9), self.pick(15, 16, 87, 88, 90, 231, 1023), self.pick(1, 1, 2, 10)),
            bytes((0xFF, self.pick(0xFE, 0xFF), self.pick(0x14, 0x18, 0x1C, 0x20))) + self.data(0, 2),
        )  # fmt: skip

    def settings(self) -> AirSettings:
        own = self.chip.settings
        wrong = AirSettings(own.channel, self.pick(*RATES), self.pick(own.address, BROADCAST))
        return self.pick(AirSettings(own.channel, own.bits_per_second, BROADCAST), wrong)

    def use(self) -> None:
        """Do one thing."""
        chip, now_us, log = self.chip, self.events.now_us, self.log
        what = self.pick(
            "hear", "hear", "hear", "hear", "send", "overhear", "peer", "command", "power", "written", "boot"
        )
        if what == "hear":
            packet = self.packet()
            log.note(what, packet.hex(), chip.hear(now_us, packet).hex())
        elif what == "send":
            log.note(what, chip.send(now_us, self.data(1, 5, 31)))
        elif what == "boot":
            for packet in (b"\xff\xfe\xff", bytes((0xFF, 0xFE, 0xF0, self.pick(0, 0, 1)))):
                log.note(what, packet.hex(), chip.hear(now_us, packet).hex())
        elif what == "overhear":
            chip.overhear(now_us, self.packet())
        elif what == "peer":
            chip.hear_peer(now_us, self.settings(), self.pick(peer_packet(self.data(1, 20)), self.packet()))
        elif what == "command":
            data = self.pick(b"", bytes((self.pick(0, 1, 2, 3, 90),)), self.data(5), self.data(1, 2, 20))
            chip.command(now_us, self.pick(1, 1, 2, 2, 5, 5, 0x0A, 0x0A, 7, 0x11, 0x1A), data)
        elif what == "power":
            act: Callable[..., object] = self.pick(chip.press_button, chip.press_button, chip.power_cycle)
            act(now_us)
            if self.pick(True, False):
                chip.tune(AirSettings(80, 2_000_000, HOME))
        else:
            loader = chip.bootloader
            log.note(what, hash_of(loader.take_written()), loader.malformed, hash_of(loader.nrf51.flash))

    def told(self) -> dict[str, str]:
        chip, booting = self.chip, AirSettings(0, 2_000_000, bytes.fromhex("B1F1A71001"))
        for _ in range(900):
            self.use()
            if chip.power is Power.OFF and self.pick(True, False, False):
                chip.press_button(self.events.now_us)
            self.events.run(self.events.now_us + self.pick(0, 10, 300, 1_500, 20_000, 101_000))
            hears = [chip.hears(booting), chip.hears(chip.settings), chip.hears_all(self.settings())]
            self.log.note("state", self.events.now_us, chip.power, chip.settings, hears, chip.heard_us)
        return self.log.told()


class Loader(Random):
    """Both boot loaders' packets, whole and cut."""

    def told(self) -> dict[str, str]:
        loader = Bootloader()
        loader.load(self.data(20_000))
        for _ in range(500):
            target, command = (
                self.pick(0xFF, 0xFE),
                self.pick(0x10, 0x12, 0x14, 0x14, 0x14, 0x1C, 0x18, 0x18, 0x20),
            )
            place = struct.pack("<HH", self.pick(0, 0, 9, 16, 88), self.pick(0, 25, 1000, 1023, 1024))
            write = struct.pack(
                "<HHH", self.pick(0, 1, 9), self.pick(15, 16, 88, 231, 1023), self.pick(0, 1, 2, 10)
            )
            rest = write if command == 0x18 else place + self.data(0, 25)
            packet = bytes((self.pick(0xFF, 0xFF, 0xFF, 0xF3), target, command)) + rest
            if self.below(9) == 0:
                packet = packet[: self.below(len(packet))]
            self.log.note("answer", packet.hex(), loader.answer(packet), loader.malformed)
            self.log.note(
                "written", hash_of(loader.take_written()[:30_000]), hash_of(loader.nrf51.flash[90_000:91_500])
            )
        return self.log.told()


class Line(Random):
    """The radio chip's end of the line, with the decks' memories; it is its own chip, processor and surroundings."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.events, self.full, self.bytes = EventQueue(), False, b""
        decks, processor = DeckBench("flow2", "multiranger").decks, SimpleNamespace(every=self.every)
        self.line = RadioLine(self, processor, decks, self, polls=True)  # type: ignore[arg-type]

    def every(self, period_us: int, do: Callable[[int], object]) -> None:
        self.events.every(period_us, period_us, do)

    @property
    def now_us(self) -> int:
        return self.events.now_us

    def feed(self, usart: int, data: bytes) -> None:
        self.log.note(f"fed {data[2]:02x}", self.now_us, usart, data.hex())

    def sent(self, usart: int) -> bytes:
        data, self.bytes = self.bytes, b""
        return data

    def pin(self, port: str, number: int, high: bool) -> None:
        self.log.note("pin", self.now_us, port, number, high)

    def read_battery_mv(self) -> int:
        return 3_000 + self.below(1_200)

    def radio_send(self, data: bytes) -> bool:
        self.log.note("radio", self.now_us, not self.full, data.hex())
        return not self.full

    def radio_command(self, kind: int, data: bytes) -> None:
        self.log.note("command", self.now_us, kind, data.hex())

    def debug_write(self, text: str) -> None:
        self.log.note("console", self.now_us, repr(text))

    def frame(self) -> bytes:
        """Return what the processor may say."""
        kind = self.pick(*SYSLINK, *(8 * (syslink.RAW,)))
        if syslink.SCAN_MEMORIES <= kind <= syslink.WRITE_MEMORY:
            at = self.pick(0, 8, 100, 109, 111, 200)
            data = struct.pack("<BH", self.below(3), at)
            size = self.pick(1, 3, 11)
            written = struct.pack("<H", size) + self.data(size)
            data += written if kind == syslink.WRITE_MEMORY else bytes(self.pick(0, 9, 29))
        else:
            text = self.pick(b"a\n", b"lines\nof\xff\n", b"half", b"")
            data = self.pick(b"\0" + text, b"\x0c" + text, b"\x10abc", b"", self.data(1, 5))
        return syslink.encode(kind, data)

    def told(self) -> dict[str, str]:
        for _ in range(500):
            for _ in range(self.below(3)):
                frame = self.frame()
                wrong = frame[: self.below(len(frame))] + self.data(1)
                self.bytes += self.pick(frame, frame, frame, frame, wrong, b"\xbc")
            cut = self.below(len(self.bytes) + 1)
            self.bytes, rest = self.bytes[:cut], self.bytes[cut:]
            self.line.sent()
            self.bytes += rest
            self.full = self.pick(True, False, False)
            if self.below(3) == 0:
                peer = peer_packet(self.data(1, 20))
                self.line.received(self.pick(self.data(1, 20), peer, syslink.EMPTY), self.pick(True, False))
            if self.below(100) == 0:
                self.line.reset(self.now_us)
            self.events.run(self.now_us + self.pick(0, 500, 1_999, 2_000, 12_000, 30_000))
        return self.log.told()


class DeckUser(Random):
    """Registers of both decks' sensors, of a body that moves."""

    RANGER_WRITES: Sequence[tuple[int, Callable[["DeckUser"], bytes]]] = (
        (0x5E, lambda own: bytes((own.below(2), 0x20 + own.below(96), own.pick(7, 11, 15, 3)))),
        (0x61, lambda own: bytes((own.below(2), 0x20 + own.below(96), own.pick(7, 11, 15)))),
        (0x6C, lambda own: own.pick(0, 600 * 30, 600 * 60).to_bytes(4)),
        (0x30, lambda own: bytes((own.pick(0x00, 0x10), own.below(2)))),
        (0x86, lambda own: bytes((own.below(2), own.pick(0x40, 0x40, 0x10, 0x20, 0x80, 0x00, 0xC0)))),
        (0x87, lambda own: bytes((own.pick(0x40, 0x10),))),
    )

    def told(self) -> dict[str, str]:
        bench = DeckBench("flow2", "multiranger")
        self.log.note("flow", bench.transfer(bytes(4)).hex(), bench.transfer(b"\x16" + bytes(12)).hex())
        bench.write(0x20, b"\3\0")
        for number in range(500):
            address = self.pick(0x29, 0x29, 0x35, 0x36)
            what = self.pick(
                "move", "expander", "address", "write", "write", "write", "read", "read", "read", "flow"
            )
            if what == "move":
                angles, place = self.rng.normal(0, 0.3, 4), self.rng.uniform(-1, 1, 3)
                quaternion = np.array((1.0, *angles[:3])) / np.sqrt(1.0 + angles[:3] @ angles[:3])
                bench.place((*place[:2], 1.2 * abs(place[2]) - 0.05), tuple(quaternion.tolist()))
            elif what == "expander":
                bench.write(0x20, bytes((self.pick(1, 1, 3), self.pick(0x01, 0x10, 0x57, 0x00, 0xA8))))
                self.log.note(what, bench.read(0x20, b"\1", 1).hex(), bench.read(0x20, b"\3", 1).hex())
            elif what == "flow":
                register = self.pick(0x00, 0x02, 0x16, 0x16, 0x5F)
                received = bench.transfer(
                    self.pick(bytes((register, *(12 * (0,)))), b"\xba\x5a", b"\xba\0", b"\xc0\7")
                )
                self.log.note(what, register, bench.us, received.hex())
            elif bench.answers(address):
                bench.stop()
                if what == "address":
                    bench.write(address, bytes((0, 1, self.pick(0x29, 0x35, 0x36))))
                elif what == "write":
                    register, contents = self.pick(*self.RANGER_WRITES)
                    bench.write(address, register.to_bytes(2) + contents(self))
                else:
                    register, size = self.pick((0x88, 20), (0x31, 1), (0xDE, 8), (0x10F, 3), (0x01, 6))
                    received = bench.read(address, register.to_bytes(2), size)
                    self.log.note(f"ranger {address:02x}", number, register, received.hex())
            bench.wait(self.pick(0, 1_000, 8_264, 40_000))
        return self.log.told()


class Sensors(Random):
    """The IMU's and the barometer's registers of a body that moves anywhere, with ESCs or without."""

    def told(self) -> dict[str, str]:
        chip, eeprom = Bench().chip, np.zeros(8192, np.uint8)
        motion = SimpleNamespace(p_WB=np.zeros(3))
        carrier = Carrier(motion, self.rng, escs=self.pick(None, np.zeros(4)))  # type: ignore[arg-type]
        parts = Parts(chip, eeprom, self.pick(carrier, carrier, carrier, None))
        self.log.note(
            "board", parts.device_type, chip.read(OTP, 16), parts.gyro.tobytes(), parts.accel.tobytes()
        )
        for _ in range(100):
            motion.p_WB = np.array((5.0, -7.0, 0.01 * self.below(300) - 1.0))
            parts._barometer._registers[CONFIG] = self.pick(0, 2, 4)
            parts.measure_pressure()
            parts.sample(self.rng.integers(-32_768, 32_768, 6).tolist())
            registers = parts.gyro, parts.accel, parts._barometer._registers
            self.log.note("registers", *(one[:32].tobytes().hex() for one in registers))
        return self.log.told()


class Releases(Random):
    """Release files with manifests of all kinds, of which few have one firmware for the board."""

    def told(self) -> dict[str, str]:
        path = Path("release.zip")
        for _ in range(300):
            files = {}
            for name in ("stm.bin", "nrf.bin", "radio.bin")[: 1 + self.below(3)]:
                part: dict[str, Any] = {
                    "target": self.pick(
                        *(9 * [name[:-4] + "32"]), "nrf51", ["stm32", "nrf51"], ["nrf51"], [], 3
                    ),
                    "type": self.pick(*(12 * ["fw"]), "bootloader", None),
                }
                if self.below(9):
                    part["platform"] = self.pick(*(9 * ["cf2"]), "tag", "cf3")
                if self.below(3) == 0:
                    part["release"] = self.pick("2024.1", "x\n", 7)
                files[self.pick(*(20 * [name]), "a/b", ".hidden", 100 * "n", 101 * "n")] = part
            version, listed = self.pick(*(5 * [1, 2]), 3), self.pick(*(15 * [files]), [], {})
            manifest: dict[str, Any] = {"version": version, "files": listed}
            if self.below(2):
                manifest["fw_platform"] = self.pick("cf2", "cf2", "cf21bl", "bolt", "flapper", "new")
            if self.below(3) == 0:
                manifest["release"] = "2025.2"
            text = json.dumps(manifest)
            text = self.pick(*(20 * [text]), text.replace("{", '{"version": 1, ', 1), text[1:], "[]")
            packed = BytesIO()
            with zipfile.ZipFile(packed, "w") as file, warnings.catch_warnings():
                warnings.simplefilter("ignore")
                for name in files if self.below(9) else ():
                    for _ in range(self.pick(*(9 * [1]), 2)):
                        file.writestr(name, self.data(8))
                if self.below(20):
                    file.writestr("manifest.json", text)
            try:
                self.log.note("taken", released_firmware(path, packed.getvalue()))
            except LabError as error:
                self.log.note("refused", error)
        return self.log.told()


class Boards(Random):
    """Images built for any boards, with names and without, on a robot of each type."""

    def told(self) -> dict[str, str]:
        types = "CF21", "C21B", "CB11", "CB10", "RR10", "CF20"
        for _ in range(300):
            found = [one.encode() + self.pick(b"\0", b"\0", b"x") for one in types if self.below(3) == 0]
            code = b"".join([*found, self.pick(b"", b"", b"", b"Flapper (")])
            has = self.pick(True, False)
            image: Any = SimpleNamespace(
                code=code, named=self.pick(True, False), path="image", has=lambda name, has=has: has
            )
            try:
                self.log.note("board", _check_board(image, self.pick("CF21", "C21B")))
            except LabError as error:
                self.log.note("board", error)
        return self.log.told()


class Tables(Random):
    """Tables of log variables and parameters in code with and without names, between entries that belong to none."""

    def told(self) -> dict[str, str]:
        base = 0x0800_4000
        for _ in range(60):
            names, code = [b"alpha", b"b", b"gamma_9", b"\xffno", b"-x", 40 * b"n"], bytearray(64)
            at = {
                name: base + len(code) + sum(len(one) + 1 for one in names[:number])
                for number, name in enumerate(names)
            }
            code += b"".join(name + b"\0" for name in names) + bytes(-sum(len(one) + 1 for one in names) % 4)
            table, size = self.pick(("log", 12), ("param", 20))
            begin = len(code)
            for _ in range(self.pick(0, 1, 3, 4)):
                self.group(code, at, size)
            end, middle = len(code), bytes(4 * self.pick(0, 1, 3))
            code += middle
            for _ in range(self.pick(0, 1, 2)):
                self.group(code, at, self.pick(12, 20))
            code += bytes(4 * self.below(4))
            ends = {f"_{table}_start": base + begin, f"_{table}_stop": base + end}
            image: Any = SimpleNamespace(
                code=bytes(code), base=base, named=self.pick(True, False, False),
                has=self.pick(*(4 * [ends.__contains__]), lambda name: name.endswith("stop"), lambda _: False),
                symbol=lambda name, ends=ends: SimpleNamespace(address=ends[name]),
            )  # fmt: skip
            chip: Any = SimpleNamespace(
                read=lambda where, size, code=code: bytes(code[where - base :][:size]).ljust(size, b"\5")
            )
            self.log.note("numbers", log_numbers(image, chip))
            for one in log_table(image, chip):
                self.log.note("log", one.name, one.scalar, one.read(), one.unit)
            for name, found in parameter_table(image, chip).items():
                self.log.note("parameters", name, found.number, found.scalar, found.writable, found.read())
        return self.log.told()

    def group(self, code: bytearray, at: dict[bytes, int], size: int) -> None:
        """Append a group of entries, of which some are not well made."""
        flags = self.pick(0, 0, 0x20)
        entries = [(0x81 | flags, self.pick(*at.values()))]
        for _ in range(self.below(4)):
            kind = self.pick(*range(1, 11), 0x41, 0x48, 0x28, 0x07)
            entries.append((kind, self.pick(*at.values(), 0, *[at[b"alpha"]] * 8)))
        for kind, name in [*entries, (self.pick(0x80, 0x80, 0x80, 0xA0, 0x81), self.pick(*at.values()))]:
            code += struct.pack("<BxxxII", kind, name, self.pick(0x2000_0000, 0x0800_4000, 0)) + bytes(
                size - 12
            )


class Events(Random):
    """Events planned for once and for ever, the beat, and callbacks that plan others or fail, in runs of any length."""

    def told(self) -> dict[str, str]:
        events = EventQueue()

        def happen(number: int, us: int) -> None:
            self.log.note("ran", number, us, events.now_us, events.next_us, events.other_us)
            what = self.pick(*10 * [None], "at", "at", "past", "fail")
            if what == "at":
                events.at(us + self.pick(0, 1, 5), partial(happen, number + 1000))
            elif what == "past":
                events.at(us - 1, print)
            elif what == "fail":
                raise KeyError("failed")

        for number in range(300):
            what = self.pick("at", "every", "beat", "run", "run", "run", "leave", "many")
            start_us, act = events.now_us + self.pick(-1, 0, 1, 7, 20), partial(happen, number)
            try:
                if what == "at":
                    events.at(start_us, act)
                elif what == "every" and number < 100:
                    events.every(self.pick(-1, 0, 5, 10, 40), start_us, act)
                elif what == "beat" and number < 100:
                    events.set_beat(self.pick(3, 10), max(start_us, events.now_us), act)
                elif what == "many" and number > 295:
                    for _ in range(EVENTS_AT_ONE_INSTANT - self.pick(1, 10, 100)):
                        events.at(events.now_us + 1, int)
                    events.run(events.now_us + 1)
                else:
                    events.run(events.now_us + self.pick(0, 1, 10, 30), leave_beat=what == "leave")
            except (KeyError, ValueError, EndlessInstantError) as error:
                self.log.note("failed", number, repr(error)[:60])
            self.log.note("state", number, events.now_us, events.next_us, events.other_us)
        return self.log.told()


class Weather(Random):
    """A barometer that rises and falls, with each of its filters."""

    def told(self) -> dict[str, str]:
        registers = np.zeros(256, np.uint8)
        barometer = Barometer(registers)
        for _ in range(300):
            if self.below(5) == 0:
                registers[CONFIG] = self.below(256)
            barometer.measure(self.below(2_000) * 1e-3, self.below(2_000) * 1e-3 - 1.0)
            self.log.note("registers", registers[:10].tobytes().hex())
        return self.log.told()


def accepted() -> dict[str, str]:
    """Return which values each key of the section `radio` accepts."""
    log = Log()
    numbers = (
        -1,
        0,
        1e-9,
        0.5,
        1,
        1.5,
        2,
        124,
        125,
        126,
        1000,
        1001,
        10_000,
        10_001,
        250_000,
        999_999,
        1_000_000,
        1_000_001,
    )
    last = f"{LAST_ADDRESS:X}"
    texts = (
        "",
        "E7E7E7E7E7",
        "e7e7e7e7e7",
        "E7E7E7E7E",
        "E7E7E7E7E7E",
        "0000000000",
        last,
        f"{LAST_ADDRESS + 1:X}",
        "G7E7E7E7E7",
    )
    for name in RadioConfig.model_fields:
        for value in (*numbers, *texts, True, None):
            try:
                log.note(name, repr(getattr(RadioConfig.model_validate({name: value}), name)))
            except ValueError:
                log.note(name, value, "refused")
    log.note("all", last, RadioConfig())
    return log.told()


KINDS = (RadioChip, Loader, Line, DeckUser, Sensors, Releases, Boards, Tables, Events, Weather)
FOUND = by_seed(KINDS, SEEDS, lambda kind, seed: kind(seed).told()) | {"accepted": accepted}


@pytest.mark.parametrize("name", FOUND)
def test_a_part_answers_random_use_as_it_did(name: str) -> None:
    judge(USES, name, FOUND[name]())


if __name__ == "__main__":
    approve(USES, FOUND)
