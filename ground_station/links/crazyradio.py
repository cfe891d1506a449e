"""The back end for a real Crazyflie-class board over cflib: `radio://…` with a Crazyradio, or `udp://…`.

Telemetry comes through log blocks that are created on connecting. The only link that uses cflib.
"""

import logging
import re
import shutil
import struct
import tempfile
import threading
import weakref
from collections import deque
from collections.abc import Sequence
from functools import partial
from statistics import median_low

import cflib.crtp
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.param import ParamTocElement
from cflib.crtp.crtpstack import CRTPPacket, CRTPPort

from firmware_py.wire.crtp import PORT_CONSOLE, PORT_LOG, decode, encode_ext_pose
from firmware_py.wire.parameters import ABSOLUTE, encode_pose_kind
from firmware_py.wire.scalars import PARAMETER_SCALARS
from firmware_py.wire.telemetry import Sample, state_in
from ground_station.clock import clock_us
from ground_station.config import LinkSettings
from ground_station.controls import Answer, ControlRequest
from ground_station.corrections import correct
from ground_station.errors import LinkError
from ground_station.latency import LinkLatency
from ground_station.links.crtp_controls import PORTS, CrtpControls, TocEntry
from ground_station.links.live_link import ANSWER_TIMEOUT_US, POLL_S, SILENCE_TIMEOUT_US, LiveLink, seconds
from ground_station.links.log_blocks import LogBlocks
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal

CFLIB_CLOSES_S = 3.0  # it may hang when the dongle was pulled
CONSOLE_BYTES = 1000  # kept of an unfinished line
ECHO_PERIOD_US = 100_000  # between packets that the board sends back
ECHO_APART_US = 3_000  # from the last correction, which they would delay
ECHOES = 30  # for the median
ECHO_HEADER = 0xF0  # port 15, channel 0
ECHO = struct.Struct("<BQ")  # kind, own clock [us]; as long as cflib's own packets, which have kind 0
OWN_ECHO = 1
MIN_PROTOCOL = 4  # version from which the tables of contents are as read here
NULL_HEADER, NULL_MASK = 0xF3, 0xF3
URIS = (r"radio://\w+/\d{1,3}/(250K|1M|2M)(/[0-9A-Fa-f]{10})?", r"udp://[\w.-]+:\d{1,5}")


