"""`floaty fly`: one experiment, one seed with pictures or many in parallel, in lockstep or over a real link."""

from __future__ import annotations

from dataclasses import replace
from math import pi
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click
from click.core import ParameterSource
from rich.progress import TextColumn, TimeRemainingColumn
from rich.table import Table

from hil.commands import options as common
from hil.commands.options import PATH, say, warn
from hil.commands.tables import print_result, print_seeds
from hil.errors import LabError, reading, require_empty, writing

if TYPE_CHECKING:
    from hil.laboratory.experiment import Experiment
    from hil.laboratory.flight import Flight
    from hil.laboratory.request import Options, Request
    from hil.laboratory.swarms.result import SwarmResult
    from hil.live.panel_commands import PanelCommands
    from hil.pictures.compare import FlownRun

SEEDS_MAX = 10_000


@click.command()
@click.argument("experiment")
@common.seed_option
@click.option(
    "--seeds", type=click.IntRange(1, SEEDS_MAX), default=1, metavar="N",
    help="Fly N seeds from --seed on, in parallel; logs without pictures.",
)  # fmt: skip
@click.option(
    "--robots", type=int, metavar="N",
    help="Fly N robots together in lockstep, with seeds from --seed on, places and limits of [swarm] in the profile. "
    "EXPERIMENT may then be a folder with a trajectory (.csv) for each.",
)  # fmt: skip
@common.duration_option
@common.profile_options
@common.fault_option
@click.option("--realtime", is_flag=True, help="Pace the flight to the wall clock.")
@common.view_option
@click.option(
    "--perfetto", "trace", is_flag=True, help="Trace the scheduler and write flight.perfetto-trace."
)
@click.option(
    "--link", metavar="LINK", default="radio", show_default=True,
    help="radio or mavlink: in lockstep; radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:PORT or mavlink:/dev/NAME: over "
    "cflib or a serial port, in real time, the ground station in a process of its own.",
)  # fmt: skip
@click.option(
    "--board", metavar="BOARD", default="c", show_default=True,
    help="What executes the flight core: c (the C that is flashed), python (for a debugger) or cortex-m4 (its machine code, "
    "emulated); the image of a Crazyflie's firmware, which flies whole: an ELF file, a .bin or the zip of a release; or a "
    "real board, which must not fly: radio://0/80/2M/E7E7E7E7E7, usb://0 or udp://HOST:PORT.",
)  # fmt: skip
@common.elf_option
@common.gdb_option
@common.coverage_option
@click.option(
    "--profile-cpu", type=PATH, metavar="OUT",
    help="With an image as --board: write where its cycles went to OUT.txt, OUT.speedscope.json and OUT.folded.",
)  # fmt: skip
@click.option(
    "--hil", "in_loop", type=click.Choice(["still", "moving"]), is_flag=False, flag_value="still",
    help="Let the board of --board fly by its own tasks and clock, with the gyro samples of the virtual IMU; its servos "
    "stay at hover, or move as well.",
)  # fmt: skip
@click.option(
    "--out",
    type=PATH,
    metavar="DIR",
    help="Run folder [runs/EXPERIMENT-SEED; -2, -3, … is added if that holds another flight].",
)
@click.option(
    "--baseline", type=PATH, metavar="RUN",
    help="Compare with an earlier run: exit code 1 and the comparison when a metric leaves 10 % of that run's.",
)  # fmt: skip
@common.runner_options
def fly(
    experiment: str,
    seeds: int,
    robots: int | None,
    target: str | None,
    out: Path | None,
    baseline: Path | None,
    **given: Any,
) -> int:
    """Fly EXPERIMENT in the virtual laboratory: a name (see `floaty list`), FILE.py:NAME, or a trajectory FILE.csv.

    Exit code 0: all limits hold; 1: a limit fails, or a metric leaves the baseline's; 2: bad input; 130: interrupted.
    """
    if baseline is not None and seeds > 1:
        raise LabError(f"--baseline {baseline}: is for one seed")
    crew = {name: given.pop(name) for name in ("workers", "cluster", "resume")}
    options = cast("Options", given)
    if options["trace"]:
        import hil.pictures.exports.perfetto  # noqa: F401 - reports a missing package now, not after the flight
    from hil.api import request_of

    if robots is not None:
        _check_alone(robots, seeds > 1 or any(crew.values()), target, baseline)
        return _fly_together(experiment, robots, options, out)
    common.check_alone(options["overrides"], "--robots N flies several")
    request = request_of(experiment, **options)
    before = None if baseline is None else _flown(baseline)
    if seeds > 1:
        _check_seeds(seeds, request, target)
    elif any(crew.values()):
        raise LabError("--workers, --cluster and --resume are for several --seeds")
    common.announce_compilation()
    if seeds > 1:
        requests = [replace(request, seed=request.seed + index) for index in range(seeds)]
        code = _fly_many(requests, options, out or Path("runs"), crew)
        _cover(request)
        return code
    from hil.laboratory.files.folder import folder_of, moved, reserved

    folder = out or folder_of(request)
    if out is None and (why := moved(request, folder)):
        warn(why)
    with reserved(request, folder):
        code = _fly_one(request, folder, target)
    _cover(request)
    if before is None or code == common.INTERRUPTED:
        return code
    return max(code, _left(before, folder, request.experiment))


