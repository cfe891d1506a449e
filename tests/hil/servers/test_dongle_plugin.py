"""The program's end of the virtual Crazyradio: as pyusb sees it, and its frames to each process of a server."""

import atexit
import errno
import socket
import struct
from array import array
from collections.abc import Iterator
from threading import Thread
from types import SimpleNamespace as Made
from typing import Any

import pytest
import usb.core
import usb.util

from hil.board.clock import Paced
from hil.servers import dongle_plugin
from hil.servers.dongle_plugin import (
    CONTROL,
    PAUSES,
    PORTS,
    READ,
    VARIABLE,
    WRITE,
    Backend,
    Connection,
    SimulatedClock,
    all_descriptors,
    frame,
    install,
    standard_request,
)  # fmt: skip
from hil.servers.dongle_server import DongleServer

ACKED, LOST = b"\x01", b"\x00"


class Process:
    """A process of a server, played by the test: its frames wait in the socket until the client reads."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]

    def accept(self, greeting: bytes = b"") -> None:
        self.client, _ = self.listener.accept()
        self.client.settimeout(2.0)
        self.client.sendall(greeting)

    def frames(self, many: int) -> list[tuple[bytes, bytes]]:
        found = []
        for _ in range(many):
            kind, self.sequence, size = self.client.recv(3, socket.MSG_WAITALL)
            found.append((bytes((kind,)), self.client.recv(size, socket.MSG_WAITALL) if size else b""))
        return found

    def answer(self, data: bytes, sequence: int | None = None) -> None:
        self.client.sendall(frame(READ, self.sequence if sequence is None else sequence, data))

    def silent(self) -> bool:
        self.client.setblocking(False)
        try:
            return not self.client.recv(1)
        except BlockingIOError:
            return True
        finally:
            self.client.settimeout(2.0)

    def die(self) -> None:
        self.client.close()


@pytest.fixture
def processes() -> Iterator[tuple[Process, Process]]:
    first, second = Process(), Process()
    yield first, second
    for one in (first, second):
        one.listener.close()
        one.client.close()


@pytest.fixture
def dongle(processes: tuple[Process, Process]) -> Iterator[Connection]:
    """A dongle whose server has another process; a third one has ended."""
    first, second = processes
    gone = socket.create_server(("127.0.0.1", 0))
    ports = second.port.to_bytes(2) + gone.getsockname()[1].to_bytes(2)
    gone.close()
    greeting = Thread(target=first.accept, args=(frame(PORTS, 0, ports),))
    greeting.start()
    connection = Connection("127.0.0.1", first.port)
    greeting.join()
    second.accept()
    yield connection
    connection.close()


def test_pyusb_finds_a_crazyradio() -> None:
    """Vendor and product are Bitcraze's; USB 2.0, chapter 9.6, has the layout of the descriptors."""
    process = Process()
    device = usb.core.find(idVendor=0x1915, idProduct=0x7777, backend=Backend(f"127.0.0.1:{process.port}"))
    assert device is not None
    assert (device.bcdDevice, device.iManufacturer, device.iProduct, device.iSerialNumber) == (
        0x0504,
        1,
        2,
        3,
    )
    assert [one.bEndpointAddress for one in device[0][(0, 0)]] == [0x81, 0x01]
    process.listener.close()
    data = all_descriptors()
    interface = device[0][(0, 0)]
    for part, at, layout, names in (
        (device, 0, "<BBHBBBBHHHBBBB", "bLength bDescriptorType bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol "
         "bMaxPacketSize0 idVendor idProduct bcdDevice iManufacturer iProduct iSerialNumber bNumConfigurations"),
        (device[0], 18, "<BBHBBBBB", "bLength bDescriptorType wTotalLength bNumInterfaces bConfigurationValue "
         "iConfiguration bmAttributes bMaxPower"),
        (interface, 27, "<9B", "bLength bDescriptorType bInterfaceNumber bAlternateSetting bNumEndpoints "
         "bInterfaceClass bInterfaceSubClass bInterfaceProtocol iInterface"),
        *((interface[index], 36 + 7 * index, "<BBBBHB", "bLength bDescriptorType bEndpointAddress bmAttributes "
           "wMaxPacketSize bInterval") for index in range(2)),
    ):  # fmt: skip
        assert [getattr(part, name) for name in names.split()] == [*struct.unpack_from(layout, data, at)]
    assert (data[:2], len(data), int.from_bytes(data[20:22], "little")) == (b"\x12\x01", 18 + 32, 32)
    assert data[8:14] == bytes.fromhex("1519 7777 0405")
    assert data[27:29] == b"\x09\x04"
    assert [data[at : at + 7] for at in (36, 43)] == [bytes((7, 5, end, 2, 64, 0, 0)) for end in (0x81, 0x01)]
    assert standard_request(6, 0x0100) + standard_request(6, 0x0200) == data
    assert standard_request(6, 0x0300) == b"\x04\x03\x09\x04", "US English"
    for index, text in enumerate(("Bitcraze AB", "Crazyradio (Floaty virtual laboratory)", "F10A7Y0001"), 1):
        answer = standard_request(6, 0x0300 + index)
        assert (answer[0], answer[1], answer[2:].decode("utf-16-le")) == (len(answer), 3, text)
        buffer = array("B", bytes(255))
        size = Backend("x:1").ctrl_transfer(None, 0x80, 6, 0x0300 + index, 0, buffer, 0)  # type: ignore[arg-type]
        assert buffer[:size].tobytes() == answer
    assert [standard_request(*one) for one in ((6, 0x0304), (6, 0x0400), (5, 0x0301))] == [b"", b"", b""]


