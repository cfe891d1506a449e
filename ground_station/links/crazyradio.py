"""The link to a real Crazyflie-class board over cflib: `radio://…` with a Crazyradio, or `udp://…`.

Corrections wait in a place for one, the newest; a thread sends them, so that nobody else waits for the radio, and sets
their age at the last moment. Telemetry comes through log blocks that are created on connecting. Every wait here has a
limit, and everything that goes wrong is a `LinkError` of one line. Of the links the only one that knows cflib.
"""

import logging
import queue
import re
import struct
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median_low

import cflib.crtp
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig, LogTocElement
from cflib.crtp.crtpstack import CRTPPacket, CRTPPort

from firmware_py.wire import WireError
from firmware_py.wire.crtp import CHANNEL_LOG_DATA, PORT_LOG, decode, decode_log_data, encode_ext_pose
from firmware_py.wire.telemetry import BLOCKS, PERIOD_MS, Block, Sample
from ground_station.clock import clock_us
from ground_station.corrections import Correction, correct
from ground_station.errors import LinkError
from ground_station.latency import LinkLatency
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal

ANSWER_TIMEOUT_US = 4_000_000  # without any answer while connecting
CONNECT_TIMEOUT_US = 60_000_000  # in all; tables of contents are long and slow with losses
SILENCE_TIMEOUT_US = 2_000_000  # connected: telemetry comes 50 times, an echo 10 times per second
CLOSE_TIMEOUT_S = 3.0
MAX_AGE_US = 120_000  # older corrections are not sent: the board could not use them
RECEIVE_QUEUE = 1000  # packets of telemetry
ECHO_PERIOD_US = 100_000  # between packets that the board sends back
ECHO_APART_US = 3_000  # from the last correction, in whose way they would be
ECHOES = 30  # of which the median counts
ECHO_HEADER = 0xF0  # port 15, channel 0
ECHO = struct.Struct("<BQ")  # kind, own clock [us]; as long as cflib's own, which have kind 0
OWN_ECHO = 1
MIN_PROTOCOL = 4  # version from which the tables of contents are as read here
NULL_HEADER, NULL_MASK = 0xF3, 0xF3
URIS = (r"radio://\w+/\d{1,3}/(250K|1M|2M)(/[0-9A-Fa-f]{10})?", r"udp://[\w.-]+:\d{1,5}")
SUPERVISOR_STATE = "supervisor.state"


@dataclass(slots=True)
class LinkStatistics:
    """What the link looks like; quality, rate and signal strength are cflib's, 0 over UDP."""

    sent: int = 0  # corrections
    replaced: int = 0  # by a newer one before they could be sent
    too_old: int = 0
    quality: float = 0.0  # [%] 100: no retries
    rate: float = 0.0  # exchanges with the board [1/s]
    rssi: float = 0.0  # [-dBm]


