"""The common parts of commands: consoles, exit codes, options, and the notice before a long compilation."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import fields, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn
from rich.table import Column
from rich.text import Text

from ground_station.lines import print_line, visible
from hil.errors import LabError

if TYPE_CHECKING:
    from hil.laboratory.experiment import Experiment
    from hil.laboratory.files.result import Result
    from hil.live.feed import LiveView

INTERRUPTED = 130
option: Any = click.option  # as the default of a field in `asked_as`
argument: Any = click.argument
Asked = TypeVar("Asked")
Command = TypeVar("Command", bound=Callable[..., Any])


class TextConsole(Console):
    """A console that shows control characters in texts as escapes, and raises `OSError` when its output fails."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Render as rich does."""
        return super().render_str("\n".join(map(visible, text.split("\n"))), **options)

    def print(self, *shown: Any, **options: Any) -> None:
        """Print as rich does, but do not keep what could not be printed for the next time."""
        try:
            super().print(*shown, **options)
        except OSError:
            with self.capture():
                pass
            raise

    def on_broken_pipe(self) -> None:
        """Raise the error that rich is handling."""
        raise


console = TextConsole(highlight=False)
notices = TextConsole(stderr=True, highlight=False)


class Number(click.FloatRange):
    """A number within bounds; click's own class lets NaN pass."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number."""
        number: float = super().convert(value, param, ctx)
        if math.isnan(number):
            self.fail(f"{number} is not in the range {self._describe_range()}.", param, ctx)
        return number


PATH, FILE = click.Path(path_type=Path), click.Path(path_type=Path, dir_okay=False)


def wide_console(width: int = 150) -> Console:
    """Return the console for a table of a fixed width, in any terminal."""
    return TextConsole(highlight=False, width=max(console.width, width))


def right(*headings: str) -> list[Column]:
    """Return the columns of a table whose cells are numbers."""
    return [Column(escape(heading), justify="right") for heading in headings]


code_option = click.option(
    "--experiment", "named", metavar="FILE.py:NAME",
    help="Execute the code of the flown experiment, for its own picture, metrics and kinds of faults. Without this option "
    "nothing is executed that a run folder names.",
)  # fmt: skip
run_folder = click.argument("run", metavar="RUN", type=PATH)
seed_option = click.option(
    "--seed", type=click.IntRange(0, 2**62), default=1, show_default=True, help="Seed of all random numbers."
)
duration_option = click.option(
    "--duration", "duration_s", type=float, metavar="S", help="Free flight [s]; default: the experiment's."
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
    "--view", "target", is_flag=False, flag_value="window", metavar="[web|connect:HOST:PORT|foxglove[:parameters]]",
    help="Watch live: in the rerun viewer, in a browser, in a viewer that is open somewhere, in Foxglove, which with "
    ":parameters also changes those of the board.",
)  # fmt: skip
elf_option = click.option(
    "--elf", type=PATH, metavar="FILE",
    help="With a .bin or a release's zip as --board: the ELF that it was made from, which names tasks, functions and lines.",
)  # fmt: skip
gdb_option = click.option(
    "--gdb", type=click.IntRange(0, 65535), metavar="PORT",
    help="With an image as --board: wait for GDB on this port of 127.0.0.1 (0: any); time stands still at its breakpoints.",
)  # fmt: skip
coverage_option = click.option(
    "--coverage", type=PATH, metavar="OUT",
    help="With an image as --board: add which of its functions, lines and branches ran to OUT.info (lcov) and OUT.html.",
)  # fmt: skip


def profile_options(command: Command) -> Command:
    """Add --profile and --set."""
    return profile_option(set_option(command))


def runner_options(command: Command) -> Command:
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


def print_coverage(out: Path) -> None:
    """Write the files of --coverage from what was added, and print their totals."""
    from hil.pictures.exports.coverage import write_coverage

    shares, info, page = write_coverage(out)
    say(f"coverage: {shares}")
    say(f"  {info}")
    say(f"  {page}")


COMPILING = "first run on this machine: compiling flight core and plant, once, some seconds"


