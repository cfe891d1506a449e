"""Gives unmodified cflib programs a Crazyradio that is really a running `floaty serve --radio`.

This file needs only the standard library: it is a pytest plugin (`pytest -p hil.servers.dongle_plugin`), and the folder
`dongle_site` beside it loads it into any Python program by PYTHONPATH, even without this package installed. The
environment variable FLOATY_DONGLE=127.0.0.1:PORT is the server's address. It replaces
`libusb_package.get_libusb1_backend` by a back end for pyusb that sends each USB transfer over a socket.

A frame on the socket: kind (1 byte), sequence number (1), length (1), data. The server first sends `P` with the ports of
the robots that other processes serve (2 bytes each); the client connects to these, too. It sends `C` (vendor request:
request, value low and high, then its data) and `W` (packet for the air); the server answers `W` with `R`. It answers
`T`, too: with how long simulated time stood still so far, because its machine was too slow [us, 8 bytes].

A program's `time.sleep` of `FOLLOWED_S` or more lasts as much longer as simulated time stands still meanwhile: a program
that sleeps until the robot has landed, and then stops its motors, would otherwise stop them in the air.
"""

import array
import atexit
import errno
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import SimpleNamespace
from typing import Any

VARIABLE = "FLOATY_DONGLE"
DEFAULT_SERVER = "127.0.0.1:19840"
SERIAL = "F10A7Y0001"
CONNECT_TIMEOUT_S = 2.0
FOLLOWED_S = 0.05
PAUSES_TIMEOUT_S = 10.0  # a server that does not answer at all
READY_TIMEOUT_S = 60.0  # a server may compile first

CONTROL, WRITE, READ, PORTS, PAUSES = b"C", b"W", b"R", b"P", b"T"
HEAD_SIZE = 3
ACKNOWLEDGED = 0x01  # bit of an answer's first byte
NOT_ACKNOWLEDGED = b"\x00"
SET_CHANNEL, SET_ADDRESS, SET_RATE, SET_ACKS, SET_INLINE = 0x01, 0x02, 0x03, 0x10, 0x23  # vendor requests
# Modes of a Crazyradio 2.0, in which the settings are a header of each packet; the second adds the signal strength.
INLINE, INLINE_STRENGTH = 1, 2
INLINE_SIZE, INLINE_ACKS = 8, 0x10  # of that header, and a bit of its second byte
STRENGTH_DBM = 40  # below 0 dBm: a board in the same room

_DEVICE = SimpleNamespace(
    bLength=18, bDescriptorType=1, bcdUSB=0x0200, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
    bMaxPacketSize0=64, idVendor=0x1915, idProduct=0x7777, bcdDevice=0x0504, iManufacturer=1, iProduct=2,
    iSerialNumber=3, bNumConfigurations=1, address=1, bus=1, port_number=1, port_numbers=(1,), speed=2,
)  # fmt: skip
_CONFIGURATION = SimpleNamespace(
    bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1, bConfigurationValue=1, iConfiguration=0,
    bmAttributes=0x80, bMaxPower=50, extra_descriptors=[],
)  # fmt: skip
_INTERFACE = SimpleNamespace(
    bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=2, bInterfaceClass=0xFF,
    bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0, extra_descriptors=[],
)  # fmt: skip
_ENDPOINTS = tuple(
    SimpleNamespace(
        bLength=7, bDescriptorType=5, bEndpointAddress=address, bmAttributes=2, wMaxPacketSize=64, bInterval=0,
        bRefresh=0, bSynchAddress=0, extra_descriptors=[],
    )
    for address in (0x81, 0x01)
)  # fmt: skip
_STRINGS = ("", "Bitcraze AB", "Crazyradio (Floaty virtual laboratory)", SERIAL)
# What the kernel shows of the device.
ATTRIBUTES = {
    "idVendor": f"{_DEVICE.idVendor:04x}", "idProduct": f"{_DEVICE.idProduct:04x}", "bcdDevice": f"{_DEVICE.bcdDevice:04x}",
    "manufacturer": _STRINGS[1], "product": _STRINGS[2], "serial": SERIAL,
}  # fmt: skip
GET_DESCRIPTOR, DEVICE, CONFIGURATION, STRING = 6, 1, 2, 3


def all_descriptors() -> bytes:
    """Return the descriptors of device and configuration, one after the other, as on the wire."""
    return _device_descriptor() + _configuration_descriptor()


