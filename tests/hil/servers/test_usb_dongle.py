"""A program's ioctls on the virtual Crazyradio, with the layouts and numbers of Linux's <linux/usbdevice_fs.h>."""

import ctypes
import errno
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from ctypes import c_char, c_int, c_ubyte, c_uint, c_uint16, c_void_p, sizeof
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from hil.servers import usb_dongle
from hil.servers.dongle_plugin import all_descriptors
from hil.servers.usb_dongle import OpenDevice


def structure(*fields: tuple[str, Any]) -> Any:
    return type("Structure", (ctypes.Structure,), {"_fields_": list(fields)})


Control = structure(
    ("kind", c_ubyte), ("request", c_ubyte), ("value", c_uint16), ("index", c_uint16), ("length", c_uint16),
    ("timeout", c_uint), ("data", c_void_p),
)  # fmt: skip
Bulk = structure(("point", c_uint), ("length", c_uint), ("timeout", c_uint), ("data", c_void_p))
Urb = structure(
    ("kind", c_ubyte), ("point", c_ubyte), ("status", c_int), ("flags", c_uint), ("buffer", c_void_p), ("length", c_int),
    ("actual", c_int), ("start", c_int), ("packets", c_int), ("errors", c_int), ("signal", c_uint), ("context", c_void_p),
)  # fmt: skip
Claim = structure(("interface", c_uint), ("flags", c_uint), ("driver", c_char * 256))


def ioc(direction: int, number: int, kind: Any = None) -> int:
    return direction << 30 | (sizeof(kind) if kind else 0) << 16 | ord("U") << 8 | number


CONTROL, BULK, SUBMIT, DISCARD = ioc(3, 0, Control), ioc(3, 2, Bulk), ioc(2, 10, Urb), ioc(0, 11)
REAP, REAP_NOW = ioc(1, 12, c_void_p), ioc(1, 13, c_void_p)
URB_ISO, URB_CONTROL, URB_BULK = 0, 2, 3
A, B, C = 0x1000, 0x2000, 0x3000  # places in the program's memory


class Dongle:
    """What is sent to it, and the answers that it has."""

    def __init__(self) -> None:
        self.controlled, self.written, self.answers = list[bytes](), list[bytes](), list[bytes | OSError]()
        self.timeouts = list[float]()
        self.control = self.controlled.append

    def write(self, data: bytes) -> None:
        self.written.append(data)

    @property
    def awaits_answer(self) -> bool:
        return bool(self.answers)

    def read(self, timeout_s: float) -> bytes:
        self.timeouts.append(timeout_s)
        answer = self.answers.pop(0)
        if isinstance(answer, OSError):
            raise answer
        return answer

    def close(self) -> None:
        self.written.append(b"closed")


class Program:
    """A program under the preload library, and its memory."""

    def __init__(self) -> None:
        self.memory, self.dongle = bytearray(0x4000), Dongle()
        self.end, device = socket.socketpair()
        self.device = OpenDevice(device, self._connect)
        self.there, self.file = True, (0, 0)

    def _connect(self) -> Any:
        if not self.there:
            raise ConnectionRefusedError
        return self.dongle

    def put(self, place: int, data: Any) -> int:
        self.memory[place : place + len(bytes(data))] = bytes(data)
        return place

    def ask(self, kind: int, one: int, two: int) -> int:
        """Return a request's result, or the negative number of its error."""
        answering = Thread(target=self.device.answer)
        answering.start()
        self.end.sendall(usb_dongle.WORDS.pack(kind, one, two))
        while True:
            order, first, second = usb_dongle.WORDS.unpack(self.end.recv(24, socket.MSG_WAITALL))
            if order == 5:
                self.end.sendall(self.memory[first : first + second])
            elif order == 6:
                self.put(first, self.end.recv(second, socket.MSG_WAITALL))
            elif order == 4:
                self.end.sendall(usb_dongle.WORDS.pack(2, *self.file))
            else:
                answering.join()
                return -second if first == 2**64 - 1 else first

    def ioctl(self, number: int, place: int = 0) -> int:
        return self.ask(1, number, place)

    def urb(self, place: int = A) -> Any:
        return Urb.from_buffer_copy(self.memory, place)

    def submit(self, kind: int, point: int, length: int) -> int:
        return self.ioctl(
            SUBMIT, self.put(A, Urb(kind=kind, point=point, buffer=B, length=length, status=7, actual=7))
        )

    def reap(self, number: int = REAP_NOW) -> int:
        """Return the place of a completed URB, or an error."""
        result = self.ioctl(number, C)
        return int.from_bytes(self.memory[C : C + 8], "little") if result == 0 else result