def common_option(option: Callable[[Any], Any]) -> Any:
    """Return an option of several commands as the default of a field in `asked_as`."""
    return option


def asked_as(kind: type[Asked]) -> Callable[[Callable[..., int | None]], Callable[..., int | None]]:
    """Return the decorator that passes a command's options as one frozen dataclass.

    A field whose default is an `option` or an `argument` adds it to the command.
    """

    def decorator(command: Callable[..., int | None]) -> Callable[..., int | None]:
        @wraps(command)
        def call(*context: click.Context, **options: Any) -> int | None:
            return command(*context, kind(**options))

        for one in reversed(fields(kind)):  # type: ignore[arg-type]
            if callable(one.default):
                call = one.default(call)
        return call

    return decorator


def check_profile(option: str, path: Path | None) -> None:
    """Refuse what no profile can be written to, before anything is flown or computed."""
    if path is not None and path.suffix != ".toml":
        raise LabError(f"{option} {path}: a profile's name ends in .toml")
    if path is not None and not path.parent.is_dir():
        raise LabError(f"{option} {path}: cannot be written ({path.parent} is not a folder)")


def check_alone(overrides: Iterable[str], several: str) -> None:
    """Refuse settings of a swarm for one robot; `several` says how more of them fly."""
    for override in overrides:
        if override.startswith("swarm."):
            raise LabError(f"--set {override}: has no effect on one robot; {several}")


def announce_compilation() -> None:
    """Announce that the first run compiles, which takes a while."""
    from firmware_py.compiling import must_compile
    from hil.board.imu import channels

    if must_compile(channels):
        warn(COMPILING)


def say(text: object) -> None:
    """Print a line and flush it: a program may read it."""
    print_line(text)


def warn(text: str) -> None:
    """Print a line on standard error."""
    print_line(text, sys.stderr)


def progress_bar(*columns: ProgressColumn, wanted: bool = True) -> Progress:
    """Return a progress bar on standard error with more columns, invisible without a terminal."""
    shown = (TextColumn("{task.description}"), BarColumn(), *columns)
    return Progress(*shown, console=notices, transient=True, disable=not (wanted and notices.is_terminal))


@contextmanager
def progress_of_steps(*columns: ProgressColumn) -> Iterator[Callable[[str, int, int], None]]:
    """Show the progress of work that reports it as (what, done, total)."""
    with progress_bar(*columns) as progress:
        bar = progress.add_task("", total=None)
        yield lambda what, done, total: progress.update(bar, description=what, completed=done, total=total)


def exit_code(result: Result) -> int:
    """Return a flight's exit code."""
    return INTERRUPTED if result.outcome == "interrupted" else 0 if result.passed else 1


def open_live(target: str | None, say: Callable[[str], None] = say) -> LiveView | None:
    """Open the picture of `--view`; it always closes with the command. `say` gets lines for the user."""
    if target is None:
        return None
    from hil.live.feed import open_view

    context = click.get_current_context()
    return context.with_resource(closing(open_view(target, str(context.info_name), say)))


def close_live(view: LiveView | None, result: Result | None = None, say: Callable[[str], None] = say) -> None:
    """Close the picture, and record and report the rows that it missed."""
    if view is None:
        return
    from hil.laboratory.files.result import write_result
    from hil.live.feed import missed_text

    missed = view.close()
    if result is not None:
        write_result(replace(result, not_shown=missed))
    if missed:
        say(missed_text(missed) + ("; the log contains them all" if result is not None else ""))


def write_pictures(folder: Path, experiment: Experiment) -> None:
    """Write report and recording; without rerun only the report: the log allows a recording later."""
    from hil.pictures.report import write_report

    def write() -> None:
        from hil.pictures.viewer.recording import write_run_rrd

        write_run_rrd(folder)

    write_report(folder, experiment)
    write_recording(write)


def write_recording(write: Callable[[], None]) -> None:
    """Write a recording; report if it is impossible."""
    try:
        write()
    except LabError as error:
        warn(f"floaty: no recording: {error}")
