"""The back end for a board on a serial line: MAVLink over `mavlink:DEVICE[,BAUD]`, any device that pyserial can open.

A thread reads and notes the time; the caller of `receive` decodes. The only file that uses pyserial.
"""

import os
import queue
import re
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import serial

from firmware_py.wire.telemetry import Sample
from ground_station.clock import clock_us, readable, signing_start
from ground_station.config import LinkSettings
from ground_station.controls import Answer, ControlRequest
from ground_station.errors import LinkError
from ground_station.links.live_link import CLOSE_TIMEOUT_S, POLL_S, LiveLink
from ground_station.links.mavlink import MavlinkLink
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal

PREFIX = "mavlink:"
BAUD_MIN, BAUD_MAX = 9600, 3_000_000
READ_SIZE = 4096
GATHER_S = 0.005  # how long bytes are collected where a port cannot be polled
WRITE_TIMEOUT_S = 1.0
SENDERS = 3  # named where no autopilot is heard
_DEVICE = re.compile(r"(?:socket|rfc2217)://[^,]+:(\d{1,5})(?:[/?][^,]*)?|(?!.*://)[^,]+")


def parse_uri(uri: str, default_baud: int) -> tuple[str, int]:
    """Return `(device, baud)` of `mavlink:DEVICE[,BAUD]`; `LinkError` for a malformed one."""
    device, comma, digits = uri.removeprefix(PREFIX).partition(",")
    match = _DEVICE.fullmatch(device) if uri.startswith(PREFIX) else None
    if match is None or int(match[1] or 1) not in range(1, 65536):
        raise LinkError(
            f"{uri}: expected mavlink:DEVICE[,BAUD] with a DEVICE like /dev/ttyUSB0, COM3, socket://HOST:PORT "
            "or rfc2217://HOST:PORT"
        )
    if comma and not (re.fullmatch(r"[0-9]{1,7}", digits) and BAUD_MIN <= int(digits) <= BAUD_MAX):
        raise LinkError(f"{uri}: baud rate {digits!r}: expected {BAUD_MIN}..{BAUD_MAX}")
    return device, int(digits) if comma else default_baud


class _Port:
    """An open port, until reading or writing fails or it is closed; the reader's thread calls `receive` with
    the bytes read.

    Raises `OSError` or `ValueError` like pyserial.
    """

    def __init__(self, device: str, baud: int, receive: Callable[[bytes], None]) -> None:
        self.failure = ""  # why it has failed
        self.bytes = 0  # received
        self._receive = receive
        self._closing = False
        remote = device.startswith("rfc2217:")  # cannot be polled, and has a fixed write timeout of 5 s
        self._polled = os.name == "posix" and not remote
        self._serial = serial.serial_for_url(
            device,
            baud,
            timeout=0 if self._polled else GATHER_S,
            write_timeout=None if remote else WRITE_TIMEOUT_S,
            exclusive=True,
        )
        self._reader = threading.Thread(target=self._read, name="serial reader", daemon=True)
        self._reader.start()

    def write(self, data: bytes) -> None:
        """Write, or note why that failed."""
        if not self.failure:
            self._guard(partial(self._serial.write, data))

    def close(self) -> None:
        """End the reader and close the port, within some seconds."""
        self._closing = True
        self._reader.join(CLOSE_TIMEOUT_S)
        with suppress(OSError):
            self._serial.close()

    def _read(self) -> None:
        while not (self._closing or self.failure):
            self._guard(self._read_once)

    def _read_once(self) -> None:
        if self._polled:
            readable((self._serial.fileno(),), POLL_S)
        data = self._serial.read(READ_SIZE)
        if data:
            self.bytes += len(data)
            self._receive(data)

    def _guard(self, work: Callable[[], object]) -> None:
        try:
            work()
        except OSError as error:
            self.failure = self.failure or reason(error)


