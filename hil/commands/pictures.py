"""`floaty view | report`: what a run looks like."""

from pathlib import Path

import click

from hil.commands.options import console, run_folder


@click.command()
@run_folder
def view(run: Path) -> None:
    """Open RUN, a run folder, in the rerun viewer."""
    from hil.pictures.viewer import view_run

    view_run(run)


@click.command()
@run_folder
def report(run: Path) -> None:
    """Write the report of RUN, a run folder, again."""
    from hil.pictures.report import write_report

    console.print(f"report  {write_report(run)}")
