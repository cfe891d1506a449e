"""The link to a board on a serial line: `mavlink:DEVICE[,BAUD]` with whatever pyserial can open, MAVLink on it.

Poses wait in a place for one, the newest; a thread writes, so that nobody else waits for the line, and another one reads
and notes when. What was read is understood by who calls `receive`. Every wait here has a limit, and everything that goes
wrong is a `LinkError` of one line. The only file that knows pyserial.
"""

import os
import queue
import re
import select
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import serial

from firmware_py.wire.crtp import check_pose
from firmware_py.wire.telemetry import Sample
from ground_station.clock import clock_us, signing_start
from ground_station.errors import LinkError
from ground_station.latency import LinkLatency
from ground_station.links.mavlink import MavlinkLink, MavlinkLinkConfig
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal

PREFIX = "mavlink:"
BAUD_MIN, BAUD_MAX = 9600, 3_000_000
ANSWER_TIMEOUT_US = 4_000_000  # for heartbeat and acknowledgement of a board while connecting
SILENCE_TIMEOUT_US = 2_000_000  # connected: a heartbeat comes every second, telemetry oftener
POLL_S = 0.05
READ_SIZE = 4096
GATHER_S = 0.005  # how long bytes are gathered where a port cannot be polled
MAX_AGE_US = 120_000  # older poses are not sent: the board could not use them
WRITE_TIMEOUT_S = 1.0
CLOSE_TIMEOUT_S = 1.5
PIECES = 2000  # of received bytes that wait
POSE_IS_DUE = b""  # among what waits to be written
_DEVICE = re.compile(r"(?:socket|rfc2217)://[^,]+:(\d{1,5})(?:[/?][^,]*)?|(?!.*://)[^,]+")


def parse_uri(uri: str, default_baud: int) -> tuple[str, int]:
    """`(device, baud)` of `mavlink:DEVICE[,BAUD]`; `LinkError` for what cannot be one."""
    device, comma, digits = uri.removeprefix(PREFIX).partition(",")
    match = _DEVICE.fullmatch(device) if uri.startswith(PREFIX) else None
    if match is None or int(match[1] or 1) not in range(1, 65536):
        raise LinkError(
            f"{uri}: expected mavlink:DEVICE[,BAUD] with a DEVICE like /dev/ttyUSB0, COM3, socket://HOST:PORT "
            "or rfc2217://HOST:PORT"
        )
    if comma and not (digits.isdecimal() and BAUD_MIN <= int(digits) <= BAUD_MAX):
        raise LinkError(f"{uri}: baud rate {digits!r}: expected {BAUD_MIN}..{BAUD_MAX}")
    return device, int(digits) if comma else default_baud


class _Port:
    """An open port with its reader and its writer, until one of them fails or it is closed.

    The writer calls `take_pose` when it is the turn of the pose. Raises `OSError` or `ValueError` like pyserial.
    """

    def __init__(self, device: str, baud: int, take_pose: Callable[[], None]) -> None:
        self.failure = ""  # why it does not work any more
        self.bytes = 0  # received
        self.received: queue.Queue[tuple[int, bytes]] = queue.Queue(PIECES)
        self._outgoing: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._take_pose = take_pose
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
        self._threads = [
            threading.Thread(target=self._guard, args=(loop,), name=f"serial {name}", daemon=True)
            for name, loop in (("reader", self._read), ("writer", self._write))
        ]
        for thread in self._threads:
            thread.start()

    def write(self, data: bytes) -> None:
        """Queue a frame or `POSE_IS_DUE`; there are few frames per second beside the poses."""
        self._outgoing.put(data)

    def close(self) -> None:
        """Let reader and writer end, and close, all within some seconds."""
        self._closing = True
        self._outgoing.put(None)
        for thread in self._threads:
            thread.join(CLOSE_TIMEOUT_S)
        with suppress(OSError):
            self._serial.close()

    def _guard(self, loop: Callable[[], None]) -> None:
        try:
            loop()
        except OSError as error:
            self.failure = self.failure or reason(error)

    def _read(self) -> None:
        while not self._closing:
            if self._polled:
                select.select((self._serial.fileno(),), (), (), POLL_S)
            data = self._serial.read(READ_SIZE)
            if data:
                self.bytes += len(data)
                with suppress(queue.Full):  # nobody looks any more
                    self.received.put_nowait((clock_us(), data))

    def _write(self) -> None:
        while (data := self._outgoing.get()) is not None:
            if data == POSE_IS_DUE:
                self._take_pose()
            else:
                self._serial.write(data)


