"""The ground station as a program: it connects cameras, link, tracker, trajectory and records, until stopped.

It is independent of the laboratory: its part of a profile arrives as `GroundConfig`.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from firmware_py.extras import install_command
from firmware_py.wire import WireError
from firmware_py.wire.supervisor import State
from ground_station.clock import clock_us, epoch_us, wait
from ground_station.config import CaptureConfig, GroundConfig
from ground_station.controls import Answer, ControlRequest
from ground_station.errors import LinkError, MocapError
from ground_station.frame_rate import FrameRate
from ground_station.links.frame_log import FrameLog
from ground_station.links.live_link import LiveLink
from ground_station.links.schemes import LinkSettings, find_link
from ground_station.live import LiveStation
from ground_station.mocap import MocapSource
from ground_station.sources.address import find_source
from ground_station.sources.replay import RecordingSource, ReplaySource
from ground_station.station import GroundStation
from ground_station.telemetry_log import TelemetryLog
from ground_station.tracker import tracker_of
from ground_station.trajectory import FlightPlan, Goal, Trajectory

ASK_PERIOD_S = 0.002  # between two polls for an answer


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


@dataclass(frozen=True, slots=True)
class Cockpit:
    """The view of a recorder or an operator on a flight."""

    link: LiveLink
    ground: GroundStation
    plan: FlightPlan


Hand = Callable[[Cockpit, int], None]  # called with the instant in every turn of the station's loop


def fly(
    settings: GroundConfig,
    session: Session,
    say: Callable[[str], None],
    stopping: Callable[[], bool],
    hands: Sequence[Hand] = (),
) -> None:
    """Fly until stopped, or to the end of a replay.

    Raises `LinkError` or `MocapError` when there is no board or there are no poses, `OSError` for a file that cannot be
    written, `ImportError` for a package that is missing.
    """
    with ExitStack() as opened:
        note_frame = None
        if session.tlog is not None:
            frames = FrameLog(session.tlog, epoch_us())
            opened.callback(frames.close)
            note_frame = frames.note
        link = find_link(session.uri, replace(link_settings(settings), note_frame=note_frame))
        tracker = tracker_of(settings.tracker, settings.frame_period_us)
        played = source = _open_source(session.mocap, settings.capture)
        opened.callback(lambda: source.close())
        telemetry = None
        if session.log is not None:
            telemetry = TelemetryLog(session.log)
            opened.callback(telemetry.close)
        source = RecordingSource(source, session.record) if session.record else source
        plan = FlightPlan(Goal(settings.home, 0.0), session.trajectory)
        ground = GroundStation(link, plan, telemetry, settings.station, tracker)
        cockpit = Cockpit(link, ground, plan)

        def over() -> bool:
            return stopping() or (isinstance(played, ReplaySource) and played.over)

        def turn(now_us: int) -> None:
            if plan.start_us is None and link.supervisor_state == State.FLYING:
                plan.start(now_us + round(session.start_s * 1e6))
            for hand in hands:
                hand(cockpit, now_us)

        rate = FrameRate(settings.frame_period_us, settings.station.corrections_hz)
        LiveStation(link, ground, source, rate, say, over, turn).run()


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


def link_settings(settings: GroundConfig) -> LinkSettings:
    """Return the links' settings; a link never sends more poses than the cameras deliver."""
    return LinkSettings(
        corrections_hz=min(settings.station.corrections_hz, 1e6 / settings.frame_period_us),
        latency_us=settings.station.link_latency_us,
        baud=settings.baud,
        signing_key=bytes.fromhex(settings.signing_key),
    )


def why(error: Exception, uri: str) -> str:
    """Return the reason why a session on this link ended, as one line."""
    if isinstance(error, LinkError):
        return f"--link {error}"
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror or error}"
    if isinstance(error, ImportError):
        extra = "mavlink" if uri.startswith("mavlink") else "radio"
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