def _cover(request: Request) -> None:
    """Write the files of --coverage, and name those of --profile-cpu."""
    if request.bench.profile_cpu is not None:
        from hil.laboratory.files.cpu_profile import files_of

        say("processor time:")
        for file in files_of(request.bench.profile_cpu):
            say(f"  {file}")
    if request.bench.coverage is not None:
        common.print_coverage(request.bench.coverage)


def _check_alone(robots: int, many: bool, target: str | None, baseline: Path | None) -> None:
    """Raise `LabError` for options that are for one robot."""
    given = {"--seeds, --workers, --cluster, --resume": many, "--view": target, "--baseline": baseline}
    if wrong := [name for name, value in given.items() if value]:
        raise LabError(f"--robots {robots}: {', '.join(wrong)}: not for robots that fly together")


def _fly_together(experiment: str, robots: int, options: Options, out: Path | None) -> int:
    """Fly several robots on one clock, with the pictures of all; return the exit code."""
    from hil.commands.tables import print_swarm
    from hil.laboratory.experiments import find_experiments
    from hil.laboratory.swarms.flying import fly_swarm
    from hil.laboratory.swarms.folder import swarm_folder, swarm_reserved
    from hil.laboratory.swarms.request import swarm_of
    from hil.pictures.swarm import write_swarm_report

    request = swarm_of(find_experiments(experiment, robots), **options)
    common.announce_compilation()
    folder = out or swarm_folder(request)
    columns = TextColumn("{task.fields[now]}"), TimeRemainingColumn()
    with swarm_reserved(request, folder), common.progress_bar(*columns) as progress:
        bar = progress.add_task(request.title, total=None, now="")

        def show(now_us: int, end_us: int) -> None:
            progress.update(bar, completed=now_us, total=end_us, now=f"{now_us * 1e-6:6.1f} s")

        result = fly_swarm(request, folder, show)
        progress.update(bar, description="writing recordings and reports", total=None, now="")
        for one in result.robots:
            common.write_pictures(one.folder, one.request.experiment)
        write_swarm_report(result)
        common.write_recording(lambda: write_swarm_recording(result))
    print_swarm(result)
    if result.outcome == "interrupted":
        return common.INTERRUPTED
    return 0 if result.passed else 1


def write_swarm_recording(result: SwarmResult) -> None:
    """Write the recording of robots that flew together."""
    from hil.pictures.viewer.swarm import write_swarm_rrd

    write_swarm_rrd(result)


def _flown(folder: Path) -> FlownRun:
    """Return the baseline, read before the flight may replace it."""
    from hil.pictures.compare import load_flown

    with reading(folder):
        return load_flown(folder)


