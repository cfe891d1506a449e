"""The common part of all links to a real board; `crazyradio` and `mavlink_serial` are the back ends.

The newest pose waits in a mailbox; one thread sends, so that nothing else waits for the line, and a pose that has become
too old is dropped. Every wait has a limit, and every failure is a `LinkError` of one line. A back end opens, sends
and reads.
"""

import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from math import nan

from firmware_py.core.structs import HORIZON_LIMIT, TICK_US
from firmware_py.wire.telemetry import Sample
from ground_station.clock import clock_us
from ground_station.controls import Answer, ControlRequest
from ground_station.errors import LinkError
from ground_station.latency import LinkLatency
from ground_station.mocap import MocapFrame
from ground_station.throttle import Throttle
from ground_station.trajectory import Goal

ANSWER_TIMEOUT_US = 4_000_000  # without any answer while connecting
CONNECT_TIMEOUT_US = 60_000_000  # in total; tables of contents are long and slow with losses
SILENCE_TIMEOUT_US = 2_000_000  # connected: the slowest board is received once per second
MAX_AGE_US = HORIZON_LIMIT * TICK_US  # of a pose on board, which cannot use an older one
POLL_S = 0.05  # between two checks of a board that connects
CLOSE_TIMEOUT_S = 1.5
PIECES = 2000  # read and waiting in `received`

Job = Callable[[], None]


class Sender:
    """A thread that does one job after another."""

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()  # only a few; at most one pose
        self._useless = False
        self._thread = threading.Thread(target=self._run, name="sender", daemon=True)
        self._thread.start()

    def put(self, job: Job) -> None:
        """Queue a job behind those before it."""
        self._jobs.put(job)

    def close(self, lost: bool) -> None:
        """End the thread after the queued jobs, or without them on a lost link; a job that hangs is left alone."""
        self._useless = lost
        self._jobs.put(None)
        if not lost:
            self._thread.join(CLOSE_TIMEOUT_S)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None and not self._useless:
            job()


