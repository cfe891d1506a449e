"""`floaty identify`: the model's constants from flights, by three methods, with intervals and verdicts."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hil.commands.options import console, profile_option
from hil.errors import LabError, writing

if TYPE_CHECKING:
    from hil.identify.identify import Constant, Identification

folder_type = click.Path(path_type=Path)


@click.command()
@click.argument("runs", metavar="RUN...", type=folder_type, nargs=-1, required=True)
@profile_option
@click.option(
    "--validate", type=folder_type, metavar="RUN", help="A flight that is not fitted, to be predicted."
)
@click.option(
    "--profile-out", type=folder_type, metavar="FILE.toml", help="A profile with what was identified."
)
@click.option(
    "--out",
    type=folder_type,
    default=Path("runs/identify"),
    show_default=True,
    metavar="DIR",
    help="Page and pictures.",
)
def identify(
    runs: tuple[Path, ...], profile: str, validate: Path | None, profile_out: Path | None, out: Path
) -> int:
    """Identify the robot from RUNs: run folders, also of `floaty station`, or telemetry.csv files.

    --profile says what a bare telemetry.csv was flown with, and what a written profile builds on. Exit code 0: at least one
    constant is identified; 1: none; 2: bad input.
    """
    from hil.identify import need_scipy

    need_scipy()
    from hil.identify.identify import IDENTIFIED
    from hil.identify.identify import identify as identify_records
    from hil.identify.pages import write_pages
    from hil.identify.profile_out import write_profile
    from hil.identify.record import load_record

    if profile_out is not None and profile_out.suffix != ".toml":
        raise LabError(f"--profile-out {profile_out}: a profile's name ends in .toml")
    found = identify_records([load_record(run, profile) for run in runs])
    _print(found)
    if found.excited or found.free:
        held_out = None if validate is None else load_record(validate, profile)
        with writing("--out", out):
            out.mkdir(parents=True, exist_ok=True)
            console.print(f"  {write_pages(out, found, held_out)}", soft_wrap=True)
    if profile_out is not None:
        write_profile(profile_out, profile, found)
        console.print(f"  {profile_out}   (floaty fly hover --profile {profile_out})", soft_wrap=True)
    return 0 if any(constant.verdict == IDENTIFIED for constant in found.constants) else 1


def _print(found: "Identification") -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title="constants, with the half width of their 95 % interval")
    for heading in (
        "constant",
        "paper",
        "truth",
        "paper's method",
        "instruments",
        "joint fit",
        "unit",
        "verdict",
    ):
        table.add_column(heading, no_wrap=heading != "verdict")
    for one in found.constants:
        table.add_row(
            one.name, _pair(one.paper), _number(one.truth), _pair(one.two_controllers), _pair(one.instrumental),
            _pair(one.joint), one.unit, _verdict(one),
        )  # fmt: skip
    Console(highlight=False, width=max(console.width, 150)).print(table)
    if found.excited:
        periods = ", ".join(f"u{one.axis.input + 1}: {one.spectra.periods}" for one in found.excited)
        console.print(
            f"periods of 20 s: {periods}; the model misses the log by {found.estimate.misfit**0.5:.2f} of its scatter"
        )


def _verdict(one: "Constant") -> str:
    return f"{one.verdict}: {one.why}"


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.4g}"


def _pair(pair: tuple[float, float]) -> str:
    return "" if math.isnan(pair[0]) else f"{pair[0]:.4g} ± {pair[1]:.2g}"