class CrazyradioLink(LiveLink):
    """One board; the link's latency is assumed until half the round trip of echoed packets is known."""

    def __init__(self, uri: str, settings: LinkSettings) -> None:
        self._medium = uri.partition(":")[0]
        super().__init__(uri, LinkLatency(self._medium, settings.latency_us, measured=False))
        self._round_trips_us: deque[int] = deque(maxlen=ECHOES)
        self._echo_us = 0  # when to request the next one
        self._sent_us = 0  # the last correction
        self._cache = tempfile.mkdtemp(prefix="floaty-toc-")  # of the TOC, for reconnecting
        weakref.finalize(self, shutil.rmtree, self._cache, ignore_errors=True)
        self._crazyflie: Crazyflie | None = None
        self._connected = threading.Event()
        self._lost = ""  # cflib's reason for it
        self._unsafe = False  # without safelink: nothing answered when cflib tried to switch it on
        self._console = b""  # the unfinished line that the board has printed
        self._logs = LogBlocks(self._queue, self._log_table)
        self._telemetry_us = 0  # arrival of the last packet of a log block
        self._rate = 0.0  # of exchanges [1/s], 0 over UDP
        self._controls = CrtpControls(partial(self._queue, 0), self._parameters)

    def _open(self) -> None:
        if not any(re.fullmatch(pattern, self.uri) for pattern in URIS):
            raise LinkError(f"{self.uri}: expected radio://0/80/2M/E7E7E7E7E7 or udp://127.0.0.1:19850")
        start_cflib()
        self._connected = connected = threading.Event()
        self._lost, self._unsafe, self._logs = "", False, LogBlocks(self._queue, self._log_table)
        crazyflie = self._crazyflie = Crazyflie(rw_cache=self._cache)
        # The thread of cflib's own pings waits for itself when it is the first to meet a lost link.
        crazyflie.link_statistics.latency.start = lambda: None
        crazyflie.packet_received.add_callback(partial(self._on_any_packet, crazyflie))
        crazyflie.connected.add_callback(lambda uri: connected.set())
        for event in ("connection_failed", "connection_lost", "disconnected_link_error"):
            getattr(crazyflie, event).add_callback(partial(self._on_lost, crazyflie))
        crazyflie.open_link(self.uri)

    def _connect(self) -> bool:
        if self._unsafe:  # a board that has it switched on takes no second packet
            self._close()
            self._open()
        crazyflie = self._crazyflie
        if crazyflie is None or not self._connected.wait(POLL_S):
            return False
        crazyflie.add_port_callback(CRTPPort.LINKCTRL, self._on_echo)
        for port in (*PORTS, PORT_CONSOLE, PORT_LOG):
            crazyflie.add_port_callback(
                port, lambda packet: self._on_bytes(bytes((packet.header,)) + bytes(packet.data))
            )
        statistics = crazyflie.link_statistics
        statistics.link_quality_updated.add_callback(partial(setattr, self, "quality"))
        statistics.uplink_rssi_updated.add_callback(partial(setattr, self, "rssi"))
        statistics.uplink_rate_updated.add_callback(partial(setattr, self, "_rate"))
        if crazyflie.param.toc.get_element_by_complete_name(ABSOLUTE) is not None:
            self._queue(0, encode_pose_kind(absolute=False))  # cflib would first read all values
        self._telemetry_us = now_us = clock_us()
        self._logs.request(now_us)
        return True

    def _why_no_connection(self, now_us: int, within: str) -> str:
        if not self.received_us or self._crazyflie is None:
            return f"no answer {within}"
        version = self._crazyflie.platform.get_protocol_version()
        if version < MIN_PROTOCOL:
            return f"wrong protocol: version {version} answers, at least {MIN_PROTOCOL} is needed"
        if now_us - self.received_us > ANSWER_TIMEOUT_US:
            return f"answers stopped while connecting, for {seconds(ANSWER_TIMEOUT_US)}"
        return ""

    def _on_lost(self, crazyflie: Crazyflie, uri: str, text: str) -> None:
        if crazyflie is self._crazyflie:
            self._lost = self._lost or first_line(text)

    def _failure(self) -> str:
        return self._lost

    def check(self) -> None:
        super().check()
        now_us = clock_us()
        # cflib does not notice a reboot.
        if self._logs.requested and now_us - self._telemetry_us > SILENCE_TIMEOUT_US:
            silence = seconds(SILENCE_TIMEOUT_US)
            raise LinkError(f"{self.uri}: lost: no telemetry for {silence}, it may have rebooted")
        self._logs.repeat(now_us)
        # Echoes are requested well apart from corrections, which would delay both.
        if now_us >= self._echo_us and now_us - self._sent_us >= ECHO_APART_US:
            self._echo_us = now_us + ECHO_PERIOD_US
            self._do(lambda: self._transmit(bytes((ECHO_HEADER,)) + ECHO.pack(OWN_ECHO, clock_us())))

    def _close(self) -> None:
        crazyflie, self._crazyflie = self._crazyflie, None
        if crazyflie is None:
            return
        closing = threading.Thread(target=crazyflie.close_link, name="closing", daemon=True)
        link = crazyflie.link  # None: cflib itself has closed a lost one
        if link is not None and self._unsafe:
            link.close()  # before the next one takes the air
        closing.start()
        if link is not None and not self._unsafe:
            closing.join(CFLIB_CLOSES_S)

    def _log_table(self) -> dict[str, int]:
        """Return the numbers of the board's log variables, as fetched by cflib."""
        groups = {} if self._crazyflie is None else self._crazyflie.log.toc.toc
        return {
            f"{group}.{name}": element.ident
            for group, elements in groups.items()
            for name, element in elements.items()
        }

    def _parameters(self) -> dict[str, TocEntry]:
        """Return the board's table of parameters, as fetched by cflib, without those of types that Floaty lacks."""
        groups = {} if self._crazyflie is None else self._crazyflie.param.toc.toc
        scalars = {ParamTocElement.types[number][0]: scalar for number, scalar in PARAMETER_SCALARS.items()}
        return {
            f"{group}.{name}": TocEntry(
                element.ident,
                scalars[element.ctype],
                element.access == ParamTocElement.RW_ACCESS,
                element.is_persistent(),
            )
            for group, elements in groups.items()
            for name, element in elements.items()
            if element.ctype in scalars
        }

    def ask(self, now_us: int, request: ControlRequest) -> None:
        self._controls.ask(now_us, request)

    def answer(self, now_us: int) -> Answer | None:
        return self._controls.answer(now_us)

    def start_telemetry(self, now_us: int) -> None:
        """Do nothing: the log blocks run since `open`."""

    # Uplink

    def _send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        self._sent_us = now_us
        self._transmit(encode_ext_pose(*correct(frame, goal, now_us + self.latency.us)))

    def _queue(self, now_us: int, data: bytes) -> None:
        self._do(partial(self._transmit, data))

    def _transmit(self, data: bytes) -> None:
        if (crazyflie := self._crazyflie) is not None:
            crazyflie.send_packet(CRTPPacket(data[0], list(data[1:])))

    # Downlink

    def receive(self, now_us: int, data: bytes) -> Sequence[Sample]:
        """Return the telemetry in a packet from the board, empty for a packet of another service."""
        packet = decode(data)
        if packet.port in PORTS:
            self._controls.receive(now_us, packet)
        if packet.port == PORT_CONSOLE:
            *lines, self._console = (self._console + packet.data)[-CONSOLE_BYTES:].split(b"\n")
            self._notices += [f"board: {line.decode(errors='replace')}" for line in lines if line]
        if packet.port != PORT_LOG:
            return ()
        samples = self._logs.receive(now_us, packet)
        if samples:
            self._telemetry_us = now_us
        if (state := state_in(samples)) is not None:
            self.supervisor_state = state
        self._notices += self._logs.notices
        self._logs.notices.clear()
        return samples

    def _on_any_packet(self, crazyflie: Crazyflie, packet: CRTPPacket) -> None:
        link = crazyflie.link
        if crazyflie is self._crazyflie and link is not None:
            self._unsafe = link.needs_resending
        if packet.header & NULL_MASK != NULL_HEADER:  # the radio chip answers even without a board behind it
            self.received_us = clock_us()

    def _on_echo(self, packet: CRTPPacket) -> None:
        if packet.channel or len(packet.data) != ECHO.size:
            return
        kind, asked_us = ECHO.unpack(packet.data)
        if kind == OWN_ECHO:
            self._round_trips_us.append(clock_us() - asked_us)
            self.latency = LinkLatency(self._medium, median_low(self._round_trips_us) // 2, measured=True)

    def summary(self) -> str:
        radio = f"  quality {self.quality:.0f} %  {self._rate:.0f} exchanges/s" if self._rate else ""
        return f"corrections {self.sent} sent, {self.late} late{radio}"


def start_cflib() -> None:
    """Load cflib's drivers, and keep its messages off the terminal: important ones become a `LinkError`."""
    logger = logging.getLogger("cflib")
    logger.propagate = False
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())
    if not cflib.crtp.CLASSES:
        cflib.crtp.init_drivers()


def first_line(text: str) -> str:
    """Return the first line of one of cflib's messages, which may carry a traceback."""
    lines = text.strip().splitlines() or ["no reason given"]
    return lines[0].removeprefix("Couldn't load link driver: ")