class LiveLink(ABC):
    """One board. `open` before use; it may be opened again after `close`.

    The back end keeps `received_us`, `latency` and `supervisor_state` up to date, and passes what it reads to `_on_bytes`.
    """

    def __init__(self, uri: str, latency: LinkLatency) -> None:
        self.uri = uri
        self.latency = latency
        # The last state received from the board, None before it and again after `mute`.
        self.supervisor_state: int | None = None
        self.sent = 0  # poses
        # Poses that a newer one replaced, or that were too old when they were to be sent.
        self.late = 0
        self.received_us = 0  # when the board was last received; 0: not yet
        # Of a radio: link quality, 100 % without retries, and signal strength at the board [-dBm].
        self.quality = self.rssi = nan
        self._notices: list[str] = []
        self._received: queue.Queue[tuple[int, bytes]] = queue.Queue(PIECES)
        self._mailbox: tuple[MocapFrame, Goal] | None = None
        self._too_old_us: int | None = None  # age of the last pose that was, since the last notices
        self._throttle = Throttle()
        self._muted = True
        self._lock = threading.Lock()  # around mailbox, mute and counters
        self._sender: Sender | None = None

    # Methods of a back end

    @abstractmethod
    def _open(self) -> None:
        """Open the device; raises `LinkError`."""

    @abstractmethod
    def _connect(self) -> bool:
        """Wait `POLL_S` for the board's next step towards a connection; return whether that was the last one."""

    @abstractmethod
    def _why_no_connection(self, now_us: int, within: str) -> str:
        """Return why the board has not connected `within` `ANSWER_TIMEOUT_US`; empty if it is still making progress."""

    @abstractmethod
    def _send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        """Send a pose that leaves at `now_us`, in the sender's thread."""

    @abstractmethod
    def _failure(self) -> str:
        """Return why the device has failed, empty while it works."""

    @abstractmethod
    def _close(self) -> None:
        """Close the device, if it is open."""

    @abstractmethod
    def start_telemetry(self, now_us: int) -> None:
        """Ask the board for its telemetry."""

    @abstractmethod
    def receive(self, now_us: int, data: bytes) -> Sequence[Sample]:
        """Return the telemetry in what arrived at `now_us`; `WireError` if it is malformed."""

    @abstractmethod
    def ask(self, now_us: int, request: ControlRequest) -> None:
        """Begin an operator's request, in place of the previous one."""

    @abstractmethod
    def answer(self, now_us: int) -> Answer | None:
        """Return the answer once, when it has arrived."""

    @abstractmethod
    def summary(self) -> str:
        """Return one line on the state of the link."""

    # Connecting

    def open(self, give_up: Callable[[], bool]) -> None:
        """Connect and start telemetry; raises `LinkError`, also when `give_up` returns true."""
        self.received_us = 0
        self._received = queue.Queue(PIECES)
        self._sender = Sender()
        try:
            self._open()
            start_us = clock_us()
            while not self._connect():
                if why := self._why_hopeless(start_us, give_up):
                    raise LinkError(f"{self.uri}: {why}")
        except LinkError:
            self.close()
            raise
        with self._lock:
            self._muted = False

    def _why_hopeless(self, start_us: int, give_up: Callable[[], bool]) -> str:
        """Return why connecting has failed for good, empty while it may succeed."""
        now_us = clock_us()
        if give_up():
            return "stopped while connecting"
        if why := self._failure():
            return why
        if now_us - start_us > CONNECT_TIMEOUT_US:
            return f"not connected after {seconds(CONNECT_TIMEOUT_US)}"
        if now_us - start_us > ANSWER_TIMEOUT_US:
            return self._why_no_connection(now_us, f"within {seconds(ANSWER_TIMEOUT_US)}")
        return ""

    def check(self) -> None:
        """Raise `LinkError` when the link is lost."""
        why = self._failure()
        if not why and clock_us() - self.received_us > SILENCE_TIMEOUT_US:
            why = f"silent for {seconds(SILENCE_TIMEOUT_US)}"
        if why:
            raise LinkError(f"{self.uri}: lost: {why}")

    def mute(self) -> None:
        """Send no more poses until `open`; the board notices the silence and puts its flaps to hover."""
        self.supervisor_state = None
        with self._lock:
            self._muted, self._mailbox = True, None

    def close(self) -> None:
        """Disconnect, within some seconds; `open` connects again."""
        self.mute()
        sender, self._sender = self._sender, None
        if sender is not None:
            sender.close(lost=bool(self._failure()))
        self._close()

    # Uplink

    def send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        """Put pose and goal into the mailbox."""
        with self._lock:
            if self._muted:
                return
            replaces = self._mailbox is not None
            self._mailbox = (frame, goal)
            self.late += replaces
        if not replaces:
            self._do(self._send_newest)

    def _send_newest(self) -> None:
        """Send the pose in the mailbox, unless it is too old."""
        with self._lock:
            mail, self._mailbox = self._mailbox, None
        if mail is None:
            return
        now_us = clock_us()
        age_us = now_us + self.latency.us - mail[0].t_us
        late = age_us > MAX_AGE_US
        if not late:
            self._send(now_us, *mail)
        with self._lock:
            self.late += late
            self._too_old_us = age_us if late else self._too_old_us
            self.sent += not late

    def _do(self, job: Job) -> None:
        """Pass a job to the sender's thread."""
        if (sender := self._sender) is not None:
            sender.put(job)

    # Downlink

    def _on_bytes(self, data: bytes) -> None:
        """Queue bytes that were just read; the back end's reader calls this."""
        with suppress(queue.Full):  # the user no longer reads
            self._received.put_nowait((clock_us(), data))

    def received(self) -> list[tuple[int, bytes]]:
        """Return what arrived since the last call, with the instants of arrival [us, `clock_us`]."""
        pieces: list[tuple[int, bytes]] = []
        with suppress(queue.Empty):
            while True:
                pieces.append(self._received.get_nowait())
        return pieces

    def notices(self) -> list[str]:
        """Return lines for the user since the last call."""
        notices, self._notices = self._notices, []
        with self._lock:
            age_us, self._too_old_us = self._too_old_us, None
        if age_us is not None and self._throttle.admits("too old", clock_us()):
            notices.append(
                f"poses {age_us / 1000:.0f} ms old on their arrival on board: at most {MAX_AGE_US // 1000} ms"
            )
        return notices


def seconds(duration_us: int) -> str:
    """Return a time limit as text for the user."""
    return f"{duration_us * 1e-6:.0f} s"
