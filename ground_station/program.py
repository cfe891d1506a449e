"""The ground station as a program: it connects cameras, link, tracker, trajectory and records, until stopped.

It reconnects when the link is lost, shows the state of the link and the age of poses, and leaves the board with its
flaps at hover: it stops the corrections first, and closes the link when the board is in failsafe. It is independent of the
laboratory: its part of a profile arrives as `GroundConfig`.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

from firmware_py.extras import install_command
from firmware_py.wire import WireError
from firmware_py.wire.supervisor import State
from ground_station.clock import clock_us, epoch_us, wait
from ground_station.config import CaptureConfig, GroundConfig
from ground_station.controls import Answer, ControlRequest
from ground_station.errors import LinkError, MocapError
from ground_station.frame_rate import WINDOW_US, FrameRate
from ground_station.links.frame_log import FrameLog
from ground_station.links.live_link import LiveLink
from ground_station.links.schemes import SCHEMES, find_link
from ground_station.mocap import MocapSource
from ground_station.records import Records
from ground_station.sources.address import find_source
from ground_station.sources.replay import MocapLog, RecordingSource, ReplaySource
from ground_station.station import GroundStation
from ground_station.telemetry_log import TelemetryLog
from ground_station.tracker import tracker_of
from ground_station.trajectory import FlightPlan, Goal, Trajectory

ASK_PERIOD_S = 0.002  # between two polls for an answer
POSE_TIMEOUT_US = 5_000_000
RECONNECT_TIMEOUT_US = 30_000_000
RECONNECT_PERIOD_US = 500_000
STATUS_PERIOD_US = 5_000_000
FAILSAFE_TIMEOUT_US = 2_000_000


@dataclass(frozen=True, slots=True)
class Session:
    """The flight. `start_s`: start of the trajectory's clock, after the board first flies."""

    uri: str
    mocap: str | None  # overrides the settings' capture
    trajectory: Callable[[Goal, int], Trajectory]  # (home, start [us])
    start_s: float = 0.0
    log: Path | None = None  # telemetry
    record: Path | None = None  # frames of motion capture
    tlog: Path | None = None  # frames of MAVLink
    records: Records = field(default_factory=Records)  # what became of these and of the standard output


@dataclass(frozen=True, slots=True)
class StationSession:
    """The view of a recorder or an operator on a flight."""

    link: LiveLink
    ground: GroundStation
    plan: FlightPlan


# Called with the instant in every turn of the station's loop.
LoopHook = Callable[[StationSession, int], None]


@dataclass(slots=True)
class LiveStation:
    """Runs a ground station; `say` gets lines for the user, `stopping` returns whether to end."""

    link: LiveLink
    station: GroundStation
    source: MocapSource
    rate: FrameRate
    say: Callable[[str], None]
    stopping: Callable[[], bool]
    on_loop: Callable[[int], None]  # called again and again with the instant while the link holds
    records: Records

    def run(self) -> None:
        """Fly until stopped; raises `LinkError` when there are no poses or no board."""
        self._report()
        self._connect()
        try:
            while not self.stopping():
                try:
                    self._fly()
                except LinkError as error:
                    self.say(f"{error}; connecting again")
                    self._reconnect(error)
        finally:
            self._leave()

    def _connect(self) -> None:
        self.link.open(self._drop_frames)
        self.say(f"connected to {self.link.uri}")
        self._report()

    def _drop_frames(self) -> bool:
        """Drop the frames that wait; return whether to end."""
        while self.source.receive(0.0) is not None:
            pass
        return self.stopping()

    def _reconnect(self, cause: LinkError) -> None:
        """Retry until it succeeds or takes too long."""
        deadline_us = clock_us() + RECONNECT_TIMEOUT_US
        self.link.close()
        while not self.stopping():
            try:
                self._connect()
                return
            except LinkError:
                if clock_us() > deadline_us:
                    raise cause from None
                again_us = clock_us() + RECONNECT_PERIOD_US
                while clock_us() < again_us:
                    self.source.receive(0.02)

    def _fly(self) -> None:
        """Forward poses and telemetry while the link holds."""
        self._drop_frames()
        pose_us = status_us = clock_us()
        while not self.stopping():
            frame = self.source.receive(0.02)
            now_us = clock_us()
            if frame is not None:
                self.station.on_frame(frame, now_us)
                pose_us = now_us
                if notice := self.rate.on_frame(frame.t_us):
                    self.say(notice)
            elif now_us - pose_us > POSE_TIMEOUT_US:
                self.say(f"no poses for {POSE_TIMEOUT_US * 1e-6:.0f} s")
                pose_us = now_us
            self._take_telemetry()
            self.on_loop(now_us)
            self._report()
            self.link.check()
            if now_us - status_us >= STATUS_PERIOD_US:
                status_us = now_us
                self._show()

    def _take_telemetry(self) -> None:
        for t_us, packet in self.link.received():
            self.station.on_packet(t_us, packet)

    def _report(self) -> None:
        parts = (self.source, self.station, self.link, self.records)
        for notice in [notice for part in parts for notice in part.notices()]:
            self.say(notice)

    def _show(self) -> None:
        counters, tracker = self.station.counters, self.station.tracker
        track = f"track {tracker.summary()}  " if tracker is not None else ""
        self.say(
            f"poses {counters.frames} ({self.station.unused.summary()})  {self.source.summary()}  {track}"
            f"{self.link.summary()}  telemetry {counters.samples}"
        )
        self.say(str(self.station.budget))

    def _leave(self) -> None:
        """Stop correcting, wait until the board has put its flaps to hover, disconnect."""
        try:
            self.link.mute()
            deadline_us = clock_us() + FAILSAFE_TIMEOUT_US
            while clock_us() < deadline_us and self.link.supervisor_state != State.FAILSAFE:
                self.source.receive(0.02)
                self._take_telemetry()
            if self.link.supervisor_state == State.FAILSAFE:
                self.say("the board is in failsafe, flaps at hover")
        finally:
            self.link.close()