def test_a_packet_goes_to_every_process_until_a_board_has_answered_with_these_settings(
    dongle: Connection, processes: tuple[Process, Process]
) -> None:
    first, second = processes
    dongle.control(b"\x01\x50\x00")
    dongle.write(b"a")
    for one, answer in ((first, LOST), (second, ACKED + b"up")):
        assert one.frames(2) == [(CONTROL, b"\x01\x50\x00"), (WRITE, b"a")]
        for number in (
            one.sequence - 1,
            255,
        ):  # of transfers that were given up, one before the numbers began again
            one.answer(b"old", number)
        one.answer(answer)
    assert dongle.awaits_answer
    assert dongle.read(1.0) == ACKED + b"up"
    assert not dongle.awaits_answer
    dongle.write(b"b")
    assert second.frames(1) == [(WRITE, b"b")]
    assert first.silent()
    second.answer(LOST)
    assert dongle.read(1.0) == LOST
    dongle.write(b"c")  # the board may have another process now
    assert [one.frames(1) for one in (first, second)] == 2 * [[(WRITE, b"c")]]
    first.answer(ACKED)
    assert dongle.read(1.0) == ACKED
    dongle.control(b"\x01\x51\x00")
    dongle.write(b"d")
    assert [one.frames(2)[1] for one in (first, second)] == 2 * [(WRITE, b"d")]


def test_a_client_is_told_the_ports_of_the_other_processes() -> None:
    clock = Paced()
    server = DongleServer(0, clock.readers, Made, lambda text: None, (0x1234, 9))  # type: ignore[arg-type]
    with socket.create_connection(("127.0.0.1", server.port), 20.0) as client:
        clock.wait_until(clock.now_us() + 20_000_000)
        clock.serve(0)
        assert client.recv(64) == frame(PORTS, 0, bytes.fromhex("1234 0009"))
    server.close()


def test_without_acknowledgements_none_is_awaited(
    dongle: Connection, processes: tuple[Process, Process]
) -> None:
    dongle.control(b"\x10\x00\x00")
    dongle.write(b"a")
    assert not dongle.awaits_answer
    assert dongle.read(1.0) == LOST
    dongle.control(b"\x10\x01\x00")
    dongle.write(b"b")
    assert dongle.awaits_answer


@pytest.mark.parametrize(("mode", "head"), [(1, b""), (2, b"\x28")])
def test_in_an_inline_mode_the_settings_are_in_each_packet(
    dongle: Connection, processes: tuple[Process, Process], mode: int, head: bytes
) -> None:
    """Length, flags with rate and acknowledgement, channel, address; the answer begins with its length."""
    dongle.control(bytes((0x23, mode, 0)))
    dongle.write(bytes((9, 0x12, 80)) + b"\xe7\xe7\xe7\xe7\x02" + b"x")
    settings = [b"\x01\x50\x00", b"\x02\x00\x00\xe7\xe7\xe7\xe7\x02", b"\x03\x02\x00", b"\x10\x01\x00"]
    for one in processes:
        assert one.frames(5) == [*((CONTROL, data) for data in settings), (WRITE, b"x")]
        one.answer(ACKED + b"up")
    assert dongle.read(1.0) == bytes((4 + len(head),)) + ACKED + head + b"up"
    dongle.write(bytes((9, 0x01, 80)) + b"\xe7\xe7\xe7\xe7\x02" + b"y")
    assert [data for _, data in processes[1].frames(3)] == [b"\x03\x01\x00", b"\x10\x00\x00", b"y"]
    assert dongle.awaits_answer, "also without an acknowledgement"
    assert dongle.read(1.0) == bytes((2 + len(head),)) + LOST + head


