"""`floaty station`: the ground station for a board, real or virtual."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ground_station.controls import ControlsError
from ground_station.errors import LinkError, MocapError
from ground_station.trajectory import Goal, Trajectory
from hil.commands.options import (
    INTERRUPTED,
    asked_as,
    close_live,
    open_live,
    profile_option,
    say,
    set_option,
    stop_signals,
    view_option,
    write_pictures,
)
from hil.commands.tables import print_result
from hil.errors import LabError

if TYPE_CHECKING:
    from ground_station.config import GroundConfig
    from hil.config import LabConfig


@dataclass(frozen=True, slots=True)
class StationOptions:
    """The options of `floaty station`."""

    uri: str
    mocap: str | None
    named: str
    start_s: float
    duration: float | None
    log: Path | None
    record: Path | None
    tlog: Path | None
    out: Path | None
    target: str | None
    profile: str
    overrides: tuple[str, ...]


@click.command()
@click.option(
    "--link", "uri", required=True, metavar="URI",
    help="radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:19850, or mavlink:DEVICE[,BAUD] with a DEVICE like /dev/ttyUSB0, "
    "COM3, socket://HOST:PORT, rfc2217://HOST:PORT.",
)  # fmt: skip
@click.option(
    "--mocap", metavar="SYSTEM",
    help="The source of poses, which overrides [capture] of the profile: optitrack:HOST[:PORT], also the Motive of `floaty "
    "serve`, vicon:HOST[:PORT], qualisys:HOST, vrpn:HOST[:PORT], each with [,body=NAME] [,z-up|,y-up], optitrack with "
    "[,multicast]; or replay:PATH, a file of --record, a telemetry.csv or a run folder, whose end ends the flight.",
)  # fmt: skip
@click.argument("named", metavar="[EXPERIMENT]", default="hover")
@click.option(
    "--start", "start_s", type=click.FloatRange(0, 3600), default=1.0, show_default=True, metavar="S",
    help="When the trajectory begins, after the board first flies.",
)  # fmt: skip
@click.option(
    "--duration", type=click.FloatRange(min=0, min_open=True), metavar="S", help="[default: until Ctrl-C]"
)
@click.option(
    "--log", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Telemetry as CSV."
)
@click.option(
    "--record", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help="Every frame of motion capture as CSV, for --mocap replay:FILE.",
)  # fmt: skip
@click.option(
    "--tlog", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help="Every MAVLink frame of the link, as a telemetry log; for --link mavlink:….",
)  # fmt: skip
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="DIR",
    help="Run folder as `floaty fly` writes one: log, telemetry, events, result, report, recording.",
)  # fmt: skip
@view_option
@profile_option
@set_option
@asked_as(StationOptions)
def station(asked: StationOptions) -> int:
    """Fly EXPERIMENT, by default hover, with a board, real or virtual: poses in, poses or corrections out at 50 Hz.

    `floaty list` names the experiments. Telemetry is shown and logged.

    Ctrl-C ends the flight: no more poses are sent, the board moves its flaps to hover, the link is closed.

    While it flies, lines like goal 0.1 0 1.15, set controller.gain_y -2.0 or stop act at once; help lists the commands.

    Exit code with --out: as for `floaty fly`, by the limits of EXPERIMENT on the cameras' poses.
    """
    from ground_station.operator import COMMANDS, Operator
    from ground_station.program import Cockpit, Session, fly, run_until, why
    from ground_station.terminal import Terminal
    from hil.config import load_config
    from hil.experiments import EXPERIMENTS, find_experiment
    from hil.laboratory.real_flight import RealFlight
    from hil.laboratory.recorder import OPERATOR
    from hil.laboratory.request import REAL, Bench, Request

    config = load_config(asked.profile, asked.overrides)
    experiment = find_experiment(asked.named)
    _check_files(asked)
    uri, out = asked.uri, asked.out
    view = open_live(asked.target)
    flight = None
    if out is not None or view is not None:
        bench = Bench(link=uri, board=REAL)
        request = Request(experiment, asked.profile, asked.overrides, 0, experiment.duration_s, (), bench)
        flight = RealFlight(out, request, say, onlooker=view)

    def report(text: str) -> None:
        say(text)
        if flight is not None:
            flight.note("station", text)

    def note(text: str) -> None:
        if flight is not None:
            flight.note(OPERATOR, text)

    def reply(text: str) -> None:
        say(text)
        if view is not None:
            view.answer(0 if flight is None else flight.log_us, text)

    operator = Operator(
        _trajectory_of, reply, note, view.know if view is not None and asked.target == "foxglove" else None
    )
    terminal = Terminal(lambda: (*COMMANDS, *EXPERIMENTS, *operator.known))

    def steer(cockpit: Cockpit, now_us: int) -> None:
        for line in [*terminal.lines(), *(view.lines() if view is not None else ())]:
            operator.take(line)
        operator.turn(cockpit, now_us)

    telemetry = flight.telemetry if flight is not None and out is not None else asked.log
    session = Session(
        uri, asked.mocap, experiment.trajectory, asked.start_s, telemetry, asked.record, asked.tlog
    )
    stops = stop_signals()
    hands = [steer] if flight is None else [steer, flight.turn]
    failure = ""
    try:
        fly(settings_of(config), session, report, run_until(lambda: bool(stops), asked.duration), hands)
    except (LinkError, MocapError, OSError, ImportError) as error:
        failure = why(error, uri)
    finally:
        terminal.close()
    result = flight.close(failure, bool(stops)) if flight is not None else None
    if result is not None:
        write_pictures(result.folder, experiment)
        print_result(result)
    close_live(view, result)
    if failure:
        raise LabError(failure)
    if result is None or result.passed:
        return 0
    return INTERRUPTED if result.outcome == "interrupted" else 1


def _check_files(asked: StationOptions) -> None:
    """Raise `LabError` for files that cannot be written, or not with these options."""
    if asked.out is not None and asked.log is not None:
        raise LabError(f"--log {asked.log}: --out {asked.out} has a telemetry.csv of its own")
    for option, path in (("--log", asked.log), ("--record", asked.record), ("--tlog", asked.tlog)):
        if path is not None and not path.parent.is_dir():
            raise LabError(f"{option} {path}: there is no folder {path.parent}")
    if asked.tlog is not None and not asked.uri.startswith("mavlink:"):
        raise LabError(
            f"--tlog {asked.tlog}: --link {asked.uri}: only mavlink:DEVICE[,BAUD] has frames of MAVLink"
        )


def _trajectory_of(name: str) -> Callable[[Goal, int], Trajectory]:
    from hil.experiments import find_experiment

    try:
        return find_experiment(name).trajectory
    except LabError as error:
        raise ControlsError(str(error)) from None


def settings_of(config: LabConfig) -> GroundConfig:
    """Return the ground station's settings of a profile."""
    from ground_station.config import GroundConfig

    return GroundConfig(
        station=config.station,
        tracker=config.tracker,
        capture=config.capture,
        frame_period_us=config.mocap.period_us,
        home=config.flight.home,
        baud=config.serial.baud,
        signing_key=config.mavlink.signing_key,
    )
