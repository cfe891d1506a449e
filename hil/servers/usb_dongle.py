"""Gives a program in any language a Crazyradio on its USB bus that is really a running `floaty serve --radio`.

    python -m hil.servers.usb_dongle 127.0.0.1:PORT PROGRAM ...

runs a program under the preload library of umockdev. That redirects the program's view of /sys and /dev to a folder made
here, and passes each ioctl on the device node to the socket beside it: a request of three words (kind, two arguments),
answered by orders to read or write the program's memory, then by its result. Layouts are those of Linux's
<linux/usbdevice_fs.h> on 64-bit machines. A read that waits for the dongle stays open until the program reaps it, so
a program's other transfers go on.
"""

import errno
import os
import selectors
import signal
import socket
import struct
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from hil.servers.dongle_plugin import (
    ATTRIBUTES,
    CONNECT_TIMEOUT_S,
    Connection,
    all_descriptors,
    standard_request,
)

PRELOAD = "libumockdev-preload.so.0"
MISSING = "umockdev is not installed: apt install umockdev"
NODE = "bus/usb/001/002"
MAJOR_MINOR = "189:1"
PATIENCE_S, TURN_S = 0.001, 0.1  # of a program that asks again and again; between looks at the program

IOCTL, RESULT, DONE, RUN, READ_MEMORY, WRITE_MEMORY, READ, WRITE = 1, 2, 3, 4, 5, 6, 7, 8
WORDS = struct.Struct("=3Q")

CONTROL, BULK, SUBMIT, REAP, REAP_NOW = 0xC0185500, 0xC0185502, 0x8038550A, 0x4008550C, 0x4008550D
DISCARD, CAPABILITIES, GET_DRIVER, DRIVER_IOCTL, SPEED = 0x550B, 0x8004551A, 0x41045508, 0xC0105512, 0x551F
ACCEPTED = (  # set interface and configuration, claim, release, reset, clear halt, disconnect and claim
    0x80085504, 0x80045505, 0x8004550F, 0x80045510, 0x5514, 0x80045515, 0x8108551B,
)  # fmt: skip
URB = struct.Struct(
    "=BB2xiI4xQiiiiiIQ"
)  # type, end point, status, flags, buffer, its length, length, ..., context
URB_STATUS, URB_LENGTH = 4, 28  # places in it
URB_CONTROL, URB_BULK = 2, 3
SETUP = struct.Struct("=BBHHH")
TRANSFER_CONTROL, TRANSFER_BULK = struct.Struct("=BBHHHI4xQ"), struct.Struct("=III4xQ")
FULL_SPEED = 2
IN = 0x80


def make_bus(folder: Path) -> Path:
    """Write the files of the dongle in sysfs and devfs below a folder; return the path of its socket for ioctls."""
    device = folder / "sys/devices/pci0000:00/usb1/1-1"
    for place in (
        device,
        folder / "sys/bus/usb/devices",
        folder / "dev/.node",
        (folder / "dev" / NODE).parent,
    ):
        place.mkdir(parents=True)
    (device / "descriptors").write_bytes(all_descriptors())
    bus, number = NODE.split("/")[-2:]
    attributes = {
        **ATTRIBUTES, "busnum": f"{int(bus)}", "devnum": f"{int(number)}", "speed": "12", "bConfigurationValue": "1",
        "dev": MAJOR_MINOR,
        "uevent": f"MAJOR=189\nMINOR=1\nDEVNAME={NODE}\nDEVTYPE=usb_device\nBUSNUM={bus}\nDEVNUM={number}",
    }  # fmt: skip
    for name, value in attributes.items():
        (device / name).write_text(f"{value}\n")
    (device / "subsystem").symlink_to("../../../../bus/usb")
    (folder / "sys/bus/usb/devices/1-1").symlink_to("../../../devices/pci0000:00/usb1/1-1")
    (folder / "dev" / NODE).write_bytes(all_descriptors())
    (folder / "dev/.node" / NODE.replace("/", "_")).symlink_to(MAJOR_MINOR)
    place = folder / "ioctl/dev" / NODE
    place.parent.mkdir(parents=True)
    return place