@pytest.fixture
def program() -> Iterator[Program]:
    program = Program()
    yield program
    program.end.close()
    program.device.close()


def test_requests_without_data_are_those_of_a_full_speed_device_without_a_driver(program: Program) -> None:
    accepted = (
        ioc(2, 4, c_uint * 2),
        *(ioc(2, number, c_uint) for number in (5, 15, 16, 21)),
        ioc(0, 20),
        ioc(2, 27, Claim),
    )
    assert [program.ioctl(number) for number in accepted] == [0] * 7
    driver = structure(("interface", c_uint), ("driver", c_char * 256))
    nested = structure(("interface", c_int), ("code", c_int), ("data", c_void_p))
    assert [program.ioctl(number) for number in (ioc(1, 8, driver), ioc(3, 18, nested))] == [
        -errno.ENODATA
    ] * 2
    assert program.ioctl(ioc(0, 31)) == 2
    program.put(A, b"\xff" * 5)
    assert program.ioctl(ioc(2, 26, c_uint), A) == 0
    assert program.memory[A : A + 5] == b"\0\0\0\0\xff"
    assert program.ioctl(ioc(2, 3, c_uint)) == -errno.ENOTTY


@pytest.mark.parametrize(
    ("file", "result"), [((18, 0), 18), ((0xFFFFFFFF, errno.EBADF), -errno.EBADF), ((0, 0), 0)]
)
def test_the_program_reads_and_writes_the_file_by_itself(
    program: Program, file: tuple[int, int], result: int
) -> None:
    program.file = file
    assert program.ask(7, A, 18) == program.ask(8, A, 18) == result


def test_control_transfers_read_descriptors_and_carry_vendor_requests(program: Program) -> None:
    whole = all_descriptors()[:18]
    for length in (8, 18, 64):
        program.put(B, bytes(64))
        place = program.put(A, Control(kind=0x80, request=6, value=0x100, length=length, data=B))
        assert program.ioctl(CONTROL, place) == min(length, 18)
        assert program.memory[B : B + 64] == whole[:length].ljust(64, b"\0")
    program.put(B, b"\xe7\xe7\xe7\xe7\x02")
    for length in (5, 0):
        place = program.put(A, Control(kind=0x40, request=2, value=0x1234, length=length, data=B))
        assert program.ioctl(CONTROL, place) == length
    assert program.dongle.controlled == [b"\x02\x34\x12\xe7\xe7\xe7\xe7\x02", b"\x02\x34\x12"]


def test_bulk_transfers_go_to_the_dongle_and_wait_for_its_answer(program: Program) -> None:
    program.put(B, b"packet")
    assert program.ioctl(BULK, program.put(A, Bulk(point=1, length=6, data=B))) == 6
    assert program.dongle.written == [b"packet"]
    program.dongle.answers = [b"\x01answer", b"\x01answer", TimeoutError(), ConnectionResetError()]
    for length, timeout_ms, result in (
        (64, 250, 7),
        (3, 0, 3),
        (64, 20, -errno.ETIMEDOUT),
        (64, 20, -errno.ENODEV),
    ):
        program.put(B, bytes(64))
        assert (
            program.ioctl(BULK, program.put(A, Bulk(point=0x81, length=length, timeout=timeout_ms, data=B)))
            == result
        )
        assert program.memory[B : B + 8] == (b"\x01answer"[:length] if result > 0 else b"").ljust(8, b"\0")
    assert program.dongle.timeouts == [0.25, 2**31 / 1000, 0.02, 0.02]


def test_a_urb_is_reaped_with_its_length_or_error_and_reads_wait_while_others_go_on(program: Program) -> None:
    program.put(B, b"packet")
    assert program.submit(URB_BULK, 0x01, 6) == 0
    assert program.reap() == A
    assert (program.urb().status, program.urb().actual, program.dongle.written) == (0, 6, [b"packet"])
    assert program.reap() == -errno.EAGAIN
    program.submit(URB_BULK, 0x81, 4)
    assert program.reap() == -errno.EAGAIN
    program.dongle.answers = [TimeoutError()]
    assert program.reap() == -errno.EAGAIN
    program.dongle.answers = [b"\x01answer"]
    assert program.reap(REAP) == A
    assert (program.urb().status, program.urb().actual, program.memory[B : B + 6]) == (
        0,
        4,
        b"\x01ans" + b"et",
    )
    program.submit(URB_BULK, 0x81, 4)
    assert program.ioctl(DISCARD, B) == -errno.EINVAL
    assert program.ioctl(DISCARD, A) == 0
    assert program.ioctl(DISCARD, A) == -errno.EINVAL
    assert program.reap() == A
    assert (program.urb().status, program.urb().actual) == (-errno.ENOENT, 0)
    assert program.submit(URB_ISO, 0x81, 4) == -errno.EINVAL
    program.submit(URB_BULK, 0x81, 4)
    program.dongle.answers = [ConnectionResetError()]
    assert program.reap() == A
    assert program.urb().status == -errno.ENODEV


