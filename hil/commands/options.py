"""The common parts of commands: consoles, exit codes, options, and the notice before a long compilation."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn

from hil.errors import LabError

if TYPE_CHECKING:
    from hil.laboratory.experiment import Experiment
    from hil.laboratory.result import Result
    from hil.live.feed import LiveView

INTERRUPTED = 130
Asked = TypeVar("Asked")

console = Console(highlight=False)
notices = Console(stderr=True, highlight=False)


def wide_console(width: int = 150) -> Console:
    """Return the console for a table of a fixed width, in any terminal."""
    return Console(highlight=False, width=max(console.width, width))


run_folder = click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
seed_option = click.option(
    "--seed", type=click.IntRange(0, 2**62), default=1, show_default=True, help="Seed of all random numbers."
)
fault_option = click.option(
    "--fault", "faults", multiple=True, metavar="KIND@START[:DURATION][=SIZE]",
    help="Inject a fault START seconds after the release; repeatable. `floaty list --faults` lists the kinds.",
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


view_option = click.option(
    "--view", "target", is_flag=False, flag_value="window", metavar="[web|connect:HOST:PORT|foxglove]",
    help="Watch live: in the rerun viewer, in a browser, in a viewer that is open somewhere, in Foxglove.",
)  # fmt: skip


gdb_option = click.option(
    "--gdb", type=click.IntRange(0, 65535), metavar="PORT",
    help="With an image as --board: wait for GDB on this port of 127.0.0.1 (0: any); time stands still at its breakpoints.",
)  # fmt: skip


def runner_options(command: Callable[..., int]) -> Callable[..., int]:
    """Add the options of a command that flies many flights."""
    for option in (
        click.option("--resume", is_flag=True, help="Continue what was begun in the folder; no flight is flown twice."),
        click.option(
            "--cluster", default="", metavar="tcp://HOST:PORT", help="A Dask scheduler whose workers fly instead."
        ),
        click.option(
            "--workers", type=click.IntRange(1, 1024), metavar="N", help="Processes here; default: one per core."
        ),
    ):  # fmt: skip
        command = option(command)
    return command


COMPILING = "first run on this machine: compiling flight core and plant, once, some ten seconds"


def asked_as(kind: type[Asked]) -> Callable[[Callable[..., int | None]], Callable[..., int | None]]:
    """Return the decorator that passes a command's options as one frozen dataclass."""

    def decorator(command: Callable[..., int | None]) -> Callable[..., int | None]:
        @wraps(command)
        def call(*context: click.Context, **options: Any) -> int | None:
            return command(*context, kind(**options))

        return call

    return decorator


def announce_compilation() -> None:
    """Announce that the first run compiles, which takes a while."""
    from firmware_py.compiling import is_kept
    from hil.devices.imu import channels

    if not is_kept(channels):
        notices.print(COMPILING, soft_wrap=True)


def say(text: str) -> None:
    """Print a line and flush it: a program may read it."""
    print(text)
    sys.stdout.flush()


def progress_bar(*columns: ProgressColumn) -> Progress:
    """Return a progress bar on standard error with more columns, invisible without a terminal."""
    shown = (TextColumn("{task.description}"), BarColumn(), *columns)
    return Progress(*shown, console=notices, transient=True, disable=not notices.is_terminal)


def stop_signals() -> list[int]:
    """Return a list that receives the signals for an orderly end."""
    stops: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _: stops.append(received))
    return stops


def open_live(target: str | None) -> LiveView | None:
    """Open the picture of `--view`; it always closes with the command."""
    if target is None:
        return None
    from hil.live.feed import open_view

    context = click.get_current_context()
    return context.with_resource(closing(open_view(target, str(context.info_name), say)))


def close_live(view: LiveView | None, result: Result | None = None) -> None:
    """Close the picture, and record and report the rows that it missed."""
    if view is None:
        return
    from hil.laboratory.result import write_result
    from hil.live.feed import missed_text

    missed = view.close()
    if result is not None:
        write_result(replace(result, not_shown=missed))
    if missed:
        say(missed_text(missed) + ("; the log contains them all" if result is not None else ""))


def write_pictures(folder: Path, experiment: Experiment) -> None:
    """Write report and recording; without rerun only the report: the log allows a recording later."""
    from hil.pictures.report import write_report

    write_report(folder, experiment)
    try:
        from hil.pictures.viewer.recording import write_run_rrd

        write_run_rrd(folder)
    except LabError as error:
        notices.print(f"floaty: no recording: {error}", soft_wrap=True)