class OpenDevice:
    """The device node as one open file of the program; `answer` a request of its socket."""

    def __init__(self, program: socket.socket, connect: Callable[[], Connection]) -> None:
        self._program, self._connect = program, connect
        self._dongle: Connection | None = None
        self._reading: deque[tuple[int, int, int]] = deque()  # place of a URB, its buffer and size
        self._ready: deque[int] = deque()  # places of the completed URBs
        self._gone = False  # the server

    def answer(self) -> bool:
        """Execute the next request; return False at the end."""
        try:
            kind, one, two = WORDS.unpack(self._received(WORDS.size))
            result = self._do(one, two) if kind == IOCTL else self._by_itself()
            failed = result < 0
            self._program.sendall(WORDS.pack(DONE, 2**64 - 1 if failed else result, -result if failed else 0))
        except (EOFError, ConnectionError):
            self.close()
            return False
        return True

    def close(self) -> None:
        self._program.close()
        if self._dongle is not None:
            self._dongle.close()

    def _received(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            piece = self._program.recv(size - len(data))
            if not piece:
                raise EOFError
            data += piece
        return data

    # The program's memory

    def _read(self, place: int, size: int) -> bytes:
        self._program.sendall(WORDS.pack(READ_MEMORY, place, size))
        return self._received(size)

    def _write(self, place: int, data: bytes) -> None:
        if data:
            self._program.sendall(WORDS.pack(WRITE_MEMORY, place, len(data)) + data)

    def _by_itself(self) -> int:
        """Let the program read or write the file of the device node."""
        self._program.sendall(WORDS.pack(RUN, 0, 0))
        result: int
        _, result, error = WORDS.unpack(self._received(WORDS.size))
        return -error if result & 0xFFFFFFFF == 0xFFFFFFFF else result

    # Requests; each returns a result of 0 or more, or an error's negative number

    def _do(self, number: int, place: int) -> int:
        if number in ACCEPTED:
            return 0
        simple = {GET_DRIVER: -errno.ENODATA, DRIVER_IOCTL: -errno.ENODATA, SPEED: FULL_SPEED}
        if number in simple:
            return simple[number]
        if number == CAPABILITIES:
            self._write(place, bytes(4))
            return 0
        known: dict[int, Callable[[int], int]] = {
            CONTROL: self._control, BULK: self._bulk, SUBMIT: self._submit, DISCARD: self._discard,
            REAP: self._reap, REAP_NOW: self._reap_now,
        }  # fmt: skip
        return known[number](place) if number in known else -errno.ENOTTY

    def _control(self, place: int) -> int:
        kind, request, value, _, size, _, data = TRANSFER_CONTROL.unpack(
            self._read(place, TRANSFER_CONTROL.size)
        )
        sent = b"" if kind & IN or not size else self._read(data, size)
        answer = self._controlled(kind, request, value, sent)
        self._write(data, answer[:size])
        length: int = min(len(answer), size) if kind & IN else size
        return -errno.ENODEV if self._gone else length

    def _controlled(self, kind: int, request: int, value: int, sent: bytes) -> bytes:
        if kind & 0x60 == 0:
            return standard_request(request, value)
        self._to_dongle(lambda dongle: dongle.control(bytes((request, value & 0xFF, value >> 8)) + sent))
        return b""

    def _bulk(self, place: int) -> int:
        size: int
        point, size, timeout_ms, data = TRANSFER_BULK.unpack(self._read(place, TRANSFER_BULK.size))
        if not point & IN:
            sent = self._read(data, size)
            return size if self._to_dongle(lambda dongle: dongle.write(sent)) else -errno.ENODEV
        answer = self._answered((timeout_ms or 2**31) / 1000)
        if answer is None:
            return -errno.ENODEV if self._gone else -errno.ETIMEDOUT
        self._write(data, answer[:size])
        return min(len(answer), size)

    def _submit(self, place: int) -> int:
        kind, point, _, _, data, size, *_ = URB.unpack(self._read(place, URB.size))
        if kind == URB_CONTROL:
            if size < SETUP.size:
                return -errno.EINVAL
            setup = self._read(data, size)
            direction, request, value, _, length = SETUP.unpack(setup[: SETUP.size])
            if size < SETUP.size + length:
                return -errno.EINVAL
            answer = self._controlled(direction, request, value, setup[SETUP.size :])[:length]
            self._write(data + SETUP.size, answer)
            self._complete(place, -errno.ENODEV if self._gone else len(answer) if direction & IN else length)
        elif kind != URB_BULK:
            return -errno.EINVAL
        elif point & IN:
            self._reading.append((place, data, size))
        else:
            sent = self._read(data, size)
            self._complete(
                place, size if self._to_dongle(lambda dongle: dongle.write(sent)) else -errno.ENODEV
            )
        return 0

    def _complete(self, place: int, length: int) -> None:
        """Note a transfer of a length, or its error, in the program's memory, ready to be reaped."""
        self._write(place + URB_STATUS, struct.pack("=i", min(length, 0)))
        self._write(place + URB_LENGTH, struct.pack("=i", max(length, 0)))
        self._ready.append(place)

    def _discard(self, place: int) -> int:
        for one in self._reading:
            if one[0] == place:
                self._reading.remove(one)
                self._complete(place, -errno.ENOENT)
                return 0
        return -errno.EINVAL

    def _reap(self, place: int) -> int:
        while (result := self._reap_now(place)) == -errno.EAGAIN:
            pass
        return result

    def _reap_now(self, place: int) -> int:
        """Hand over a completed transfer. A node is always ready to be polled: wait a little before there is none."""
        if not self._ready and self._reading:
            self._fetch()
        elif not self._ready:
            time.sleep(PATIENCE_S)
        if not self._ready:
            return -errno.EAGAIN
        self._write(place, struct.pack("=Q", self._ready.popleft()))
        return 0

    def _fetch(self) -> None:
        """Complete the oldest read if the dongle has an answer."""
        answer = self._answered(PATIENCE_S)
        if answer is None and not self._gone:
            return
        place, data, size = self._reading.popleft()
        if answer is None:
            self._complete(place, -errno.ENODEV)
        else:
            self._write(data, answer[:size])
            self._complete(place, min(len(answer), size))

    # The dongle

    def _to_dongle(self, act: Callable[[Connection], object]) -> bool:
        """Do something with the dongle; return False when the server is gone."""
        try:
            if self._dongle is None:
                self._dongle = self._connect()
            act(self._dongle)
        except OSError:
            self._gone = True
        return not self._gone

    def _answered(self, timeout_s: float) -> bytes | None:
        """Return the answer to the last packet, None if it does not come in time or the server is gone."""
        if self._dongle is None or not self._dongle.awaits_answer:
            time.sleep(min(timeout_s, PATIENCE_S))
            return None
        try:
            return self._dongle.read(timeout_s)
        except TimeoutError:
            return None
        except OSError:
            self._gone = True
            return None


def run(server: tuple[str, int], program: Sequence[str]) -> int:
    """Run a program with the dongle of a server on its bus; return its exit code, 127 if it cannot be started."""
    with TemporaryDirectory(prefix="floaty-usb-") as folder, socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(make_bus(Path(folder))))
        listening.listen()
        before = os.environ.get("LD_PRELOAD")
        environment = {
            **os.environ, "UMOCKDEV_DIR": folder, "LD_PRELOAD": f"{PRELOAD}:{before}" if before else PRELOAD,
        }  # fmt: skip
        try:
            process = subprocess.Popen(program, env=environment)
        except OSError as error:
            print(f"{program[0]}: {error.strerror}", file=sys.stderr)
            return 127
        signal.signal(signal.SIGTERM, lambda *_: process.terminate())
        with suppress(KeyboardInterrupt):
            _serve(listening, lambda: Connection(*server), lambda: process.poll() is None)
        code = process.wait()
        return code if code >= 0 else 128 - code


