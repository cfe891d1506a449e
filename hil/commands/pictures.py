"""`floaty view | report | export | import`: the pictures of a run, its export for other programs, and foreign logs."""

from importlib import import_module
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.markup import escape
from rich.table import Table

from hil.commands.options import FILE, PATH, code_option, right, run_folder, say, warn, wide_console
from hil.errors import LabError, reading, require_empty, writing
from hil.live.window import show

if TYPE_CHECKING:
    from hil.laboratory.files.imported import Imported


@click.command()
@run_folder
@click.option(
    "--at", "at_s", type=float, metavar="S", help="With the time at an instant, seconds from the release."
)
@click.option(
    "--view", "target", type=click.Choice(["window", "web"]), default="window", show_default=True,
    help="web: in a browser; meanwhile the links of the run's report lead there.",
)  # fmt: skip
def view(run: Path, at_s: float | None, target: str) -> None:
    """Open RUN, a run folder, in the rerun viewer."""
    from hil.live.recording import browse, show_at
    from hil.pictures.viewer.recording import recording_of

    with writing("RUN", run), reading(run):
        if target == "web":
            browse(run, at_s or 0.0, say)
        elif at_s is not None:
            show_at(run, at_s)
        else:
            show(str(recording_of(run)))


@click.command()
@run_folder
@code_option
def report(run: Path, named: str | None) -> None:
    """Write the report of RUN, a run folder, again."""
    from hil.api import load_run

    with writing("RUN", run), reading(run):
        page = load_run(run, named).write_report()
    say(f"report  {page}")


@click.command()
@run_folder
@click.option("--csv", "as_csv", is_flag=True, help="flight.csv: one wide table, units in the header.")
@click.option("--mcap", "as_mcap", is_flag=True, help="flight.mcap: for Foxglove and PlotJuggler.")
@click.option(
    "--tlog", "as_tlog", is_flag=True, help="flight.tlog: MAVLink, for ground stations and pymavlink."
)
@click.option("--video", "as_video", is_flag=True, help="flight.mp4: scene and curves, 30 frames per second.")
@click.option("--gif", "as_gif", is_flag=True, help="flight.gif: the same for a page; at most a minute.")
def export(run: Path, as_csv: bool, as_mcap: bool, as_tlog: bool, as_video: bool, as_gif: bool) -> None:
    """Write RUN, a run folder, in other formats, beside its log."""
    wanted = {
        "pictures.exports.wide_csv.write_csv": as_csv,
        "pictures.exports.mcap.write_mcap": as_mcap,
        "pictures.exports.tlog.write_tlog": as_tlog,
        "pictures.video.write_video": as_video,
        "pictures.video.write_gif": as_gif,
    }
    if not any(wanted.values()):
        raise LabError(f"export {run}: no format given: --csv, --mcap, --tlog, --video, --gif")
    for place in (place for place, chosen in wanted.items() if chosen):
        module, _, write = place.rpartition(".")
        with writing("RUN", run), reading(run):
            file = getattr(import_module(f"hil.{module}"), write)(run)
        say(f"  {file}")


@click.command("import")
@click.argument("files", metavar="FILE...", type=FILE, nargs=-1, required=True)
@click.option(
    "--map", "chosen", metavar="MAP.toml", type=FILE, help="Which column of the file gives which of the log."
)
@click.option(
    "--like", type=PATH, metavar="RUN", help="Set the release where the path fits that of RUN best."
)
@click.option("--out", type=PATH, metavar="DIR", help="Run folder [runs/NAME of the first file].")
def import_(files: tuple[Path, ...], chosen: Path | None, like: Path | None, out: Path | None) -> None:
    """Make a run folder of a foreign log: CSV, Parquet, MCAP, a tlog, or a Crazyflie's micro-SD file.

    Columns and units are guessed from their names, shown, and stored in map.toml of the run folder: correct a copy and
    import again with --map. Files with clocks of their own are joined on the rows of the first one. What is missing is
    unknown. The run can be reported, compared, viewed and exported like a real flight.
    """
    from hil.api import Run
    from hil.laboratory.files.imported import import_log
    from hil.laboratory.files.log_map import Map
    from hil.laboratory.files.recorder import load_log

    given = None if chosen is None else Map.read(chosen)
    folder = out or Path("runs") / files[0].stem
    require_empty("--out", folder)
    with writing("--out", folder):
        done = import_log(files, folder, given, None if like is None else load_log(like))
        _print_map(done)
        for note in done.notes:
            warn(note)
        say(f"  {Run(done.result).write_report()}")


def _print_map(done: "Imported") -> None:
    log, table = done.log, Table("column", "from", *right("least", "largest"), "unit")
    for name, source in done.map.columns.items():
        if str(source).partition(" [")[0] == name:
            continue  # it keeps its name
        known, unit = [], ""
        if name in log.column_names:
            known = [value for value in log.column(name).to_pylist() if isfinite(value)]
            unit = log.schema.field(name).metadata[b"unit"].decode()
        least, largest = (f"{value:.4g}" for value in (min(known, default=nan), max(known, default=nan)))
        table.add_row(name, escape(str(source)), least if known else "", largest if known else "", unit)
    wide_console(120).print(table)
    seconds = 1e-6 * (log.column("t")[-1].as_py() - log.column("t")[0].as_py())
    say(
        f"{log.num_rows} rows, {seconds:.3f} s, profile {done.map.profile}; to correct it: --map, a copy of map.toml"
    )
