"""What several commands share: consoles, exit codes, options, and the word before a long compilation."""

import signal
import sys
from pathlib import Path

import click
from rich.console import Console

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
