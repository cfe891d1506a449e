"""What several commands share: consoles, exit codes, options, and the word before a long compilation."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console

from hil.errors import LabError

if TYPE_CHECKING:
    from hil.laboratory.experiment import Experiment

INTERRUPTED = 130

console = Console(highlight=False)
notices = Console(stderr=True, highlight=False)

run_folder = click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
seed_option = click.option(
    "--seed", type=click.IntRange(0, 2**62), default=1, show_default=True, help="Of everything random."
)
fault_option = click.option(
    "--fault", "fault_texts", multiple=True, metavar="KIND@START[:DURATION][=SIZE]",
    help="Let something go wrong, START seconds after the release; repeatable. `floaty list --faults` has the kinds.",
)  # fmt: skip
profile_option = click.option(
    "--profile",
    default="floaty",
    show_default=True,
    metavar="NAME|FILE",
    help="A profile that ships, or a TOML file.",
)
set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="SECTION.KEY=VALUE",
    help="Override a value of the profile; repeatable.",
)


def announce_compilation() -> None:
    """Say that the first run compiles, because it takes a while."""
    from firmware_py.compiling import is_kept
    from hil.world.motion import advance

    if not is_kept(advance):
        notices.print("first run on this machine: compiling flight core and plant, once, some ten seconds")


def say(text: str) -> None:
    """Print a line, at once: who reads it may be a program."""
    print(text)
    sys.stdout.flush()


def stop_signals() -> list[int]:
    """Return a list that gets the signals which ask for an orderly end."""
    stops: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _: stops.append(received))
    return stops


def write_pictures(folder: Path, experiment: Experiment) -> None:
    """Write recording and report; what cannot be written is said, for the log is there and can be shown later."""
    try:
        from hil.pictures.viewer import write_run_rrd

        write_run_rrd(folder)
    except LabError as error:
        notices.print(f"floaty: no recording: {error}", soft_wrap=True)
    from hil.pictures.report import write_report

    write_report(folder, experiment)
