"""The command line: `floaty fly | list | view | report | drag-model`.

Bad input ends in one line on standard error and exit code 2; a failed limit in 1; Ctrl-C in 130 with the log kept.
"""

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console

from hil.board_cli import board, station
from hil.deploy_cli import deploy
from hil.errors import LabError
from hil.lab_cli import lab
from hil.options import profile_option, set_option
from hil.paper_cli import compare, paper, study

if TYPE_CHECKING:
    from hil.harness import Flight
    from hil.linked_flight import LinkedFlight
    from hil.run import Request, Result
    from hil.viewer import LiveViewer

INTERRUPTED = 130
DURATION_MAX_S = 86_400.0
SEEDS_MAX = 10_000

console = Console(highlight=False)
notices = Console(stderr=True, highlight=False)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="floaty-hil", prog_name="floaty")
def app() -> None:
    """Floaty virtual laboratory: firmware, ground station and wind tunnel, joined by real bytes."""


run_folder = click.argument("run", metavar="RUN", type=click.Path(path_type=Path))


@app.command()
@click.argument("experiment")
@click.option(
    "--seed", type=click.IntRange(0, 2**63 - 1), default=1, show_default=True, help="Of everything random."
)
@click.option(
    "--seeds", type=click.IntRange(1, SEEDS_MAX), default=1, metavar="N",
    help="Fly N seeds from --seed on, in parallel; logs without pictures.",
)  # fmt: skip
@click.option("--duration", type=float, metavar="S", help="Free flight [s]; default: the experiment's.")
@profile_option
@set_option
@click.option(
    "--fault", "fault_texts", multiple=True, metavar="KIND@START[:DURATION][=SIZE]",
    help="Let something go wrong, START seconds after the release; repeatable. `floaty list --faults` has the kinds.",
)  # fmt: skip
@click.option("--realtime", is_flag=True, help="Pace the flight to the wall clock.")
@click.option("--view", "watch", is_flag=True, help="Watch live in the rerun viewer.")
@click.option("--perfetto", is_flag=True, help="Trace the scheduler and write flight.perfetto-trace.")
@click.option(
    "--link", metavar="LINK", default="radio", show_default=True,
    help="radio or mavlink: in lockstep; radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:PORT or mavlink:/dev/NAME: over "
    "cflib or a serial port, in real time, the ground station in a process of its own.",
)  # fmt: skip
@click.option(
    "--mocap", metavar="SYSTEM",
    help="Where the ground station of a flight in real time has its poses from: natnet, a virtual Motive (the default), "
    "or virtual, the cameras without Motive.",
)  # fmt: skip
@click.option(
    "--board", metavar="BOARD", default="python", show_default=True,
    help="What executes the flight core: python, c (its exported C) or cortex-m4 (its machine code, emulated).",
)  # fmt: skip
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="DIR", help="Run folder [runs/EXPERIMENT-SEED]."
)
def fly(
    experiment: str,
    seed: int,
    seeds: int,
    duration: float | None,
    profile: str,
    overrides: tuple[str, ...],
    fault_texts: tuple[str, ...],
    realtime: bool,
    watch: bool,
    perfetto: bool,
    link: str,
    mocap: str | None,
    board: str,
    out: Path | None,
) -> int:
    """Fly EXPERIMENT (see `floaty list`) in the virtual laboratory.

    Exit code 0: all limits hold; 1: a limit fails; 2: bad input; 130: interrupted.
    """
    from hil.experiments import find_experiment

    chosen = find_experiment(experiment)
    flown_s = chosen.duration_s if duration is None else duration
    if not 0.0 < flown_s <= DURATION_MAX_S:
        raise LabError(f"--duration {flown_s:g}: expected seconds, above 0 and up to {DURATION_MAX_S:g}")
    if seeds > 1 and (realtime or watch or perfetto):
        raise LabError(f"--seeds {seeds}: --realtime, --view and --perfetto are for one seed")
    if perfetto:
        import hil.perfetto  # noqa: F401 - says now, not after the flight, when its package is missing
    from hil.faults import parse
    from hil.run import Request

    faults = [parse(text) for text in fault_texts]
    requests = [
        Request.of(chosen, profile, overrides, seed + index, flown_s, link, faults, board, mocap)
        for index in range(seeds)
    ]
    announce_compilation()
    if (seeds > 1 or perfetto) and not requests[0].in_lockstep:
        raise LabError(f"--link {link}: --seeds and --perfetto are for flights in lockstep")
    if seeds > 1:
        return _fly_many(requests, out or Path("runs"))
    folder = out or Path("runs") / f"{chosen.name}-{seed}"
    return _fly_one(requests[0], folder, realtime, watch, perfetto)


