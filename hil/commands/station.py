"""`floaty station`: the ground station for a board, real or virtual."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ground_station.controls import ControlsError
from ground_station.trajectory import Goal, Trajectory
from hil.commands import options as common
from hil.commands.options import FILE, PATH, argument, common_option, option
from hil.commands.tables import print_result
from hil.errors import LabError

if TYPE_CHECKING:
    from ground_station.operator import Operator
    from ground_station.program import LoopHook, StationSession
    from ground_station.records import Records
    from hil.laboratory.experiment import Experiment
    from hil.laboratory.real_flight import RealFlight
    from hil.live.feed import LiveView


@dataclass(frozen=True, slots=True)
class StationOptions:
    """The options of `floaty station`."""

    uri: str = option(
        "--link", "uri", required=True, metavar="URI",
        help="radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:19850, or mavlink:DEVICE[,BAUD] with a DEVICE like /dev/ttyUSB0, "
        "COM3, socket://HOST:PORT, rfc2217://HOST:PORT.",
    )  # fmt: skip
    mocap: str | None = option(
        "--mocap", metavar="SYSTEM",
        help="The source of poses, which overrides [capture] of the profile: optitrack:HOST[:PORT], also the Motive of "
        "`floaty serve`, vicon:HOST[:PORT], qualisys:HOST, vrpn:HOST[:PORT], each with [,body=NAME] [,z-up|,y-up], "
        "optitrack with [,multicast]; or replay:PATH, a file of --record, a telemetry.csv or a run folder, "
        "whose end ends the flight.",
    )  # fmt: skip
    named: str = argument("named", metavar="[EXPERIMENT]", default="hover")
    start_s: float = option(
        "--start", "start_s", type=common.Number(0, 3600), default=1.0, show_default=True, metavar="S",
        help="When the trajectory begins, after the board first flies.",
    )  # fmt: skip
    duration: float | None = option(
        "--duration", type=common.Number(min=0, min_open=True), metavar="S", help="[default: until Ctrl-C]"
    )
    log: Path | None = option("--log", type=FILE, metavar="FILE", help="Telemetry as CSV.")
    record: Path | None = option(
        "--record", type=FILE, metavar="FILE",
        help="Every frame of motion capture as CSV, for --mocap replay:FILE.",
    )  # fmt: skip
    tlog: Path | None = option(
        "--tlog", type=FILE, metavar="FILE",
        help="Every MAVLink frame of the link, as a telemetry log; for --link mavlink:….",
    )  # fmt: skip
    out: Path | None = option(
        "--out", type=PATH, metavar="DIR",
        help="Run folder as `floaty fly` writes one: log, telemetry, events, result, report, recording.",
    )  # fmt: skip
    target: str | None = common_option(common.view_option)
    profile: str = common_option(common.profile_option)
    overrides: tuple[str, ...] = common_option(common.set_option)


@click.command()
@common.asked_as(StationOptions)
def station(asked: StationOptions) -> int:
    """Fly EXPERIMENT, by default hover, with a board, real or virtual: poses in, poses or corrections out at 50 Hz.

    `floaty list` names the experiments. Telemetry is shown and logged.

    Ctrl-C ends the flight: no more poses are sent, the board moves its flaps to hover, the link is closed.

    While it flies, lines like goal 0.1 0 1.15, set controller.gain_y -2.0 or stop act at once; help lists the commands.

    A file, or the standard output, that can no longer be written ends, with one line; the flight continues.

    Exit code with --out: as for `floaty fly`, by the limits of EXPERIMENT on the cameras' poses; 3: flown, but a file or
    the output is incomplete.
    """
    from ground_station.operator import Operator, fly_with
    from ground_station.program import Session
    from ground_station.records import INCOMPLETE, STANDARD_OUTPUT, Records
    from hil.config import load_config
    from hil.laboratory.experiments import EXPERIMENTS, find_experiment

    config, experiment = load_config(asked.profile, asked.overrides), find_experiment(asked.named)
    _check_files(asked)
    records = Records()
    view = common.open_live(asked.target, records.print_text)
    flight = _recorded(asked, experiment, view, records)
    console = OperatorConsole(flight, view, records.print_text)
    know = view.know if view is not None and asked.target == "foxglove:parameters" else None
    operator = Operator(_trajectory_of, console.reply, console.note, know)
    log = flight.telemetry if flight is not None and asked.out is not None else asked.log
    session = Session(
        asked.uri, asked.mocap, experiment.trajectory, asked.start_s, log, asked.record, asked.tlog, records
    )
    failure, interrupted = fly_with(
        operator,
        config.ground,
        session,
        console.report,
        asked.duration,
        console.hooks(operator),
        [*EXPERIMENTS],
    )
    result = flight.close(failure, interrupted) if flight is not None else None
    if result is not None:
        records.write(asked.out, common.write_pictures, result.folder, experiment)
        records.write(STANDARD_OUTPUT, print_result, result)
    records.write(asked.out, common.close_live, view, result, records.print_text)
    for notice in records.notices():
        records.print_text(notice)
    if failure:
        raise LabError(failure)
    if records.incomplete:
        return INCOMPLETE
    return 0 if result is None else common.exit_code(result)


def _recorded(
    asked: StationOptions, experiment: Experiment, view: LiveView | None, records: Records
) -> RealFlight | None:
    """Return the record of the flight, None if nobody wants it."""
    from hil.laboratory.real_flight import RealFlight
    from hil.laboratory.request import REAL, Bench, Request

    if asked.out is None and view is None:
        return None
    bench = Bench(link=asked.uri, board=REAL)
    request = Request(experiment, asked.profile, asked.overrides, 0, experiment.duration_s, (), bench)
    return RealFlight(asked.out, request, records, records.print_text, observer=view)


@dataclass(frozen=True, slots=True)
class OperatorConsole:
    """The operator's output: the terminal, and the flight's record and picture if there are any."""

    flight: RealFlight | None
    view: LiveView | None
    say: Callable[[str], None]

    def report(self, text: str) -> None:
        """Print and record a line of the station."""
        self.say(text)
        if self.flight is not None:
            self.flight.note("station", text)

    def note(self, text: str) -> None:
        """Record an action of the operator."""
        from hil.laboratory.files.recorder import OPERATOR

        if self.flight is not None:
            self.flight.note(OPERATOR, text)

    def reply(self, text: str) -> None:
        """Print and show an answer to the operator."""
        self.say(text)
        if self.view is not None:
            self.view.answer(0 if self.flight is None else self.flight.log_us, text)

    def hooks(self, operator: Operator) -> list[LoopHook]:
        """Return the parts of the picture and the record in every turn of the flight."""
        view = self.view

        def take_lines(session: StationSession, now_us: int) -> None:
            for line in view.lines() if view is not None else ():
                operator.queue_line(line)

        return [take_lines] if self.flight is None else [take_lines, self.flight.on_loop]


def _check_files(asked: StationOptions) -> None:
    """Raise `LabError` for files that cannot be written, or not with these options."""
    if asked.out is not None and asked.log is not None:
        raise LabError(f"--log {asked.log}: --out {asked.out} has a telemetry.csv of its own")
    for name, path in (("--log", asked.log), ("--record", asked.record), ("--tlog", asked.tlog)):
        if path is not None and not path.parent.is_dir():
            raise LabError(f"{name} {path}: there is no folder {path.parent}")
    if asked.tlog is not None and not asked.uri.startswith("mavlink:"):
        raise LabError(
            f"--tlog {asked.tlog}: --link {asked.uri}: only mavlink:DEVICE[,BAUD] has frames of MAVLink"
        )


def _trajectory_of(name: str) -> Callable[[Goal, int], Trajectory]:
    from hil.laboratory.experiments import find_experiment

    try:
        return find_experiment(name).trajectory
    except LabError as error:
        raise ControlsError(str(error)) from None
