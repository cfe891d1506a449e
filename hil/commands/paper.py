"""`floaty paper | study | drag-model`: many flights and their summary, and the mounted robot on the balance."""

import math
from collections.abc import Sequence
from dataclasses import astuple, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.progress import track
from rich.table import Table

from hil.commands import options as common
from hil.commands.design import show_claims
from hil.commands.options import PATH, say, warn
from hil.errors import made_folder, require, writing

if TYPE_CHECKING:
    from hil.research.studies.paper import Paper
    from hil.research.studies.paper_identification import PaperConstant
    from hil.research.studies.study import Study

seeds_option = click.option(
    "--seeds",
    type=click.IntRange(1, 1000),
    default=5,
    show_default=True,
    metavar="N",
    help="Of every flight.",
)


@click.command()
@seeds_option
@click.option(
    "--out", type=PATH, metavar="DIR", default=Path("runs/paper"), show_default=True, help="Report and logs."
)
@click.option("--only", metavar="PATTERN", help="Only these experiments, like hover or yaw-*.")
@click.option("--no-studies", is_flag=True, help="Leave the robustness studies out.")
@common.runner_options
def paper(seeds: int, out: Path, only: str | None, no_studies: bool, **crew: Any) -> int:
    """Fly the paper's experiments on both profiles, and the robustness studies; write one report.

    Exit code 0: all limits hold for the default profile; 1: one fails; 2: bad input; 130: interrupted, with a report
    on the finished flights.
    """
    from hil.research.studies.catalogue import STUDIES
    from hil.research.studies.paper import select

    studies = [] if only or no_studies else list(STUDIES.values())
    return _fly(select(only), studies, seeds, out, crew, mounted=not only)


@click.command()
@click.argument("name")
@seeds_option
@click.option("--out", type=PATH, metavar="DIR", help="Report and picture [runs/study-NAME].")
@common.runner_options
def study(name: str, seeds: int, out: Path | None, **crew: Any) -> int:
    """Fly one robustness study (see `floaty list`): faults of growing size, several variants, one picture.

    Exit code 0: every outcome is the expected one; 1: one is not; 2: bad input; 130: interrupted.
    """
    from hil.research.studies.catalogue import find_study

    return _fly([], [find_study(name)], seeds, out or Path("runs") / f"study-{name}", crew)


def _fly(
    rows: list[str],
    studies: "list[Study]",
    seeds: int,
    out: Path,
    crew: dict[str, Any],
    mounted: bool = False,
) -> int:
    require("floaty paper", "design", "scipy")
    from hil.config import load_config
    from hil.research.campaigns.run import Runner
    from hil.research.design.analysis import analyse
    from hil.research.design.linear import point_of
    from hil.research.studies import drag_model
    from hil.research.studies.paper import fly_paper
    from hil.research.studies.paper_identification import fly_identification, fly_scaling
    from hil.research.studies.paper_report import write_paper

    common.announce_compilation()
    with writing("--out", made_folder("--out", out)), Runner(common.notices, **crew) as runner:
        flown = fly_paper(rows, studies, seeds, out, runner)
        bench = list(drag_model.measure(load_config(), 1)) if mounted and not runner.interrupted else []
        shape = analyse(point_of(load_config())) if bench else None
        constants = fly_identification(out, runner) if bench else ()
        if shape is not None and constants:
            shape = replace(shape, claims=[*shape.claims, *fly_scaling(out, runner)])
        report = write_paper(out, flown, bench, shape, constants)
    _print_rows(flown)
    _print_studies(flown)
    if shape is not None:
        show_claims(shape)
    _print_constants(constants)
    say(f"  {report}")
    if runner.interrupted:
        warn("interrupted: the report has the flights that were complete")
        return common.INTERRUPTED
    holds = flown.holds if rows else all(result.holds for result in flown.studies)
    return 0 if holds else 1


def _print_rows(flown: "Paper") -> None:
    from hil.research.studies.catalogue import PROFILES
    from hil.research.studies.paper import Spread

    if not flown.rows:
        return
    title = "paper and laboratory: mean ± deviation over the seeds"
    table = Table("result", "figure", "paper", *PROFILES, title=title)
    for _, row, both in flown.rows:
        table.add_section()
        for index, (metric, claim) in enumerate(row.claims.items()):
            cells = (f"{Spread.of(metric, one.results)} {_marked(one.missed(row, metric))}" for one in both)
            table.add_row(row.title if index == 0 else "", metric, claim.text, *cells)
        verdicts = (
            f"{one.passed} of {len(one.results)}{'' if one.holds else _marked(' FAILS')}" for one in both
        )
        table.add_row("", "limits held", "", *verdicts)
    common.wide_console(160).print(table)
    for row, profile, what in flown.misses:
        say(f"{row.title}, {profile}: {'; '.join(what)}")
    for why in dict.fromkeys(row.why for row, _, _ in flown.misses if row.why):
        say("")
        say(why)


def _print_constants(constants: "Sequence[PaperConstant]") -> None:
    from hil.research.studies.paper_identification import COLUMNS, WHY

    if not constants:
        return
    table = Table(*COLUMNS, title="identification of roll: the paper, and where the truth is known")
    for one in constants:
        table.add_row(*astuple(one))
    common.wide_console(160).print(table)
    say(WHY)


def _marked(text: str) -> str:
    return f"[red]{text}[/red]" if text else ""


def _print_studies(flown: "Paper") -> None:
    for result in flown.studies:
        surprises = [
            f"{curve.variant.name}: {one}" for curve in result.curves for one in result.surprises(curve)
        ]
        verdict = "as expected" if result.holds else "; ".join(surprises) or "not complete"
        say(f"study {result.study.name}: {verdict}")


@click.command("drag-model")
@common.seed_option
@common.profile_options
@click.option("--out", type=PATH, default=Path("runs/drag-model"), show_default=True, metavar="DIR")
def drag_model(seed: int, profile: str, overrides: tuple[str, ...], out: Path) -> None:
    """Measure forces and torques on the mounted robot over flap angles, against the paper's simplified model."""

    from hil.config import load_config
    from hil.research.studies import drag_model

    config = load_config(profile, overrides)
    config.robot.need_plates(profile, "floaty drag-model")
    made_folder("--out", out)
    common.announce_compilation()
    measured = drag_model.measure(config, seed)
    rows = list(track(measured, "mounted robot", drag_model.ROWS, console=common.notices, transient=True))
    page = drag_model.write(rows, math.degrees(config.plant.hover_angle), out)
    say(f"report  {page}")