def test_a_control_urb_has_its_setup_before_its_data(program: Program) -> None:
    program.put(B, bytes.fromhex("80 06 0001 0000 0800"))
    assert program.submit(URB_CONTROL, 0x80, 16) == 0
    assert program.reap() == A
    assert (program.urb().status, program.urb().actual) == (0, 8)
    assert program.memory[B + 8 : B + 17] == all_descriptors()[:8] + b"\0"
    program.put(B, bytes.fromhex("40 02 3412 0000 0200 e702"))
    program.submit(URB_CONTROL, 0, 10)
    assert program.reap() == A
    assert (program.urb().status, program.urb().actual) == (0, 2)
    assert program.dongle.controlled == [b"\x02\x34\x12\xe7\x02"]
    for too_short in (0, 7, 9):  # of a setup of 8 bytes and the 2 that it announces
        assert program.submit(URB_CONTROL, 0, too_short) == -errno.EINVAL
    assert len(program.dongle.controlled) == 1


def test_without_a_server_every_transfer_finds_no_device(program: Program) -> None:
    program.there = False
    assert program.ioctl(BULK, program.put(A, Bulk(point=1, length=1, data=B))) == -errno.ENODEV
    assert (
        program.ioctl(CONTROL, program.put(A, Control(kind=0x40, request=1, length=0, data=B)))
        == -errno.ENODEV
    )
    for kind, length in ((URB_BULK, 1), (URB_CONTROL, 8)):
        program.put(B, bytes.fromhex("40 01 5000 0000 0000"))
        program.submit(kind, 1, length)
        assert (program.reap(), program.urb().status) == (A, -errno.ENODEV)


def test_a_program_that_ends_closes_its_dongle(program: Program) -> None:
    program.ioctl(BULK, program.put(A, Bulk(point=1, length=1, data=B)))
    program.end.close()
    assert not program.device.answer()
    assert program.dongle.written[-1] == b"closed"


def test_the_bus_has_the_kernel_s_files(tmp_path: Path) -> None:
    place = usb_dongle.make_bus(tmp_path)
    device = tmp_path / "sys/bus/usb/devices/1-1"
    shown = {
        name: (device / name).read_text().strip()
        for name in ("idVendor", "idProduct", "bcdDevice", "serial", "speed")
    }
    assert shown == {
        "idVendor": "1915", "idProduct": "7777", "bcdDevice": "0504", "serial": "F10A7Y0001", "speed": "12",
    }  # fmt: skip
    assert (device / "uevent").read_text().splitlines() == [
        "MAJOR=189", "MINOR=1", "DEVNAME=bus/usb/001/002", "DEVTYPE=usb_device", "BUSNUM=001", "DEVNUM=002",
    ]  # fmt: skip
    assert [(device / name).read_text() for name in ("busnum", "devnum", "dev")] == ["1\n", "2\n", "189:1\n"]
    assert (
        (device / "descriptors").read_bytes()
        == (tmp_path / "dev/bus/usb/001/002").read_bytes()
        == all_descriptors()
    )
    assert (device / "subsystem").resolve() == tmp_path / "sys/bus/usb"
    assert os.readlink(tmp_path / "dev/.node/bus_usb_001_002") == "189:1"
    assert place == tmp_path / "ioctl/dev/bus/usb/001/002"
    assert place.parent.is_dir()


# Programs