class MavlinkSerialLink(LiveLink):
    """One board."""

    def __init__(self, uri: str, settings: LinkSettings) -> None:
        self._device, baud = parse_uri(uri, settings.baud)
        self._settings = replace(settings, baud=baud, signing_start=signing_start())
        self._port: _Port | None = None
        self._link_lock = threading.Lock()  # the sender's thread uses the link, too
        self._link = MavlinkLink(self._carry, self._settings)
        self._asked = False  # for telemetry
        super().__init__(uri, self._link.latency)

    def _open(self) -> None:
        try:
            self._port = _Port(self._device, self._settings.baud, self._on_bytes)
        except (OSError, ValueError) as error:
            raise LinkError(f"{self.uri}: {reason(error)}") from None
        with self._link_lock:
            self._link = MavlinkLink(self._carry, self._settings)
        self._asked = False

    def _connect(self) -> bool:
        """Wait for a heartbeat, request telemetry, wait until the board has acknowledged that."""
        with suppress(queue.Empty):
            self.receive(*self._received.get(timeout=POLL_S))
        self.receive(clock_us(), b"")
        if self._link.board is not None and not self._asked:
            self._asked = True
            self.start_telemetry(clock_us())
        if self._link.answered:
            self._notices.append(self._link.budget.text)
        return self._link.answered

    def _why_no_connection(self, now_us: int, within: str) -> str:
        seen, count = self._link.counters, self._port.bytes if self._port is not None else 0
        if self._link.board is not None:
            hint = "" if self._settings.signing_key else ": does it want signed frames (mavlink.signing_key)?"
            return f"system {self._link.board} answers no command {within}{hint}"
        if not count:
            return f"no heartbeat {within}: no bytes arrive"
        if refused := seen.bad - seen.bad_crc:
            return f"no heartbeat {within}: {refused} frames not signed with mavlink.signing_key"
        if not seen.frames:
            return f"no heartbeat {within}: {count} bytes, not one frame: wrong baud rate?"
        return f"no heartbeat of an autopilot {within}: {named(self._link.senders)}"

    def _failure(self) -> str:
        return self._port.failure if self._port is not None else "closed"

    def check(self) -> None:
        self.receive(clock_us(), b"")
        super().check()

    def mute(self) -> None:
        with self._link_lock:
            self._link.forget()
        super().mute()

    def _close(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def start_telemetry(self, now_us: int) -> None:
        with self._link_lock:
            self._link.start_telemetry(now_us)

    def _send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        with self._link_lock:
            self._link.send(now_us, frame, goal)

    def ask(self, now_us: int, request: ControlRequest) -> None:
        with self._link_lock:
            self._link.controls.ask(now_us, request)

    def answer(self, now_us: int) -> Answer | None:
        with self._link_lock:
            return self._link.controls.answer(now_us)

    def _carry(self, now_us: int, data: bytes) -> None:
        if (port := self._port) is not None:
            self._do(partial(port.write, data))

    def receive(self, now_us: int, data: bytes) -> Sequence[Sample]:
        link = self._link
        with self._link_lock:
            samples = link.receive(now_us, data, clock_us())
            self._notices += link.texts
            link.texts.clear()
        self.received_us, self.latency = link.received_us, link.latency
        self.supervisor_state = link.supervisor_state
        return samples

    def summary(self) -> str:
        frames, round_trip_us = self._link.counters, self._link.round_trip_us
        round_trip = "?" if round_trip_us is None else f"{round_trip_us / 1000:.1f}"
        return (
            f"{self.sent} sent, {self.late} late  frames {frames.frames}, {frames.lost} lost, {frames.bad} bad  "
            f"round trip {round_trip} ms"
        )


def named(senders: Counter[tuple[int, int]]) -> str:
    """Return how many frames came from whom, those that sent most first."""
    most = senders.most_common(SENDERS)
    texts = [f"{count} frames of system {one[0]} component {one[1]}" for one, count in most]
    others = senders.total() - sum(count for _, count in most)
    return ", ".join(texts) + (f", {others} of {len(senders) - SENDERS} others" if others else "")


def reason(error: Exception) -> str:
    """Return the reason in one of pyserial's messages."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)
    text = str(error).splitlines()[0] if str(error) else type(error).__name__
    if "Inappropriate ioctl" in text:
        return "not a serial port"
    match = re.search(r"\[Errno -?\d+\] ([^:]+)|\(-?\d+, '([^']+)'\)", text)
    return (match[1] or match[2]) if match else text
