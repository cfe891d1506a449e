"""`floaty view | report | export`: the pictures of a run, and its export for other programs."""

from pathlib import Path

import click

from hil.commands.options import console, run_folder, say
from hil.errors import LabError
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

    if target == "web":
        browse(run, at_s or 0.0, say)
    elif at_s is not None:
        show_at(run, at_s)
    else:
        show(str(recording_of(run)))


@click.command()
@run_folder
def report(run: Path) -> None:
    """Write the report of RUN, a run folder, again."""
    from hil.pictures.report import write_report

    console.print(f"report  {write_report(run)}")


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
    if not (as_csv or as_mcap or as_tlog or as_video or as_gif):
        raise LabError(f"export {run}: no format given: --csv, --mcap, --tlog, --video, --gif")
    if as_csv:
        from hil.exports.wide_csv import write_csv

        console.print(f"  {write_csv(run)}", soft_wrap=True)
    if as_mcap:
        from hil.exports.mcap import write_mcap

        console.print(f"  {write_mcap(run)}", soft_wrap=True)
    if as_tlog:
        from hil.exports.tlog import write_tlog

        console.print(f"  {write_tlog(run)}", soft_wrap=True)
    if as_video:
        from hil.pictures.video import write_video

        console.print(f"  {write_video(run)}", soft_wrap=True)
    if as_gif:
        from hil.pictures.video import write_gif

        console.print(f"  {write_gif(run)}", soft_wrap=True)
