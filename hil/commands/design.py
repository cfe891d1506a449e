"""`floaty design`: the robot of a profile as a design."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource
from rich.table import Table

from hil.commands import options as common
from hil.commands.options import PATH, common_option, option, say
from hil.errors import LabError, made_folder, require, writing

if TYPE_CHECKING:
    from hil.research.design.analysis import Analysis
    from hil.research.design.linear import Point

SPEED_MAX = 60.0  # [m/s] the largest that a profile allows


write_option = click.option(
    "--write", "write_to", type=PATH, metavar="FILE", help="A profile that flies this robot, with gains."
)
out_option = click.option("--out", type=PATH, default=Path("runs/design"), show_default=True, metavar="DIR")


@dataclass(frozen=True, slots=True)
class DesignOptions:
    """The options of `floaty design`."""

    profile: str = common_option(common.profile_option)
    overrides: tuple[str, ...] = common_option(common.set_option)
    speed: float | None = option(
        "--speed", type=common.Number(1, 40), help="Updraft [m/s]: the hover angle follows."
    )
    angle: float | None = option(
        "--angle", type=common.Number(0, 70), help="Hover angle [deg]: the updraft follows."
    )
    length: float = option(
        "--length", type=common.Number(0.1, 10), default=1.0, help="The similar robot: lengths times this."
    )
    mass: float = option(
        "--mass", type=common.Number(0.01, 100), default=1.0, help="The similar robot: masses times this."
    )
    as_json: bool = option(
        "--json", "as_json", is_flag=True, help="Print only the model on board: states, A and B of each axis."
    )
    write_to: Path | None = common_option(write_option)
    out: Path = common_option(out_option)


@dataclass(frozen=True, slots=True)
class Search:
    """The options of `floaty design optimise`."""

    profile: str = common_option(common.profile_option)
    overrides: tuple[str, ...] = common_option(common.set_option)
    seed: int = common_option(common.seed_option)
    figure: str = option(
        "--figure", type=click.Choice(["least-authority", "speed-range"]), default="least-authority", show_default=True
    )  # fmt: skip
    generations: int = option(
        "--generations", type=click.IntRange(1, 500), default=25, show_default=True, help="Of the search."
    )
    updrafts: tuple[float, float] = option(
        "--updrafts", type=common.Number(1, 60), nargs=2, default=(8.0, 11.0), show_default=True,
        help="Which robot could hold these speeds, and at what cost?",
    )  # fmt: skip
    write_to: Path | None = common_option(write_option)
    out: Path = common_option(out_option)


@click.group(invoke_without_command=True)
@click.pass_context
@common.asked_as(DesignOptions)
def design(context: click.Context, robot: DesignOptions) -> None:
    """Compute trim, constants, poles, authority and sweeps of a profile's robot, and compare the paper's claims."""
    require("floaty design", "design", "scipy", "control")
    given = [
        one.opts[0]
        for one in context.command.params
        if context.get_parameter_source(one.name or "") is ParameterSource.COMMANDLINE
    ]
    if context.invoked_subcommand is not None:
        if given:
            raise LabError(f"{', '.join(given)}: before {context.invoked_subcommand}, which does not read it")
        return
    if robot.as_json:
        if others := [name for name in given if name not in ("--json", "--profile", "--set")]:
            raise LabError(
                f"{', '.join(others)}: does not change what --json prints, the model of the profile"
            )
        for line in _model_on_board(robot).splitlines():
            say(line)
        return
    from hil.research.design.analysis import analyse, write

    common.check_profile("--write", robot.write_to)
    similar = robot.speed, robot.angle, robot.length, robot.mass
    point = point_of(robot.profile, robot.overrides, *similar)
    common.announce_compilation()
    if robot.write_to is not None:
        about = f"The robot of {robot.profile}, lengths times {robot.length:g}, masses times {robot.mass:g}."
        write_profile(point, robot.write_to, about, robot.length)
    found = analyse(point)
    page = write(found, made_folder("--out", robot.out))
    show(found)
    say(f"report  {page}")


@design.command()
@common.asked_as(Search)
def optimise(asked: Search) -> None:
    """Find the kink, centre of mass, base plate and strip with the largest figure, at the profile's span, mass and speed."""
    from hil.pictures.drawing import png
    from hil.research.design import figures
    from hil.research.design import optimise as search
    from hil.research.design.bounds import at_bounds
    from hil.research.design.claims import robot_lines

    profile, figure, updrafts = asked.profile, asked.figure, asked.updrafts
    if updrafts[0] >= updrafts[1]:
        raise LabError(f"--updrafts {updrafts[0]:g} {updrafts[1]:g}: expected the least first")
    common.check_profile("--write", asked.write_to)
    common.announce_compilation()
    found = search.optimise(point_of(profile, asked.overrides), figure, asked.seed, asked.generations)
    best, front = found.best, search.front(found.tried, figure)
    if asked.write_to is not None:
        about = f"What floaty design optimise --figure {figure} --seed {asked.seed} derived from {profile}."
        write_profile(best.point, asked.write_to, about)
    named = {profile: found.reference, "best": best}
    marks = {name: tuple(search.placed((one,), figure)[0].tolist()) for name, one in named.items()}
    axes = (
        "stability: -f_αα [1/s²]",
        figure + (" / that of the profile's robot" if figure == "least-authority" else ""),
    )
    picture = made_folder("--out", asked.out) / f"pareto-{figure}.png"
    picture.write_bytes(png(lambda: figures.pareto(axes, search.placed(found.tried, figure), front, marks)))
    for name, value in robot_lines(best.point):
        say(f"{name:38} {value}")
    own = f"{marks[profile][1]:.3f}" if found.reference_flies else "not stable and steering around its hover"
    say(f"{figure}: {marks['best'][1]:.3f}; {profile}: {own}; {len(found.tried)} robots flew")
    for line in (*at_bounds(best.point.geometry), *search.exercise(found, *updrafts)):
        say(line)
    say(f"picture  {picture}")


