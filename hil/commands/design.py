"""`floaty design`: the robot of a profile as a design."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console

from hil.commands.options import announce_compilation, console, profile_option, set_option
from hil.errors import LabError

if TYPE_CHECKING:
    from hil.design.analysis import Analysis
    from hil.design.sweeps import Point

SPEED_MAX = 60.0  # [m/s] that a profile may have
out_option = click.option(
    "--out", type=click.Path(path_type=Path), default=Path("runs/design"), show_default=True, metavar="DIR"
)


@click.group(invoke_without_command=True)
@click.pass_context
@profile_option
@set_option
@click.option("--speed", type=click.FloatRange(1, 40), help="Updraft [m/s]: the hover angle follows.")
@click.option("--angle", type=click.FloatRange(0, 70), help="Hover angle [deg]: the updraft follows.")
@out_option
def design(
    context: click.Context,
    profile: str,
    overrides: tuple[str, ...],
    speed: float | None,
    angle: float | None,
    out: Path,
) -> None:
    """Trim, constants, poles, authority and sweeps of a profile's robot, beside the paper's claims of its design."""
    if context.invoked_subcommand is not None:
        return
    from hil.design.analysis import analyse, write

    announce_compilation()
    found = analyse(point_of(profile, overrides, speed, angle))
    page = write(found, folder_for(out))
    show(found)
    console.print(f"report  {page}", soft_wrap=True)


def point_of(profile: str, overrides: tuple[str, ...], speed: float | None, angle: float | None) -> "Point":
    """Return a profile's robot at its design hover, or at the hover of another speed or angle."""
    from hil.config import load_config
    from hil.design.sweeps import Point
    from hil.design.trim import coefficient_of, opening_at

    config = load_config(profile, overrides)
    coefficient, opening = coefficient_of(config), config.plant.hover_angle
    if speed is not None and angle is not None:
        raise LabError(f"--speed {speed:g} --angle {angle:g}: one follows from the other; give one of them")
    if speed is not None:
        opening = opening_at(config.geometry, coefficient, speed)
    if angle is not None:
        opening = math.radians(angle)
    limits = config.allocation
    point = Point(config.geometry, coefficient, opening, limits.opening_min, limits.opening_max)
    if not 1.0 < point.speed <= SPEED_MAX:
        raise LabError(
            f"hover at {math.degrees(opening):.0f} deg takes {point.speed:.3g} m/s: outside 1..{SPEED_MAX:g}"
        )
    return point


def folder_for(out: Path) -> Path:
    """Make the folder."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LabError(f"--out {out}: cannot be written ({error.strerror or error})") from None
    return out


def show(found: "Analysis") -> None:
    """Print the tables."""
    from rich.table import Table

    for name, value in found.robot:
        console.print(f"{name:38} {value}", soft_wrap=True)
    table = Table("input", "alone, inside the flaps' range", "linear, both ways about the hover")
    for row in found.inputs:
        table.add_row(*row)
    wide = Console(highlight=False, width=max(console.width, 150))
    wide.print(table)
    table = Table("claim", "paper", "computed", "", title="the paper's design")
    for claim in found.claims:
        colour = "green" if claim.verdict == "agrees" else "red"
        table.add_row(claim.title, claim.paper, claim.ours, f"[{colour}]{claim.verdict}[/{colour}]")
    wide.print(table)