def fly(
    settings: GroundConfig,
    session: Session,
    say: Callable[[str], None],
    stopping: Callable[[], bool],
    hooks: Sequence[LoopHook] = (),
) -> None:
    """Fly until stopped, or to the end of a replay.

    Raises `LinkError` or `MocapError` when there is no board or there are no poses, `OSError` for a file that cannot be
    opened, `ImportError` for a package that is missing.
    """
    records = session.records
    with ExitStack() as opened:
        note_frame = write_sample = None
        if session.tlog is not None:
            frames = FrameLog(session.tlog, epoch_us())
            opened.callback(records.attempt, session.tlog, frames.close)
            note_frame = records.guarded(session.tlog, frames.note)
        link = find_link(session.uri, settings.links(note_frame))
        tracker = tracker_of(settings.tracker, settings.frame_period_us)
        played = source = _open_source(session.mocap, settings.capture)
        opened.callback(played.close)
        if session.log is not None:
            telemetry = TelemetryLog(session.log)
            opened.callback(records.attempt, session.log, telemetry.close)
            write_sample = records.guarded(session.log, telemetry.write)
        if session.record is not None:
            seen = MocapLog(session.record)
            opened.callback(records.attempt, session.record, seen.close)
            source = RecordingSource(source, records.guarded(session.record, seen.write))
        plan = FlightPlan(Goal(settings.home, 0.0), session.trajectory)
        ground = GroundStation(link, plan, write_sample, settings.station, tracker)
        live = StationSession(link, ground, plan)

        def over() -> bool:
            return stopping() or (isinstance(played, ReplaySource) and played.over)

        def turn(now_us: int) -> None:
            if plan.start_us is None and link.supervisor_state == State.FLYING:
                plan.start(now_us + round(session.start_s * 1e6))
            for hook in hooks:
                hook(live, now_us)

        longest_us = settings.tracker.reacquire_us if settings.tracker.enabled else WINDOW_US
        rate = FrameRate(settings.frame_period_us, settings.station.corrections_hz, longest_us)
        LiveStation(link, ground, source, rate, say, over, turn, records).run()


def ask(link: LiveLink, request: ControlRequest) -> Answer:
    """Send a request to a board that is connected and not flown from here; raises `LinkError` when it is lost."""
    link.ask(clock_us(), request)
    while (answer := link.answer(clock_us())) is None:
        for t_us, data in link.received():
            with suppress(WireError):
                link.receive(t_us, data)
        link.check()
        wait(ASK_PERIOD_S)
    return answer


def run_until(stopping: Callable[[], bool], duration_s: float | None) -> Callable[[], bool]:
    """Return the function that returns whether to end: when stopped, or after a duration from now on."""
    start_us = clock_us()
    return lambda: stopping() or (duration_s is not None and clock_us() - start_us > duration_s * 1e6)


def why(error: Exception, uri: str) -> str:
    """Return the reason why a session on this link ended, as one line."""
    if isinstance(error, LinkError):
        return f"--link {error}"
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.filename else str(error.strerror or error)
    if isinstance(error, ImportError):
        extra = SCHEMES[uri.partition(":")[0]][2]
        return f"--link {uri}: {error}: {install_command(extra)}"
    return str(error)


def _open_source(mocap: str | None, capture: CaptureConfig) -> MocapSource:
    """Return the connected source of poses."""
    try:
        source = find_source(mocap, capture)
        source.open()
    except MocapError as error:
        what = f"--mocap {mocap}" if mocap is not None else f"capture.system = {capture.system}"
        raise MocapError(f"{what}: {error}") from None
    return source