def _model_on_board(robot: DesignOptions) -> str:
    """Return the axes of `[model]` as JSON: x' = A x + B u in continuous time, in SI units."""
    from hil.config import load_config
    from hil.research.design.axes import AXES, FLAP, UNITS_OF_STATES, dynamics, robot_of

    constants = robot_of(load_config(robot.profile, robot.overrides))
    axes = []
    for axis in AXES:
        flow, columns = dynamics(axis, constants)
        states = [f"{name} [{UNITS_OF_STATES[name]}]" for name in (*axis.states, FLAP)]
        axes.append({
            "axis": axis.label, "input": f"u{axis.input + 1} [rad]", "states": states,
            "A": flow.tolist(), "B": columns[:, :1].tolist(),
        })  # fmt: skip
    return json.dumps({"axes": axes}, indent=2)


def write_profile(point: "Point", path: Path, about: str, length: float = 1.0) -> None:
    """Write a profile that flies the robot."""
    from hil.laboratory.files.whole_files import write_whole
    from hil.research.design.gains import gains_of, profile_text

    text = profile_text(point, gains_of(point.linear), about, length)
    with writing("--write", path):
        write_whole(path, text)
    say(f"profile {path}")


def point_of(
    profile: str,
    overrides: tuple[str, ...],
    speed: float | None = None,
    angle: float | None = None,
    length: float = 1.0,
    mass: float = 1.0,
) -> "Point":
    """Return a profile's robot, or a similar one, in its design hover or at another speed or angle."""
    from hil.config import load_config
    from hil.research.design.linear import point_of as own_point_of
    from hil.research.design.trim import opening_at, scaled

    config = load_config(profile, overrides)
    config.robot.need_plates(profile, "floaty design")
    point = own_point_of(config)
    geometry, opening = scaled(point.geometry, length, mass), point.opening
    if speed is not None and angle is not None:
        raise LabError(f"--speed {speed:g} --angle {angle:g}: one follows from the other; give one of them")
    if speed is not None:
        opening = opening_at(geometry, point.coefficient, speed)
    if angle is not None:
        opening = math.radians(angle)
    point = replace(point, geometry=geometry, opening=opening)
    if not 1.0 < point.speed <= SPEED_MAX:
        raise LabError(
            f"hover at {math.degrees(opening):.0f} deg takes {point.speed:.3g} m/s: outside 1..{SPEED_MAX:g}"
        )
    return point


def show(found: "Analysis") -> None:
    """Print the tables."""
    for name, value in found.robot:
        say(f"{name:38} {value}")
    table = Table("input", "alone, inside the flaps' range", "linear, in both directions about the hover")
    for row in found.inputs:
        table.add_row(*row)
    common.wide_console().print(table)
    show_claims(found)


def show_claims(found: "Analysis") -> None:
    """Print the paper's claims."""
    table = Table("claim", "paper", "computed", "", title="the paper's design")
    for claim in found.claims:
        colour = "green" if claim.verdict == "agrees" else "red"
        table.add_row(claim.title, claim.paper, claim.ours, f"[{colour}]{claim.verdict}[/{colour}]")
    common.wide_console().print(table)