def _left(before: FlownRun, folder: Path, experiment: Experiment) -> int:
    """Print the comparison with the baseline if the flight has left it; return the exit code."""
    from hil.commands.compare import print_comparison
    from hil.laboratory.experiments import finder_of
    from hil.laboratory.metric_pairs import REL
    from hil.pictures.compare import compare, load_flown

    comparison, name = compare(before, now := load_flown(folder, finder_of(experiment))), before.result.folder
    left = [pair.name for pair in comparison.metrics if not pair.within(REL)]
    if before.result.outcome == now.result.outcome and not left:
        say(f"within {100 * REL:g} % of {name}")
        return 0
    print_comparison(name, folder, comparison)
    ended = f"outcome {before.result.outcome} | {now.result.outcome}"
    say(f"left {name} by more than {100 * REL:g} %: {', '.join(left) or ended}")
    return 1


def _check_seeds(seeds: int, request: Request, target: str | None) -> None:
    """Raise `LabError` for a request that can only fly one seed at a time."""
    from hil.pictures.exports.coverage import check_image_coverage

    bench = request.bench
    bench.check_many("--seeds", seeds)
    if target:
        raise LabError(f"--seeds {seeds}: --view: for one flight only")
    if bench.coverage is not None:
        check_image_coverage(bench.coverage, bench.board, bench.elf)


def _fly_one(request: Request, folder: Path, target: str | None) -> int:
    """Fly one seed with all its pictures; return the exit code."""
    from hil.api import maker_of
    from hil.laboratory.run import fly

    view = common.open_live(target)
    bar_wanted = request.bench.gdb is None  # its thread would not survive going back in time
    with common.progress_bar(
        TextColumn("{task.fields[now]}"), TimeRemainingColumn(), wanted=bar_wanted
    ) as progress:
        bar = progress.add_task(f"{request.experiment.name} seed {request.seed}", total=None, now="")
        hands: list[PanelCommands] = []

        def show(now_us: int, flight: Flight) -> None:
            if view is not None and not hands:
                from hil.live.panel_commands import PanelCommands

                hands.append(PanelCommands(view, flight, request.bench.in_lockstep))
            progress.update(bar, completed=now_us, total=flight.end_us, now=f"{now_us * 1e-6:6.1f} s")

        with writing("--out", folder):
            result = fly(request, folder, show, view, maker_of(request))
        progress.update(bar, description="writing recording and report", total=None, now="")
        common.write_pictures(folder, request.experiment)
        if request.bench.trace:
            from hil.pictures.exports.perfetto import write_perfetto

            write_perfetto(folder)
    print_result(result)
    if view is not None and view.address and common.notices.is_terminal:
        warn("the flight can be viewed until Ctrl-C")
        view.stay()
    common.close_live(view, result)
    if result.stood_still_ms:
        say(f"this machine was too slow: time stood still for {result.stood_still_ms:.0f} ms")
    return common.exit_code(result)


def _fly_many(requests: list[Request], options: Options, parent: Path, crew: dict[str, Any]) -> int:
    """Fly seeds in parallel processes; print one row per seed and a summary; return the exit code."""
    from hil.laboratory.files.folder import folder_of, moved
    from hil.research.campaigns.jobs import Job
    from hil.research.campaigns.run import Runner

    placed = [(request, folder_of(request, parent)) for request in requests]
    jobs = [
        Job(0, request.experiment.reference, options | {"seed": request.seed}, {}, folder)
        for request, folder in placed
    ]
    if whys := [why for one in placed if (why := moved(*one))]:
        warn(whys[0] + (f", and so on: {len(whys)} of {len(jobs)}" if whys[1:] else ""))
    name = f"{requests[0].experiment.name}-{requests[0].seed}-{requests[-1].seed}"
    with Runner(common.notices, **crew) as runner:
        rows = runner.fly(name, jobs, parent)
    print_seeds(rows)
    if runner.interrupted:
        warn(f"interrupted: {len(rows)} of {len(requests)} seeds are complete")
        return common.INTERRUPTED
    return 0 if all(row.passed for row in rows) else 1