def test_each_opened_node_is_answered_by_itself_until_its_program_ends(tmp_path: Path) -> None:
    place, ends = str(tmp_path / "ioctls"), list[socket.socket]()
    speed = usb_dongle.WORDS.pack(1, ioc(0, 31), 0)

    def steps() -> Iterator[bool]:
        """Act as programs do between two looks of the server."""
        for _ in range(2):
            ends.append(socket.socket(socket.AF_UNIX))
            ends[-1].connect(place)
        for end in (1, 0, 0):
            ends[end].sendall(speed)
            yield from [True] * 3
            assert ends[end].recv(24, socket.MSG_DONTWAIT) == usb_dongle.WORDS.pack(3, 2, 0)
            if end:
                ends[end].close()
        ends[0].close()
        yield True
        yield False

    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(place)
        listening.listen()
        usb_dongle._serve(listening, Dongle, steps().__next__)  # type: ignore[arg-type]


@pytest.fixture
def on_bus() -> Iterator[Callable[..., int]]:
    """Run a shell's command with a dongle on its bus."""
    before = signal.getsignal(signal.SIGTERM)
    yield lambda command: usb_dongle.run(("127.0.0.1", 9), ["/bin/sh", "-c", command])
    signal.signal(signal.SIGTERM, before)


def test_a_program_has_the_bus_and_its_exit_code_is_that_of_the_run(
    on_bus: Callable[..., int], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(usb_dongle, "TURN_S", 0.01)
    monkeypatch.setenv("LD_PRELOAD", "")
    sysfs = (
        'test -d "$UMOCKDEV_DIR/sys/bus/usb/devices/1-1" && test -S "$UMOCKDEV_DIR/ioctl/dev/bus/usb/001/002"'
    )
    assert on_bus(f'{sysfs} && echo "$LD_PRELOAD"; exit 7') == 7
    assert capfd.readouterr().out == f"{usb_dongle.PRELOAD}\n"
    assert on_bus("kill -9 $$") == 137
    monkeypatch.setenv("LD_PRELOAD", "libother.so")
    on_bus('echo "$LD_PRELOAD"')
    assert capfd.readouterr().out == f"{usb_dongle.PRELOAD}:libother.so\n"
    assert usb_dongle.run(("127.0.0.1", 9), ["/no/program"]) == 127
    assert capfd.readouterr().err.splitlines()[-1] == "/no/program: No such file or directory"


@pytest.mark.parametrize(("program", "runs", "code"), [("exit 3", False, 3), ("sleep 100", True, 0)])
def test_a_program_that_still_runs_is_ended_without_an_error(
    monkeypatch: pytest.MonkeyPatch, program: str, runs: bool, code: int
) -> None:
    monkeypatch.setattr(usb_dongle, "command_of", lambda port: ["/bin/sh", "-c"] if port == 7100 else [])
    client = usb_dongle.start(7100, [program])
    if not runs:
        client.wait()
    assert usb_dongle.end(client) == code
    assert client.returncode == (-signal.SIGTERM if runs else code)


def test_what_a_program_needs_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*arguments: str) -> str:
        assert usb_dongle.main(arguments) == 2
        return capsys.readouterr().err

    assert usb_dongle.command_of(7100)[1:] == ["-m", "hil.servers.usb_dongle", "127.0.0.1:7100"]
    usage = "usage: python -m hil.servers.usb_dongle HOST:PORT PROGRAM ...\n"
    assert refused("127.0.0.1:1") == refused("here", "true") == usage
    monkeypatch.setattr(usb_dongle, "PRELOAD", "libnothere.so")
    assert refused("127.0.0.1:1", "true") == f"{usb_dongle.MISSING}\n"
    for folder in ("usr/lib", "usr/lib64/x86", "usr/local/lib", "usr/lib/arm/deep"):
        root = tmp_path / folder.replace("/", "-")
        monkeypatch.setattr(usb_dongle, "Path", lambda place, root=root: root / place.removeprefix("/"))
        assert usb_dongle.why_not() == usb_dongle.MISSING
        (root / folder).mkdir(parents=True)
        (root / folder / usb_dongle.PRELOAD).touch()
        assert usb_dongle.why_not() == (usb_dongle.MISSING if folder.endswith("deep") else "")
    monkeypatch.setattr(sys, "byteorder", "big")
    assert usb_dongle.why_not() == "needs a 64-bit little-endian machine"
    monkeypatch.setattr(usb_dongle, "why_not", lambda: "")
    for address in ("127.0.0.1:1", "127.0.0.1:x"):
        assert refused(address, "true").startswith(f"{address}: no `floaty serve --radio` there (")
    ran: list[object] = []
    monkeypatch.setattr(usb_dongle, "run", lambda server, program: ran.append((server, program)) or 5)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert usb_dongle.main([f"127.0.0.1:{port}", "radio", "E7"]) == 5
    assert ran == [(("127.0.0.1", port), ["radio", "E7"])]