class MavlinkSerialLink:
    """One board. `open` before use; it may be opened again after `close`. `config.baud` is for URIs without one."""

    def __init__(self, uri: str, config: MavlinkLinkConfig) -> None:
        self.uri = uri
        self._device, baud = parse_uri(uri, config.baud)
        self._config = replace(config, baud=baud, signing_start=signing_start())
        self._port: _Port | None = None
        self._lock = threading.Lock()  # around the link, the pose and the mute: the writer uses them, too
        self._link = MavlinkLink(self._carry, self._config)
        self._pose: tuple[MocapFrame, Goal] | None = None
        self._muted = True
        self._late = 0  # poses that were replaced by newer ones, too old, or unfit, when they were to be sent
        self._notices: list[str] = []

    def open(self, give_up: Callable[[], bool]) -> None:
        """Connect and start telemetry; raises `LinkError`, also when told to give up."""
        try:
            self._port = _Port(self._device, self._config.baud, self._send_pose)
        except (OSError, ValueError) as error:
            raise LinkError(f"{self.uri}: {reason(error)}") from None
        with self._lock:
            self._link = MavlinkLink(self._carry, self._config)
        try:
            self._await_board(self._port, give_up)
        except LinkError:
            self.close()
            raise
        self._notices.append(self._link.budget.text)
        self._pose, self._muted = None, False

    def _await_board(self, port: _Port, give_up: Callable[[], bool]) -> None:
        """Wait for a heartbeat, ask for telemetry, wait until the board has acknowledged that."""
        start_us = clock_us()
        link, asked = self._link, False
        while not link.answered:
            with suppress(queue.Empty):
                self.receive(*port.received.get(timeout=POLL_S))
            self.receive(clock_us(), b"")
            if link.board is not None and not asked:
                asked = True
                self.start_telemetry(clock_us())
            if why := self._why_not(port, start_us, give_up):
                raise LinkError(f"{self.uri}: {why}")

    def _why_not(self, port: _Port, start_us: int, give_up: Callable[[], bool]) -> str:
        """Return why connecting is hopeless, empty while it is not."""
        if give_up():
            return "stopped while connecting"
        if port.failure or clock_us() - start_us < ANSWER_TIMEOUT_US:
            return port.failure
        within, seen = f"within {ANSWER_TIMEOUT_US * 1e-6:.0f} s", self._link.counters
        if self._link.board is not None:
            hint = "" if self._config.signing_key else ": does it want signed frames (mavlink.signing_key)?"
            return f"system {self._link.board} answers no command {within}{hint}"
        if not port.bytes:
            return f"no heartbeat {within}: nothing comes"
        if refused := seen.unsigned + seen.bad_signature + seen.replayed:
            return f"no heartbeat {within}: {refused} frames not signed with mavlink.signing_key"
        if not seen.frames:
            return f"no heartbeat {within}: {port.bytes} bytes, not one frame: wrong baud rate?"
        return f"no heartbeat of an autopilot {within}: {seen.frames} frames of others"

    def start_telemetry(self, now_us: int) -> None:
        """Ask the board for its telemetry."""
        with self._lock:
            self._link.start_telemetry(now_us)

    # Uplink

    def send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        """Put pose and goal into the place for one; `WireError` for a pose that cannot be sent."""
        check_pose(frame.p_WB, frame.q_WB)
        with self._lock:
            if self._muted or self._port is None:
                return
            if self._pose is None:
                self._port.write(POSE_IS_DUE)
            else:
                self._late += 1
            self._pose = (frame, goal)

    def _send_pose(self) -> None:
        """Make the frames of what lies in the place for one, when its turn has come."""
        with self._lock:
            pose, self._pose = self._pose, None
            if pose is None:
                return
            now_us = clock_us()
            if now_us - pose[0].t_us > MAX_AGE_US:
                self._late += 1
                return
            self._link.send(now_us, *pose)

    def _carry(self, now_us: int, data: bytes) -> None:
        if self._port is not None:
            self._port.write(data)

    # Downlink

    def received(self) -> list[tuple[int, bytes]]:
        """What came since the last call, with the instants of its arrival [us, `clock_us`]."""
        pieces: list[tuple[int, bytes]] = []
        with suppress(queue.Empty):
            while self._port is not None:
                pieces.append(self._port.received.get_nowait())
        return pieces

    def receive(self, now_us: int, data: bytes) -> Sequence[Sample]:
        """The telemetry in what arrived at `now_us`."""
        with self._lock:
            return self._link.receive(now_us, data, clock_us())

    @property
    def latency(self) -> LinkLatency:
        """From `send` to the board: half of the round trip of a time request."""
        return self._link.latency

    @property
    def supervisor_state(self) -> int | None:
        """The state that the board told last, None before it did, and again from `mute` on."""
        return self._link.supervisor_state

    def notices(self) -> list[str]:
        """Return lines for the user since the last call."""
        lines, self._notices = self._notices, []
        with self._lock:
            while self._link.texts:
                lines.append(self._link.texts.popleft())
        return lines

    def summary(self) -> str:
        """Return one line on how the link does."""
        link = self._link.statistics
        round_trip = "?" if link.round_trip_us is None else f"{link.round_trip_us / 1000:.1f}"
        return (
            f"{link.poses} sent, {self._late} late  frames {link.frames}, {link.lost} lost, {link.bad} bad  "
            f"round trip {round_trip} ms"
        )

    def check(self) -> None:
        """Raise `LinkError` when the link is lost."""
        now_us = clock_us()
        self.receive(now_us, b"")
        if self._port is None or self._port.failure:
            raise LinkError(f"{self.uri}: lost: {self._port.failure if self._port else 'closed'}")
        if now_us - self._link.heard_us > SILENCE_TIMEOUT_US:
            raise LinkError(f"{self.uri}: lost: silent for {SILENCE_TIMEOUT_US * 1e-6:.0f} s")

    def mute(self) -> None:
        """Send no more poses; the board notices the silence and puts its flaps to hover."""
        with self._lock:
            self._muted, self._pose = True, None
            self._link.supervisor_state = None

    def close(self) -> None:
        """Disconnect."""
        self.mute()
        port, self._port = self._port, None
        if port is not None:
            port.close()


def reason(error: Exception) -> str:
    """The sense of one of pyserial's messages."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)
    text = str(error).splitlines()[0] if str(error) else type(error).__name__
    if "Inappropriate ioctl" in text:
        return "not a serial port"
    match = re.search(r"\[Errno -?\d+\] ([^:]+)|\(-?\d+, '([^']+)'\)", text)
    return (match[1] or match[2]) if match else text