def test_a_process_that_ends_is_left_out_and_without_the_first_one_the_dongle_is_unplugged(
    dongle: Connection, processes: tuple[Process, Process]
) -> None:
    first, second = processes
    backend, buffer = Backend("127.0.0.1:1"), array("B", bytes(64))
    assert backend.bulk_write(dongle, 1, 0, array("B", b"abc"), 0) == 3
    with pytest.raises(usb.core.USBTimeoutError) as late:
        backend.bulk_read(dongle, 0x81, 0, buffer, 20)
    assert late.value.errno == errno.ETIMEDOUT
    assert dongle._lines[0]._socket.gettimeout() == 0.02
    second.die()
    first.frames(1)
    first.answer(LOST)
    assert backend.bulk_read(dongle, 0x81, 0, buffer, 1000) == 1
    dongle.write(b"b")
    first.frames(1)
    first.answer(ACKED)
    assert dongle.read(1.0) == ACKED
    first.die()
    dongle.write(b"c")
    with pytest.raises(usb.core.USBError) as gone:
        backend.bulk_read(dongle, 0x81, 0, buffer, 1000)
    assert gone.value.errno == errno.ENODEV


def test_a_sleep_lasts_longer_by_what_simulated_time_stood_still() -> None:
    process, slept = Process(), list[float]()

    def sleep(duration_s: float) -> None:
        slept.append(round(duration_s, 6))

    def serve() -> None:
        process.accept(frame(PORTS, 0, b""))
        for stood_us in (1_000, 61_000, 71_000, 71_000):
            assert process.frames(1) == [(PAUSES, b"")]
            process.answer(stood_us.to_bytes(8))

    server = Thread(target=serve)
    server.start()
    clock = SimulatedClock(("127.0.0.1", process.port), sleep)
    clock.sleep(0.049)
    assert slept == [0.049]
    clock.sleep(0.05)
    assert slept == [0.049, 0.05, 0.06, 0.01]
    server.join()
    clock.close()
    process.client.close()
    process.listener.close()
    plain = SimulatedClock(("127.0.0.1", process.port), sleep)
    plain.sleep(1.0)
    assert slept[4:] == [1.0], "without a server"


def test_a_dongle_whose_server_leaves_while_it_connects_keeps_no_line() -> None:
    first, second = Process(), Process()

    def leave() -> None:
        first.accept(frame(PORTS, 0, second.port.to_bytes(2))[:3])
        first.die()

    leaving = Thread(target=leave)
    leaving.start()
    with pytest.raises(usb.core.USBError) as gone:
        Backend(f"127.0.0.1:{first.port}").open_device(None)
    assert gone.value.errno == errno.ENODEV
    leaving.join()
    first.listener.close()
    with pytest.raises(usb.core.USBError):
        Backend(f"127.0.0.1:{first.port}").open_device(None)
    second.listener.close()


def test_pyusb_s_requests_reach_the_dongle_and_there_is_one_of_everything(
    dongle: Connection, processes: tuple[Process, Process]
) -> None:
    backend: Any = Backend("127.0.0.1:1")
    assert list(backend.enumerate_devices()) == []
    assert (backend.get_configuration(dongle), backend.is_kernel_driver_active(dongle, 0)) == (1, False)
    for asked in (
        lambda: backend.get_configuration_descriptor(None, 1),
        lambda: backend.get_interface_descriptor(None, 1, 0, 0),
        lambda: backend.get_interface_descriptor(None, 0, 1, 0),
    ):
        with pytest.raises(IndexError):
            asked()
    assert backend.ctrl_transfer(dongle, 0x40, 2, 0x1234, 0, array("B", b"\xe7\xe7"), 0) == 2
    assert backend.ctrl_transfer(dongle, 0x40, 6, 0x0100, 0, b"", 0) == 0
    backend.bulk_write(dongle, 1, 0, b"x", 0)
    requests = [(CONTROL, b"\x02\x34\x12\xe7\xe7"), (CONTROL, b"\x06\x00\x01"), (WRITE, b"x")]
    for process in processes:
        assert process.frames(3) == requests
    backend.close_device(dongle)
    with pytest.raises(usb.core.USBError) as gone:
        backend.bulk_write(dongle, 1, 0, b"y", 0)
    assert gone.value.errno == errno.ENODEV


@pytest.mark.parametrize(("named", "server"), [("10.0.0.1:7", ("10.0.0.1", 7)), ("", ("127.0.0.1", 19840))])
def test_installed_it_is_the_only_bus_and_the_clock_of_sleeps(
    monkeypatch: pytest.MonkeyPatch, named: str, server: tuple[str, int]
) -> None:
    libusb_package: Any = pytest.importorskip("libusb_package")
    at_end: list[Any] = []
    system: Any = Made(sleep=print)
    monkeypatch.setattr(dongle_plugin, "time", system)
    monkeypatch.setattr(libusb_package, "get_libusb1_backend", None)
    monkeypatch.setattr(atexit, "register", at_end.append)
    monkeypatch.setenv(VARIABLE, named)
    install()
    assert libusb_package.get_libusb1_backend()._server == server
    clock = system.sleep.__self__
    assert isinstance(clock, SimulatedClock)
    assert (clock._server, clock._sleep, at_end) == (server, print, [clock.close])