@click.command("replay")
@common.run_folder
@common.profile_option
@common.set_option
@click.option("--out", type=common.PATH, metavar="DIR", help="Run folder [RUN-replay].")
@common.code_option
def replay_run(
    run: Path, profile: str, overrides: tuple[str, ...], out: Path | None, named: str | None
) -> None:
    """Replay RUN, a simulated flight, through the core of another profile, beside the one that flew, open loop.

    The flight is flown again, bit for bit. The second core gets the same gyro samples, poses and flap commands; its estimate
    and commands are logged as replay.* and shown in the report. Without --profile it has that of the flight.
    """
    from hil.api import load_run
    from hil.config import load_config
    from hil.laboratory.replay import misses, replay

    loaded = load_run(run, named)
    request, folder = loaded.request, out or run.with_name(f"{run.name}-replay")
    usual = click.get_current_context().get_parameter_source("profile") is ParameterSource.DEFAULT
    replayed = load_config(request.profile if usual else profile, (*request.overrides, *overrides))
    require_empty("--out", folder)
    with writing("--out", folder):
        replay(request, loaded.hash, replayed, folder)
        common.write_pictures(folder, request.experiment)
    table = Table("estimate less truth", *common.right("flown", "replayed"), "unit")
    flown, other = misses(folder)
    for what, name, scale, unit in (
        ("position, rms", "position", 100.0, "cm"), ("position, largest", "position_max", 100.0, "cm"),
        ("attitude, rms", "attitude", 180.0 / pi, "deg"), ("attitude, largest", "attitude_max", 180.0 / pi, "deg"),
        ("poses fused", "fused", 1, ""), ("poses refused", "refused", 1, ""),
    ):  # fmt: skip
        table.add_row(what, *(f"{getattr(one, name) * scale:.4g}" for one in (flown, other)), unit)
    common.console.print(table)
    say(f"  {folder / 'report.html'}")


@click.command("debug")
@common.run_folder
@click.option(
    "--at", default="crash", show_default=True, metavar="crash|SECONDS",
    help="The firmware's first failure, or the robot's crash; or a time of the log.",
)  # fmt: skip
@click.option("--before", type=click.FloatRange(0.0, 3600.0), default=1.0, show_default=True, metavar="S",
    help="How long before it the flight waits for GDB [s].",
)  # fmt: skip
@click.option("--port", type=click.IntRange(0, 65535), default=3333, show_default=True, metavar="PORT",
    help="GDB's port on 127.0.0.1; 0: any.",
)  # fmt: skip
@click.option("--out", type=common.PATH, metavar="DIR", help="Run folder [RUN-debug, replaced].")
@common.code_option
def debug_run(run: Path, at: str, before: float, port: int, out: Path | None, named: str | None) -> int:
    """Fly RUN, a flight of an image, again, and wait for GDB shortly before its crash; time also runs backwards there.

    The flight is the same, bit for bit, whatever you look at and however often you go back.
    """
    from hil.api import load_run
    from hil.laboratory.files.debugging import begin_us, debugged_request, waiting_flight
    from hil.laboratory.files.folder import reserved
    from hil.laboratory.run import fly

    flown = load_run(run, named).result
    request, from_us = debugged_request(flown), begin_us(flown, at, before)
    folder = out or run.with_name(f"{run.name}-debug")
    say(f"flying {run} again up to {max(from_us, 0) * 1e-6:.2f} s")
    with reserved(request, folder), writing("--out", folder):
        result = fly(request, folder, flight_of=waiting_flight(port, from_us))
    same = (
        "the same flight"
        if result.hash == flown.hash
        else "not the same flight: it was interrupted or changed"
    )
    say(f"{folder}: hash {result.hash[:16]}, {same}")
    return common.exit_code(result)
