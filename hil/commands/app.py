"""`floaty`: the command group.

Bad input ends in one line on standard error, of a refused file one for each refusal, and exit code 2; a failed limit in
1; Ctrl-C, SIGTERM and SIGHUP in 130 with the log kept.
"""

import atexit
import gc
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any, TextIO

import click

from firmware_py.extras import why_missing
from ground_station.stops import stopped_like_ctrl_c
from hil.commands.options import INTERRUPTED, warn
from hil.errors import LabError, OutputError, hint
from hil.laboratory.files.installation import describe

# File and function of each command.
COMMANDS = {
    "fly": "fly.fly",
    "new": "new.new",
    "docs": "listing.docs",
    "policy": "new.policy",
    "check": "new.check",
    "list": "listing.list_experiments",
    "runs": "listing.runs",
    "view": "pictures.view",
    "report": "pictures.report",
    "export": "pictures.export",
    "import": "pictures.import_",
    "replay": "fly.replay_run",
    "debug": "fly.debug_run",
    "serve": "serve.serve",
    "station": "station.station",
    "param": "param.param",
    "compare": "compare.compare",
    "paper": "paper.paper",
    "study": "paper.study",
    "identify": "identify.identify",
    "tune": "identify.tune",
    "drag-model": "paper.drag_model",
    "design": "design.design",
    "campaign": "campaign.campaign",
    "deploy": "deploy.deploy",
    "board": "deploy.board",
}


# The help lists the commands in this order; those that are not here, last.
GROUPS = {
    "Every day": "fly list report view runs compare export import new check docs",
    "Programs and real flights": "serve station param",
    "Boards": "deploy board policy debug",
    "Studies": "replay paper study campaign identify tune design drag-model",
}
NAMED_BY_LIST = ("fly", "study")  # commands whose argument `floaty list` names


# Replacements of removed options and commands.
MOVED = {
    "deploy export": "floaty deploy write DIR",
    "--baud": "--set serial.baud=N",
    "--natnet": "--set capture.natnet=3.1",
    "--natnet-port": "--set capture.port=PORT",
    "--multicast": "--set capture.multicast=true",
    "--up": "--set capture.axes=z-up",
    "--trajectory": "floaty station EXPERIMENT",
    "--web": "--view web",
}


class LazyGroup(click.Group):
    """A group that imports a command's file at the command's first use."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the help."""
        return [name for _, names in self._groups() for name in names]

    @staticmethod
    def _groups() -> list[tuple[str, list[str]]]:
        """Return the headings of the help and the names below each."""
        groups = [(heading, [n for n in names.split() if n in COMMANDS]) for heading, names in GROUPS.items()]
        listed = [name for _, names in groups for name in names]
        return [*groups, ("More", [name for name in COMMANDS if name not in listed])]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands in groups."""
        limit = formatter.width - 6 - max(map(len, COMMANDS))
        for heading, names in self._groups():
            commands = [(name, self.get_command(ctx, name)) for name in names]
            rows = [(name, one.get_short_help_str(limit)) for name, one in commands if one is not None]
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows, col_max=max(map(len, COMMANDS)), col_spacing=2)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that the arguments name. Raises `LabError` with the nearest name for an unknown one."""
        if args[0] not in COMMANDS and not args[0].startswith("-"):
            raise LabError(f"{args[0]}: no such command; {hint(args[0], COMMANDS, 'see floaty --help')}")
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command; None for an unknown name."""
        if cmd_name not in COMMANDS:
            return None
        file, function = COMMANDS[cmd_name].split(".")
        command: click.Command = getattr(import_module(f"hil.commands.{file}"), function)
        return command


def _print_version(context: click.Context, option: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        click.echo(describe())
        context.exit()


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_print_version,
    help="Show version, commit, packages and programs found, and exit.",
)
def app() -> None:
    """Floaty virtual laboratory: firmware, ground station and wind tunnel, connected by real bytes.

    `floaty COMMAND --help` shows its options, `floaty docs` the documentation.
    """


class Output:
    """A standard output that raises `OutputError`."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text."""
        with self._failing():
            return self._stream.write(text)

    def flush(self) -> None:
        """Write what was kept."""
        with self._failing():
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @contextmanager
    def _failing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(os.strerror(error.errno or 0)) from error


@contextmanager
def _printing() -> Iterator[None]:
    """Print to an `Output`, up to the last line. Raises `LabError`, and `SystemExit` when a reader like `head` has ended."""
    stream = sys.stdout
    if stream is None:  # it is closed
        yield
        return
    try:
        sys.stdout = output = Output(stream)
        yield
        output.flush()
    except OutputError as error:
        _silence(stream)
        if isinstance(error.__cause__, BrokenPipeError):
            sys.exit(128 + signal.SIGPIPE)
        raise LabError(f"standard output: {error}") from None
    finally:
        sys.stdout = stream


def main() -> None:
    """Run the command line and exit with its code."""
    # The Python processes that this one starts import nothing from the current folder.
    os.environ["PYTHONSAFEPATH"] = "1"
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # starting a thread per core would cost 0.03 s on two
    gc.set_threshold(100_000, 20, 50)  # imports alone would cause 0.3 s of collections
    atexit.register(gc.freeze)  # Python's last collection would delay the prompt by 0.5 s
    try:
        _check_names(sys.argv[1:])
        with stopped_like_ctrl_c(), _printing():
            code = app.main(standalone_mode=False)
    except LabError as error:
        sys.exit(_refuse(*error.lines))
    except ImportError as error:
        if not (missing := why_missing(error)):
            raise
        sys.exit(_refuse(missing))
    except click.exceptions.NoArgsIsHelpError as error:
        for line in error.format_message().splitlines():
            warn(line)
        sys.exit(2)
    except click.ClickException as error:
        typed = error.option_name if isinstance(error, click.NoSuchOption) else " ".join(sys.argv[1:3])
        moved, text = MOVED.get(typed), error.format_message()
        if isinstance(error, click.MissingParameter) and error.ctx and error.ctx.info_name in NAMED_BY_LIST:
            text = f"{text.rstrip('.')}: `floaty list` names them"
        sys.exit(_refuse(f"{typed}: now {moved}" if moved else text))
    except (click.Abort, KeyboardInterrupt):
        sys.exit(INTERRUPTED)
    sys.exit(code if isinstance(code, int) else 0)


def _check_names(arguments: list[str]) -> None:
    """Raise `LabError` for an argument that is not UTF-8, which logs and reports cannot store."""
    for argument in arguments:
        try:
            argument.encode()
        except UnicodeEncodeError:
            raise LabError(f"{os.fsencode(argument)!r}: expected a name in UTF-8") from None


def _refuse(*lines: str) -> int:
    try:
        for text in lines:
            warn(f"floaty: {' '.join(text.split())}")
    except OSError:  # only the exit code is left
        _silence(sys.stderr)
    return 2


def _silence(stream: TextIO) -> None:
    """Lead a stream nowhere: at the end Python writes again what it could not write."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