@app.command("list")
@click.option("--faults", is_flag=True, help="List the kinds of faults for `floaty fly --fault`.")
def list_experiments(faults: bool) -> None:
    """List the experiments, the robustness studies and the profiles, or the kinds of faults."""
    if faults:
        return _list_faults()
    from hil.config import DEFAULT_PROFILE, profile_names
    from hil.experiments import EXPERIMENTS
    from hil.studies import STUDIES

    width = max(map(len, EXPERIMENTS))
    for experiment in EXPERIMENTS.values():
        console.print(f"{experiment.name:{width}}  {experiment.summary}", soft_wrap=True)
    bench = "forces and torques on the mounted robot over flap angles; not a flight: `floaty drag-model`"
    console.print(f"{'drag-model':{width}}  {bench}", soft_wrap=True)
    console.print("\nrobustness, for `floaty study`:")
    for one in STUDIES.values():
        console.print(f"{one.name:{width}}  {one.question}", soft_wrap=True)
    names = (f"{name} (default)" if name == DEFAULT_PROFILE else name for name in profile_names())
    console.print(f"\nprofiles: {', '.join(names)}")
    console.print("faults: floaty list --faults")


def _list_faults() -> None:
    from rich.table import Table

    from hil.fault_kinds import KINDS

    table = Table(box=None, pad_edge=False)
    for heading in ("kind", "size", "from..to", "lasts", "hover"):
        table.add_column(heading, no_wrap=True)
    table.add_column("meaning")
    for name, kind in KINDS.items():
        unit = f" {kind.unit}".rstrip()
        size, bounds = (f"{kind.size:g}{unit}", f"{kind.low:g}..{kind.high:g}") if kind.sized else ("", "")
        lasts = f"{kind.duration_s:g} s" if math.isfinite(kind.duration_s) else "to the end"
        only = f" ({kind.needs})" if kind.needs else ""
        table.add_row(name, size, bounds, lasts, kind.outcome, f"{kind.meaning}{only}")
    Console(highlight=False, width=max(console.width, 150)).print(table)


@app.command()
@run_folder
def view(run: Path) -> None:
    """Open RUN, a run folder, in the rerun viewer."""
    from hil.viewer import view_run

    view_run(run)


@app.command()
@run_folder
def report(run: Path) -> None:
    """Write the report of RUN, a run folder, again."""
    from hil.report import write_report

    console.print(f"report  {write_report(run)}")


@app.command("drag-model")
@click.option(
    "--seed", type=click.IntRange(0, 2**63 - 1), default=1, show_default=True, help="Of everything random."
)
@profile_option
@set_option
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("runs/drag-model"),
    show_default=True,
    metavar="DIR",
)
def drag_model(seed: int, profile: str, overrides: tuple[str, ...], out: Path) -> None:
    """Measure forces and torques on the mounted robot over flap angles, against the paper's simplified model."""
    from rich.progress import track

    from hil import drag_model, drag_model_report
    from hil.config import load_config

    config = load_config(profile, overrides)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LabError(f"--out {out}: cannot be written ({error.strerror or error})") from None
    announce_compilation()
    measured = drag_model.measure(config, seed)
    rows = list(track(measured, "mounted robot", drag_model.ROWS, console=notices, transient=True))
    drag_model.write_csv(rows, out / "drag_model.csv")
    page = drag_model_report.write(rows, math.degrees(config.plant.hover_angle), out)
    console.print(f"report  {page}")