def _device_descriptor() -> bytes:
    d = _DEVICE
    return struct.pack(
        "<BBHBBBBHHHBBBB", d.bLength, d.bDescriptorType, d.bcdUSB, d.bDeviceClass, d.bDeviceSubClass, d.bDeviceProtocol,
        d.bMaxPacketSize0, d.idVendor, d.idProduct, d.bcdDevice, d.iManufacturer, d.iProduct, d.iSerialNumber,
        d.bNumConfigurations,
    )  # fmt: skip


def _configuration_descriptor() -> bytes:
    c, i = _CONFIGURATION, _INTERFACE
    found = struct.pack(
        "<BBHBBBBB", c.bLength, c.bDescriptorType, c.wTotalLength, c.bNumInterfaces, c.bConfigurationValue,
        c.iConfiguration, c.bmAttributes, c.bMaxPower,
    )  # fmt: skip
    found += bytes((
        i.bLength, i.bDescriptorType, i.bInterfaceNumber, i.bAlternateSetting, i.bNumEndpoints, i.bInterfaceClass,
        i.bInterfaceSubClass, i.bInterfaceProtocol, i.iInterface,
    ))  # fmt: skip
    for e in _ENDPOINTS:
        found += struct.pack(
            "<BBBBHB",
            e.bLength,
            e.bDescriptorType,
            e.bEndpointAddress,
            e.bmAttributes,
            e.wMaxPacketSize,
            e.bInterval,
        )
    return found


def standard_request(request: int, value: int) -> bytes:
    """Return what the dongle answers to a request of the USB standard: its descriptors and strings."""
    kind, index = value >> 8, value & 0xFF
    if request != GET_DESCRIPTOR or (kind == STRING and index >= len(_STRINGS)):
        return b""
    if kind == STRING:
        text = _STRINGS[index].encode("utf-16-le") if index else b"\x09\x04"
        return bytes((2 + len(text), STRING)) + text
    return {DEVICE: _device_descriptor, CONFIGURATION: _configuration_descriptor}.get(kind, bytes)()


def frame(kind: bytes, sequence: int, data: bytes) -> bytes:
    """Return one frame of the socket."""
    return kind + bytes((sequence, len(data))) + data


