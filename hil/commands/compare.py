"""`floaty compare`: the first difference of two flights, their metrics side by side, both in one picture."""

from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.table import Table

from hil.commands.options import PATH, code_option, console, right, say, warn, wide_console
from hil.errors import reading

if TYPE_CHECKING:
    from hil.pictures.compare import Comparison
    from hil.research.studies.two_boards import Seed

NAMED = 5  # columns that only one run has


@click.command()
@click.argument("first", metavar="RUN", type=PATH)
@click.argument("second", metavar="RUN", type=PATH)
@click.option(
    "--out", type=PATH, metavar="DIR", help="For compare.png and compare.html [the second run's folder]."
)
@code_option
def compare(first: Path, second: Path, out: Path | None, named: str | None) -> int:
    """Compare one flight with another: first difference, metrics, settings, both in one plot.

    For flights that differ only in their boards: the first different servo count, and why. For two folders of such runs
    (`floaty fly EXPERIMENT --seeds N --board BOARD --out DIR`): a row per seed.

    Exit code 0: the logs are identical; 1: they differ; 2: bad input.
    """
    from hil.laboratory.experiments import check_flown, find_experiment, find_shipped, finder_of
    from hil.pictures.compare import compare as compare_runs
    from hil.pictures.compare import load_flown, write_comparison
    from hil.research.studies.two_boards import comparable, seeds_of, two_boards

    given = None if named is None else find_experiment(named)
    with reading(f"{first}, {second}"):
        if all(folder.is_dir() and not any(folder.glob("log.*")) for folder in (first, second)):
            return _print_seeds(first, second, seeds_of(first, second))
        find = find_shipped if given is None else finder_of(given)
        a, b = load_flown(first, find), load_flown(second, find)
        if given is not None and a.result.request.experiment is not given:
            check_flown(given, b.result)
        comparison = compare_runs(a, b)
        boards = two_boards(a, b) if comparable(a, b) else None
        why = () if boards is None else (str(boards.first or "no servo count differs"), *boards.causes)
        page = write_comparison(out or second, a, b, comparison, why)
        print_comparison(first, second, comparison)
    for line in why:
        say(line)
    for reference in comparison.unmeasured:
        command = f"--experiment {reference}"
        warn(
            f"without the own metrics of this span, which need the experiment's code: {command!r} executes it"
        )
    say(f"  {page}")
    return 0 if comparison.identical else 1


def print_comparison(first: Path, second: Path, comparison: "Comparison") -> None:
    """Print settings, metrics and first difference of two runs."""
    from hil.laboratory.metric_pairs import HEADINGS, differing

    table = Table(HEADINGS[0], *right(*HEADINGS[1:-1]), HEADINGS[-1], title=f"{first} | {second}")
    unequal = differing(comparison.metrics)
    for pair in unequal:
        table.add_row(*pair.cells)
    for name, x, y in comparison.settings:
        say(f"{name}: {x} | {y}")
    if unequal:
        console.print(table)
    say(f"{len(comparison.metrics) - len(unequal)} metrics are equal. {comparison.span}")
    if comparison.apart:
        title = "distance at the same time since the release"
        apart = Table("", *right("rms", "largest"), "unit", title=title)
        for one in comparison.apart:
            apart.add_row(one.name, f"{one.rms:.3g}", f"{one.largest:.3g}", one.unit)
        console.print(apart)
    for folder, missing in zip((first, second), comparison.missing, strict=True):
        if missing:
            more = f" and {len(missing) - NAMED} more, which the page names" if len(missing) > NAMED else ""
            say(f"not in {folder}: {', '.join(missing[:NAMED])}{more}")
    if comparison.one_is_real:
        say("one flight is real, the other simulated: they share no rows")
    elif comparison.first is not None:
        say(f"first difference: {comparison.first}")
    elif comparison.identical:
        say("identical")
    else:
        say("identical in the columns that both have")


def _print_seeds(first: Path, second: Path, seeds: list["Seed"]) -> int:
    """Print a row per seed; return the exit code."""
    rms = "rms x y z [cm]"
    headings = right("seed", rms, rms, "apart [mm]", "poses", "first servo count", "why")
    table = Table(*headings, title=f"{first} | {second}")
    for one in seeds:
        place = "equal" if one.first is None else f"{one.first.t_s:.3f} s {one.first.servo}"
        table.add_row(
            str(one.seed),
            *(" ".join(f"{100 * value:.3f}" for value in each) for each in one.rms_m),
            f"{1000 * one.apart_m:.2f}",
            "{} | {}".format(*one.fused),
            place,
            "" if one.first is None else one.first.why,
        )
    wide_console(140).print(table)
    worst = max(float(abs(b / a - 1).max()) for a, b in (one.rms_m for one in seeds))
    apart = max(one.apart_m for one in seeds)
    say(
        f"{len(seeds)} seeds: rms errors within {100 * worst:.1f} % of the first's, bodies within {1000 * apart:.2f} mm"
    )
    return int(any(one.first is not None for one in seeds))
