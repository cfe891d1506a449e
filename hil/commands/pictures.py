"""`floaty view | report`: what a run looks like."""

from pathlib import Path

import click

from hil.commands.options import console, run_folder


@click.command()
@run_folder
def view(run: Path) -> None:
    """Open RUN, a run folder, in the rerun viewer."""
    from hil.live.window import show_file
    from hil.pictures.viewer import RECORDING, write_run_rrd

    path = run / RECORDING
    if not path.is_file():
        write_run_rrd(run)
    show_file(path)


@click.command()
@run_folder
def report(run: Path) -> None:
    """Write the report of RUN, a run folder, again."""
    from hil.pictures.report import write_report

    console.print(f"report  {write_report(run)}")