class CrazyradioLink:
    """One board. `open` before use; it may be opened again after `close`.

    `latency_us`: to the board, until it is measured as half of the round trip of packets that the board sends back.
    """

    def __init__(self, uri: str, latency_us: int) -> None:
        self.uri = uri
        self.statistics = LinkStatistics()
        self.supervisor_state: int | None = None  # as last received
        self._missing: list[str] = []  # telemetry variables that the board does not have, not told yet
        self._medium = uri.partition(":")[0]
        self.latency = LinkLatency(self._medium, latency_us, measured=False)
        self._round_trips_us: deque[int] = deque(maxlen=ECHOES)
        self._echo_us = 0  # when to ask for the next one
        self._echo_is_due = False
        self._sent_us = 0  # the last correction
        self._cache: tempfile.TemporaryDirectory[str] | None = None  # of the TOC, for connecting again
        self._crazyflie: Crazyflie | None = None
        self._blocks: dict[int, Block] = {}
        # What cflib says: an empty text is "connected", any other a failure.
        self._news: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._received: deque[tuple[int, bytes]] = deque(maxlen=RECEIVE_QUEUE)
        self._heard_us = 0  # the last packet with contents
        self._telemetry_us = 0  # the last packet of a log block
        self._mailbox: tuple[int, Correction] | None = None
        self._mail = threading.Condition()
        self._sending = False
        quiet_cflib()

    def open(self, give_up: Callable[[], bool]) -> None:
        """Connect and start telemetry; raises `LinkError`, also when told to give up."""
        if not any(re.fullmatch(pattern, self.uri) for pattern in URIS):
            raise LinkError(f"{self.uri}: expected radio://0/80/2M/E7E7E7E7E7 or udp://127.0.0.1:19850")
        if not cflib.crtp.CLASSES:
            cflib.crtp.init_drivers()
        self._news = queue.SimpleQueue()
        self._heard_us = 0
        self._cache = self._cache or tempfile.TemporaryDirectory(prefix="floaty-toc-")
        crazyflie = self._crazyflie = Crazyflie(rw_cache=self._cache.name)
        crazyflie.packet_received.add_callback(self._on_any_packet)
        crazyflie.connected.add_callback(lambda uri: self._news.put(""))
        crazyflie.connection_failed.add_callback(lambda uri, text: self._news.put(_first_line(text)))
        crazyflie.connection_lost.add_callback(lambda uri, text: self._news.put(_first_line(text)))
        crazyflie.disconnected_link_error.add_callback(lambda uri, text: self._news.put(_first_line(text)))
        try:
            crazyflie.open_link(self.uri)
            self._await_connection(crazyflie, give_up)
        except LinkError:
            self.close()
            raise
        self._watch_statistics(crazyflie)
        self._start_telemetry(crazyflie)
        self._sending = True
        threading.Thread(target=self._send_loop, args=(crazyflie,), name="corrections", daemon=True).start()

    def _await_connection(self, crazyflie: Crazyflie, give_up: Callable[[], bool]) -> None:
        """Wait for cflib's verdict, but not for one that does not come."""
        start_us = clock_us()
        while True:
            try:
                news = self._news.get(timeout=0.1)
            except queue.Empty:
                news = self._why_not_yet(crazyflie, start_us, give_up)
                if not news:
                    continue
            if news:
                raise LinkError(f"{self.uri}: {news}")
            return

    def _why_not_yet(self, crazyflie: Crazyflie, start_us: int, give_up: Callable[[], bool]) -> str:
        """Return why connecting is hopeless, empty while it is not."""
        now_us = clock_us()
        if give_up():
            return "stopped while connecting"
        if now_us - start_us > ANSWER_TIMEOUT_US:
            version = crazyflie.platform.get_protocol_version()
            if not self._heard_us:
                return f"no answer within {ANSWER_TIMEOUT_US * 1e-6:.0f} s"
            if version < MIN_PROTOCOL:
                return f"wrong protocol: version {version} answers, at least {MIN_PROTOCOL} is needed"
            if now_us - self._heard_us > ANSWER_TIMEOUT_US:
                return f"answers stopped while connecting, for {ANSWER_TIMEOUT_US * 1e-6:.0f} s"
        if now_us - start_us > CONNECT_TIMEOUT_US:
            return f"not connected after {CONNECT_TIMEOUT_US * 1e-6:.0f} s"
        return ""

    def _watch_statistics(self, crazyflie: Crazyflie) -> None:
        statistics, source = self.statistics, crazyflie.link_statistics

        def note(name: str) -> object:
            return lambda value: setattr(statistics, name, float(value))

        source.link_quality_updated.add_callback(note("quality"))
        crazyflie.add_port_callback(CRTPPort.LINKCTRL, self._on_echo)
        source.uplink_rate_updated.add_callback(note("rate"))
        source.uplink_rssi_updated.add_callback(note("rssi"))

    def _start_telemetry(self, crazyflie: Crazyflie) -> None:
        """Create the blocks of which the board has all variables."""
        crazyflie.add_port_callback(CRTPPort.LOGGING, self._on_log_packet)
        self._blocks, self._missing = {}, []
        self._telemetry_us = clock_us()
        for block in BLOCKS:
            absent = [
                v.name
                for v in block.variables
                if crazyflie.log.toc.get_element_by_complete_name(v.name) is None
            ]
            self._missing += absent
            if absent:
                continue
            wanted = LogConfig(block.variables[0].name, PERIOD_MS)
            for variable in block.variables:
                wanted.add_variable(
                    variable.name, LogTocElement.get_cstring_from_id(variable.type.log_number)
                )
            crazyflie.log.add_config(wanted)
            self._blocks[wanted.id] = block
            wanted.start()

    def start_telemetry(self, now_us: int) -> None:
        """Nothing: the log blocks run since `open`."""

    # Uplink

    def send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        """Put the correction into the place for one; `WireError` for a pose that cannot be sent."""
        correction = correct(frame, goal, now_us)
        encode_ext_pose(correction.p_GB, correction.q_GB, correction.age_us)
        with self._mail:
            self.statistics.replaced += self._mailbox is not None
            self._mailbox = (clock_us(), correction)
            self._mail.notify()

    def _send_loop(self, crazyflie: Crazyflie) -> None:
        """Send what lies in the mailbox, with the age that it has by now, and what is to be echoed."""
        while True:
            with self._mail:
                self._mail.wait_for(lambda: self._mailbox or self._echo_is_due or not self._sending)
                if not self._sending or self._crazyflie != crazyflie:
                    return
                echo_is_due, self._echo_is_due = self._echo_is_due, False
                mail, self._mailbox = self._mailbox, None
            if echo_is_due:
                crazyflie.send_packet(_packet(ECHO_HEADER, ECHO.pack(OWN_ECHO, clock_us())))
            if mail is None:
                continue
            submitted_us, correction = mail
            self._sent_us = clock_us()
            age_us = correction.age_us + self._sent_us - submitted_us + self.latency.us
            if age_us > MAX_AGE_US:
                self.statistics.too_old += 1
                continue
            data = encode_ext_pose(correction.p_GB, correction.q_GB, age_us)
            crazyflie.send_packet(_packet(data[0], data[1:]))
            self.statistics.sent += 1

    # Downlink

    def received(self) -> list[tuple[int, bytes]]:
        """Telemetry packets since the last call, with the instants of their arrival [us, `clock_us`]."""
        packets = []
        while self._received:
            packets.append(self._received.popleft())
        return packets

    def receive(self, now_us: int, data: bytes) -> Sequence[Sample]:
        """The telemetry in a packet from the board, empty for a packet of another service.

        Blocks of a board are not sampled together; here they get the beginning of their period as common time stamp.
        """
        packet = decode(data)
        if packet.port != PORT_LOG or packet.channel != CHANNEL_LOG_DATA:
            return ()
        number, timestamp_ms, values = decode_log_data(packet.data)
        block = self._blocks.get(number)
        if block is None:
            raise WireError(f"log block {number}: not one of ours")
        sample = Sample(block, timestamp_ms - timestamp_ms % PERIOD_MS, block.unpack(values))
        for variable, value in zip(block.variables, sample.values, strict=True):
            if variable.name == SUPERVISOR_STATE:
                self.supervisor_state = int(value)
        return (sample,)

    def _on_any_packet(self, packet: CRTPPacket) -> None:
        if packet.header & NULL_MASK != NULL_HEADER:  # the radio chip answers even when nobody is behind it
            self._heard_us = clock_us()

    def _on_log_packet(self, packet: CRTPPacket) -> None:
        if packet.channel == CHANNEL_LOG_DATA:
            self._telemetry_us = clock_us()
            self._received.append((self._telemetry_us, bytes((packet.header,)) + bytes(packet.data)))

    def _ask_for_echo(self, now_us: int) -> None:
        """Let the board send a packet back, well apart from corrections: both would be slower."""
        if now_us < self._echo_us or now_us - self._sent_us < ECHO_APART_US:
            return
        self._echo_us = now_us + ECHO_PERIOD_US
        with self._mail:
            self._echo_is_due = True
            self._mail.notify()

    def _on_echo(self, packet: CRTPPacket) -> None:
        if packet.channel or len(packet.data) != ECHO.size:
            return
        kind, asked_us = ECHO.unpack(packet.data)
        if kind == OWN_ECHO:
            self._round_trips_us.append(clock_us() - asked_us)
            self.latency = LinkLatency(self._medium, median_low(self._round_trips_us) // 2, measured=True)

    def notices(self) -> list[str]:
        """Return what the user should know and was not told yet."""
        missing, self._missing = self._missing, []
        return (
            [f"the board has no {', '.join(missing)}: without these blocks of telemetry"] if missing else []
        )

    def summary(self) -> str:
        """Return one line on how the link does."""
        link = self.statistics
        radio = f"  quality {link.quality:.0f} %  {link.rate:.0f} exchanges/s" if link.rate else ""
        return f"corrections {link.sent} sent, {link.replaced + link.too_old} late{radio}"

    def check(self) -> None:
        """Raise `LinkError` when the link is lost."""
        if not self._news.empty():
            raise LinkError(f"{self.uri}: lost: {self._news.get() or 'connected twice'}")
        now_us = clock_us()
        self._ask_for_echo(now_us)
        if now_us - self._heard_us > SILENCE_TIMEOUT_US:
            raise LinkError(f"{self.uri}: lost: silent for {SILENCE_TIMEOUT_US * 1e-6:.0f} s")
        if (
            self._blocks and now_us - self._telemetry_us > SILENCE_TIMEOUT_US
        ):  # cflib does not notice a reboot
            raise LinkError(
                f"{self.uri}: lost: no telemetry for {SILENCE_TIMEOUT_US * 1e-6:.0f} s, it may have rebooted"
            )

    def mute(self) -> None:
        """Send no more corrections; the board notices the silence and puts its flaps to hover."""
        self.supervisor_state = None
        with self._mail:
            self._sending, self._mailbox = False, None
            self._mail.notify()

    def close(self) -> None:
        """Disconnect, within `CLOSE_TIMEOUT_S`; cflib may stay behind when the dongle was pulled."""
        self.mute()
        crazyflie, self._crazyflie = self._crazyflie, None
        if crazyflie is not None:
            closing = threading.Thread(target=crazyflie.close_link, name="closing", daemon=True)
            closing.start()
            closing.join(CLOSE_TIMEOUT_S)


def _packet(header: int, data: bytes) -> CRTPPacket:
    return CRTPPacket(header, list(data))


def quiet_cflib() -> None:
    """Keep cflib's own messages off the terminal: whatever matters becomes a `LinkError`."""
    logger = logging.getLogger("cflib")
    logger.propagate = False
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())


def _first_line(text: str) -> str:
    """The sense of one of cflib's messages, which may carry a traceback."""
    lines = text.strip().splitlines() or ["no reason given"]
    return lines[0].removeprefix("Couldn't load link driver: ")
