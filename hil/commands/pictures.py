"""`floaty view | report | export`: the pictures of a run, and its export for other programs."""

from importlib import import_module
from pathlib import Path

import click

from hil.commands.options import code_option, run_folder, say
from hil.errors import LabError, reading, writing
from hil.live.window import show


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