def _serve(listening: socket.socket, connect: Callable[[], Connection], running: Callable[[], bool]) -> None:
    with selectors.DefaultSelector() as selector:
        selector.register(listening, selectors.EVENT_READ)
        while running():
            for key, _ in selector.select(TURN_S):
                if key.fileobj is listening:
                    program, _ = listening.accept()
                    selector.register(program, selectors.EVENT_READ, OpenDevice(program, connect))
                elif not key.data.answer():
                    selector.unregister(key.fileobj)


def why_not() -> str:
    """Return why programs cannot be given a dongle here; empty: they can."""
    places = ("/usr/lib", "/usr/lib64", "/usr/local/lib")
    found = any(
        path for place in places for path in (*Path(place).glob(PRELOAD), *Path(place).glob(f"*/{PRELOAD}"))
    )
    if struct.calcsize("P") != 8 or sys.byteorder != "little":
        return "needs a 64-bit little-endian machine"
    return "" if found else MISSING


def command_of(port: int) -> list[str]:
    """Return the words before a program that give it the dongle of a server on this machine."""
    return [sys.executable, "-m", "hil.servers.usb_dongle", f"127.0.0.1:{port}"]


def start(port: int, program: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start a program that has the dongle of the server on a port of this machine."""
    return subprocess.Popen([*command_of(port), *program])


def end(client: subprocess.Popen[bytes]) -> int:
    """End a started program that still runs, and return its exit code, 0 if it was ended here."""
    running = client.poll() is None
    if running:
        client.terminate()
    code = client.wait()
    return 0 if running else code


def main(arguments: Sequence[str]) -> int:
    """Run a program as the first argument's server has a dongle."""
    if len(arguments) < 2 or ":" not in arguments[0]:
        print("usage: python -m hil.servers.usb_dongle HOST:PORT PROGRAM ...", file=sys.stderr)
        return 2
    if why := why_not():
        print(why, file=sys.stderr)
        return 2
    host, _, port = arguments[0].rpartition(":")
    try:
        socket.create_connection((host, int(port)), CONNECT_TIMEOUT_S).close()
    except (OSError, ValueError) as error:
        print(f"{arguments[0]}: no `floaty serve --radio` there ({error})", file=sys.stderr)
        return 2
    return run((host, int(port)), arguments[1:])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