def announce_compilation() -> None:
    """Say that the first run compiles, because it takes a while."""
    from firmware_py.compiling import is_kept
    from hil.plant.motion import advance

    if not is_kept(advance):
        notices.print("first run on this machine: compiling flight core and plant, once, some ten seconds")


def _fly_one(request: "Request", folder: Path, realtime: bool, watch: bool, perfetto: bool) -> int:
    """Fly one seed with all its pictures; returns the exit code."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from hil.clock import FreeRunning, Paced
    from hil.run import fly, prepare

    prepare(folder)
    viewer = _live_viewer(folder) if watch else None
    clock = Paced() if realtime else FreeRunning()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[now]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=notices, transient=True, disable=not notices.is_terminal) as progress:
        bar = progress.add_task(f"{request.experiment.name} seed {request.seed}", total=None, now="")

        def show(now_us: int, flight: "Flight | LinkedFlight") -> None:
            progress.update(bar, completed=now_us, total=flight.end_us, now=f"{now_us * 1e-6:6.1f} s")

        result = fly(request, folder, clock, show, viewer.send if viewer else None, perfetto)
        progress.update(bar, description="writing recording and report", total=None, now="")
        _write_pictures(folder)
        if perfetto:
            from hil.perfetto import write_perfetto

            write_perfetto(folder)
        missed = viewer.close() if viewer else 0
    _print_result(result)
    if missed:
        console.print(
            f"the live viewer was too slow for {missed} of the flight's seconds; the recording has them all"
        )
    if result.stood_still_us:
        console.print(
            f"this machine was too slow: time stood still for {result.stood_still_us / 1000:.0f} ms"
        )
    if result.outcome == "interrupted":
        return INTERRUPTED
    return 0 if result.passed else 1


def _live_viewer(folder: Path) -> "LiveViewer":
    """Open the live viewer."""
    from hil.viewer import LiveViewer

    return LiveViewer(folder)


def _write_pictures(folder: Path) -> None:
    """Write recording and report; what cannot be written is said, for the log is there and can be shown later."""
    try:
        from hil.viewer import write_run_rrd

        write_run_rrd(folder)
    except LabError as error:
        notices.print(f"floaty: no recording: {error}", soft_wrap=True)
    from hil.report import write_report

    write_report(folder)


def _fly_many(requests: "list[Request]", parent: Path) -> int:
    """Fly seeds in parallel processes; one row per seed, a summary at the end; returns the exit code."""
    from hil.sweep import Job, fly_all

    jobs = [Job(request, parent / f"{request.experiment.name}-{request.seed}") for request in requests]
    rows, interrupted = fly_all(jobs, notices)
    _print_seeds(rows)
    if interrupted:
        notices.print(f"interrupted: {len(rows)} of {len(requests)} seeds are complete")
        return INTERRUPTED
    return 0 if all(result.passed for result in rows) else 1


SEED_COLUMNS = (
    ("rms x y z [cm]", ("rms_x", "rms_y", "rms_z"), 100.0, 2),
    ("max x y z [cm]", ("max_x", "max_y", "max_z"), 100.0, 1),
    ("< 6 cm x y z [%]", ("within_6cm_x", "within_6cm_y", "within_6cm_z"), 100.0, 1),
    ("in box [%]", ("in_box",), 100.0, 1),
    ("attitude max [deg]", ("attitude_max",), math.degrees(1.0), 1),
)


def _print_seeds(rows: "list[Result]") -> None:
    """Print one row per seed and the summary."""
    from rich.table import Table

    if not rows:
        return
    table = Table(title=f"{rows[0].request.experiment.name}, profile {rows[0].request.profile}")
    for heading in ("seed", *(column[0] for column in SEED_COLUMNS), "hash", "verdict"):
        table.add_column(heading, justify="right")
    for result in rows:
        failed = ", ".join(verdict.metric for verdict in result.verdicts if not verdict.holds)
        verdict = "ok" if result.passed else result.cause or f"fails: {failed}"
        table.add_row(
            str(result.request.seed),
            *(
                " ".join(f"{result.metrics[name] * scale:.{digits}f}" for name in names)
                for _, names, scale, digits in SEED_COLUMNS
            ),
            result.hash[:12],
            verdict,
        )
    wide = Console(highlight=False, width=max(console.width, 140))
    wide.print(table)
    completed = [result.metrics for result in rows if result.outcome == "completed"]
    lost = sum(result.outcome == "lost" for result in rows)
    passed = sum(result.passed for result in rows)
    console.print(f"{len(rows)} seeds: {passed} hold all limits, {lost} lost")
    if completed:
        shares, rms = (
            " ".join(
                f"{axis} {100.0 * sum(metrics[name + axis] for metrics in completed) / len(completed):.{digits}f}"
                for axis in "xyz"
            )
            for name, digits in (("within_6cm_", 1), ("rms_", 2))
        )
        console.print(f"mean of the completed: rms {rms} cm; < 6 cm {shares} % of the time", soft_wrap=True)


def _print_result(result: "Result") -> None:
    """Print the verdicts of one flight and where to look."""
    from rich.table import Table

    from ground_station.latency import budget_line
    from hil.metrics import METRICS

    request = result.request
    table = Table(title=f"{request.experiment.name}, seed {request.seed}, profile {request.profile}")
    table.add_column("metric")
    for heading in ("value", "limit", "verdict"):
        table.add_column(heading, justify="right")
    verdicts = {verdict.metric: verdict for verdict in result.verdicts}
    for name, value in result.metrics.items():
        if math.isnan(value) and name not in verdicts:
            continue
        metric = METRICS[name]
        limit = mark = ""
        if name in verdicts:
            limit = f"{'<=' if metric.bound == 'max' else '>='} {metric.show(verdicts[name].bound)}"
            mark = "ok" if verdicts[name].holds else "FAILS"
        table.add_row(name, metric.show(value), limit, mark)
    console.print(table)
    cause = f": {result.cause}" if result.cause else ""
    console.print(
        f"{result.outcome}{cause}; {result.real_time_factor:.0f} times real time; hash {result.hash[:16]}"
    )
    if result.ages:
        console.print(budget_line(result.ages), soft_wrap=True)
    if result.usage is not None:
        for name, load in result.usage.entries.items():
            console.print(f"  {request.board} {name:9} {load}", soft_wrap=True)
    for name in ("report.html", "flight.rrd", "flight.perfetto-trace", "log.parquet"):
        if (result.folder / name).is_file():
            hint = f"   (floaty view {result.folder})" if name == "flight.rrd" else ""
            console.print(f"  {result.folder / name}{hint}", soft_wrap=True)


def main() -> None:
    """Run the command line and leave with its exit code."""
    try:
        code = app.main(standalone_mode=False)
    except LabError as error:
        sys.exit(_refuse(str(error)))
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message(), file=sys.stderr)
        sys.exit(2)
    except click.ClickException as error:
        sys.exit(_refuse(error.format_message()))
    except (click.Abort, KeyboardInterrupt):
        sys.exit(INTERRUPTED)
    sys.exit(code if isinstance(code, int) else 0)


def _refuse(text: str) -> int:
    print("floaty:", " ".join(text.split()), file=sys.stderr)
    return 2


app.add_command(board)
app.add_command(lab)
app.add_command(station)
app.add_command(compare)
app.add_command(deploy)
app.add_command(paper)
app.add_command(study)

if __name__ == "__main__":
    main()