class Line:
    """A socket to one process of the server."""

    def __init__(self, server: tuple[str, int]) -> None:
        self._socket = socket.create_connection(server, CONNECT_TIMEOUT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sequence = 0
        self._received = b""
        self._requests: dict[int, bytes] = {}  # vendor requests that it has got

    def write(self, requests: dict[int, bytes], packet: bytes) -> None:
        """Send a packet, and before it the vendor requests that are new to this process."""
        for number, data in requests.items():
            if self._requests.get(number) != data:
                self._send(CONTROL, data)
        self._requests = dict(requests)
        self._send(WRITE, packet)

    def ask(self, kind: bytes, timeout_s: float) -> bytes:
        """Return the answer to an empty frame. Raises `TimeoutError` without one."""
        self._send(kind, b"")
        return self.read(timeout_s)

    def _send(self, kind: bytes, data: bytes) -> None:
        self._sequence = (self._sequence + 1) & 0xFF
        self._socket.sendall(frame(kind, self._sequence, data))

    def read(self, timeout_s: float) -> bytes:
        """Return the answer to the last frame, or the ports. Raises `TimeoutError` without one."""
        self._socket.settimeout(timeout_s)
        while True:
            size = HEAD_SIZE + self._received[2] if len(self._received) >= HEAD_SIZE else HEAD_SIZE
            if len(self._received) >= HEAD_SIZE and len(self._received) >= size:
                answer, self._received = self._received[:size], self._received[size:]
                if answer[1] == self._sequence:  # an older one answers an abandoned transfer
                    return answer[HEAD_SIZE:]
                continue
            data = self._socket.recv(4096)
            if not data:
                raise ConnectionResetError("the server is gone")
            self._received += data

    def close(self) -> None:
        self._socket.close()


class SimulatedClock:
    """Sleeps in the server's simulated time, by the wall clock where no server answers."""

    def __init__(self, server: tuple[str, int], sleep: Callable[[float], None]) -> None:
        self._server, self._sleep = server, sleep
        self._line: Line | None = None
        self._lock = threading.Lock()

    def sleep(self, duration_s: float) -> None:
        """Sleep as `time.sleep` does, longer by what simulated time stood still."""
        before_us = self._stood_still_us() if duration_s >= FOLLOWED_S else None
        self._sleep(duration_s)
        while before_us is not None:
            now_us = self._stood_still_us()
            if now_us is None or now_us <= before_us:
                return
            self._sleep((now_us - before_us) * 1e-6)
            before_us = now_us

    def _stood_still_us(self) -> int | None:
        with self._lock:
            try:
                if self._line is None:
                    self._line = Line(self._server)
                    self._line.read(PAUSES_TIMEOUT_S)
                return int.from_bytes(self._line.ask(PAUSES, PAUSES_TIMEOUT_S))
            except OSError:
                self.close()
                return None

    def close(self) -> None:
        """Forget the server until the next sleep."""
        if self._line is not None:
            self._line.close()
        self._line = None


class Connection:
    """An opened dongle: a line to each process of the server, one transfer at a time.

    A packet goes to all of them until a board has acknowledged one with these settings; then to its process alone. A
    process that has ended is left out; without the first one the dongle is gone.
    """

    def __init__(self, host: str, port: int) -> None:
        self._lines = [Line((host, port))]
        self._requests: dict[int, bytes] = {}
        self._found: dict[tuple[bytes, ...], Line] = {}  # by the settings of the dongle
        self._asked: list[Line] = []  # those that got the last packet
        self._inline = 0
        self.awaits_answer = False  # a packet was sent whose answer was not read
        try:
            ports = self._lines[0].read(READY_TIMEOUT_S)
            for other in range(0, len(ports), 2):
                with suppress(ConnectionRefusedError):
                    self._lines.append(Line((host, int.from_bytes(ports[other : other + 2]))))
        except OSError:
            self.close()
            raise

    def control(self, data: bytes) -> None:
        """Take a vendor request, which acts from the next packet on."""
        if data[0] == SET_INLINE:
            self._inline = data[1]
        else:
            self._requests[data[0]] = data

    def write(self, packet: bytes) -> None:
        """Send a packet; in an inline mode its header has the settings."""
        if self._inline:
            flags, channel = packet[1:3]
            for request, value, data in (
                (SET_CHANNEL, channel, b""),
                (SET_ADDRESS, 0, packet[3:INLINE_SIZE]),
                (SET_RATE, flags & 0x03, b""),
                (SET_ACKS, int(flags & INLINE_ACKS != 0), b""),
            ):
                self.control(bytes((request, value, 0)) + data)
            packet = packet[INLINE_SIZE:]
        acks = self._requests.get(SET_ACKS, b"\0\1")[1] != 0
        self.awaits_answer = acks or self._inline != 0
        found = self._found.get(tuple(self._requests.values()))
        self._asked = []
        for line in self._lines.copy() if found is None else [found]:
            with self._dropping(line):
                line.write(self._requests, packet)
                if acks:
                    self._asked.append(line)

    def read(self, timeout_s: float) -> bytes:
        """Return the acknowledgement of the last packet, else that there is none.

        Raises `TimeoutError`; the next call goes on waiting.
        """
        answer = self._acknowledgement(timeout_s)
        self.awaits_answer = False
        if self._inline:
            head = answer[:1] + (bytes((STRENGTH_DBM,)) if self._inline == INLINE_STRENGTH else b"")
            answer = bytes((1 + len(head) + len(answer[1:]),)) + head + answer[1:]
        return answer

    def _acknowledgement(self, timeout_s: float) -> bytes:
        while self._asked:
            line = self._asked[0]
            with self._dropping(line):
                answer = line.read(timeout_s)
                if answer[0] & ACKNOWLEDGED:
                    self._asked = []
                    self._found[tuple(self._requests.values())] = line
                    return answer
            self._asked.remove(line)
        self._found.pop(tuple(self._requests.values()), None)
        return NOT_ACKNOWLEDGED

    @contextmanager
    def _dropping(self, line: Line) -> Iterator[None]:
        """Leave a process out that has ended."""
        try:
            yield
        except ConnectionError:
            if line is self._lines[0]:
                raise
            self._lines.remove(line)
            self._found = {settings: found for settings, found in self._found.items() if found is not line}
            line.close()

    def close(self) -> None:
        for line in self._lines:
            line.close()


class Backend:
    """Implements pyusb's back end (`usb.backend.IBackend`) for one Crazyradio, present while a server runs."""

    def __init__(self, server: str) -> None:
        host, _, port = server.rpartition(":")
        self._server = (host, int(port))

    def enumerate_devices(self) -> Iterator[object]:
        """Yield the dongle if the server answers."""
        try:
            socket.create_connection(self._server, CONNECT_TIMEOUT_S).close()
        except OSError:
            return
        yield self

    def get_parent(self, device: object) -> None:
        """Return None: a dongle has no hub."""

    def get_device_descriptor(self, device: object) -> object:
        """Return the descriptor of a Crazyradio 2 with firmware 5.4."""
        return _DEVICE

    def get_configuration_descriptor(self, device: object, configuration: int) -> object:
        """Return the only configuration."""
        if configuration:
            raise IndexError(configuration)
        return _CONFIGURATION

    def get_interface_descriptor(
        self, device: object, interface: int, setting: int, configuration: int
    ) -> object:
        """Return the only interface."""
        if interface or setting:
            raise IndexError(interface)
        return _INTERFACE

    def get_endpoint_descriptor(
        self, device: object, endpoint: int, interface: int, setting: int, configuration: int
    ) -> object:
        """Return bulk in or bulk out."""
        return _ENDPOINTS[endpoint]

    def open_device(self, device: object) -> Connection:
        """Connect to the server."""
        try:
            return Connection(*self._server)
        except OSError as error:
            raise _usb_error(error) from None

    def close_device(self, handle: Connection) -> None:
        """Disconnect."""
        handle.close()

    def set_configuration(self, handle: Connection, value: int) -> None:
        """Do nothing: there is only one."""

    def get_configuration(self, handle: Connection) -> int:
        """Return its number."""
        return 1

    def set_interface_altsetting(self, handle: Connection, interface: int, setting: int) -> None:
        """Do nothing: there is only one."""

    def claim_interface(self, handle: Connection, interface: int) -> None:
        """Do nothing: the connection is the claim."""

    def release_interface(self, handle: Connection, interface: int) -> None:
        """Do nothing: the connection is the claim."""

    def reset_device(self, handle: Connection) -> None:
        """Do nothing: the host sets everything afterwards."""

    def is_kernel_driver_active(self, handle: Connection, interface: int) -> bool:
        """Return False: no kernel driver uses it."""
        return False

    def bulk_write(self, handle: Connection, endpoint: int, interface: int, data: Any, timeout: int) -> int:
        """Hand a packet to the dongle."""
        try:
            handle.write(bytes(data))
        except OSError as error:
            raise _usb_error(error) from None
        return len(data)

    def bulk_read(self, handle: Connection, endpoint: int, interface: int, buffer: Any, timeout: int) -> int:
        """Wait for the acknowledgement."""
        try:
            answer = handle.read(timeout / 1000.0)
        except OSError as error:
            raise _usb_error(error) from None
        buffer[: len(answer)] = array.array("B", answer)
        return len(answer)

    intr_write = iso_write = (
        bulk_write  # looked up by pyusb, never called: the dongle has bulk endpoints only
    )
    intr_read = iso_read = bulk_read

    def ctrl_transfer(
        self, handle: Connection, kind: int, request: int, value: int, index: int, data: Any, timeout: int
    ) -> int:
        """Execute a vendor request, or read a string descriptor."""
        if kind == 0x80 and request == 6:
            descriptor = standard_request(request, value)
            data[: len(descriptor)] = array.array("B", descriptor)
            return len(descriptor)
        handle.control(bytes((request, value & 0xFF, value >> 8 & 0xFF)) + bytes(data))
        return len(data)


def _usb_error(error: OSError) -> Any:
    """Return pyusb's error: a time-out or an unplugged device."""
    import usb.core

    if isinstance(error, TimeoutError):
        return usb.core.USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)
    return usb.core.USBError("No such device (it may have been disconnected)", errno=errno.ENODEV)


def install() -> None:
    """Replace this process's USB bus with the virtual dongle."""
    try:
        import libusb_package
    except ImportError:  # this program uses no Crazyradio
        return
    server = os.environ.get(VARIABLE) or DEFAULT_SERVER
    backend = Backend(server)
    host, _, port = server.rpartition(":")
    clock = SimulatedClock((host, int(port)), time.sleep)
    atexit.register(clock.close)
    setattr(time, "sleep", clock.sleep)  # noqa: B010
    setattr(libusb_package, "get_libusb1_backend", lambda: backend)  # noqa: B010


def pytest_configure() -> None:
    """Entry point for `pytest -p hil.servers.dongle_plugin`."""
    install()
