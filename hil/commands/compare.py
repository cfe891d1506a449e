"""`floaty compare`: where two flights first differ, their metrics side by side, both in one picture."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hil.commands.options import console

if TYPE_CHECKING:
    from hil.pictures.compare import Comparison

folder_type = click.Path(path_type=Path)


@click.command()
@click.argument("first", metavar="RUN", type=folder_type)
@click.argument("second", metavar="RUN", type=folder_type)
@click.option(
    "--out",
    type=folder_type,
    metavar="DIR",
    help="For compare.png and compare.html [the second run's folder].",
)
def compare(first: Path, second: Path, out: Path | None) -> int:
    """Compare one flight with another: first difference, metrics, settings, both in one plot.

    Exit code 0: the logs are identical; 1: they differ; 2: bad input.
    """
    from hil.pictures.compare import compare as compare_runs
    from hil.pictures.compare import load_run, write_comparison

    a, b = load_run(first), load_run(second)
    comparison = compare_runs(a, b)
    page = write_comparison(out or second, a, b, comparison)
    _print_comparison(first, second, comparison)
    console.print(f"  {page}", soft_wrap=True)
    return 0 if comparison.identical else 1


def _print_comparison(first: Path, second: Path, comparison: "Comparison") -> None:
    from rich.table import Table

    table = Table(title=f"{first} | {second}")
    table.add_column("metric")
    for heading in ("first", "second", "difference"):
        table.add_column(heading, justify="right")
    table.add_column("unit")
    for pair in comparison.metrics:
        numbers = (*pair.values, pair.difference)
        shown = ("–" if math.isnan(number) else f"{number:.4g}" for number in numbers)
        table.add_row(pair.name, *shown, pair.unit)
    console.print(table)
    console.print(comparison.span, soft_wrap=True)
    if comparison.apart:
        apart = Table(title="apart, at the same time since the release")
        for heading in ("", "rms", "largest", "unit"):
            apart.add_column(heading, justify="right" if heading in ("rms", "largest") else "left")
        for one in comparison.apart:
            apart.add_row(one.name, f"{one.rms:.3g}", f"{one.largest:.3g}", one.unit)
        console.print(apart)
    for name, x, y in comparison.settings:
        console.print(f"{name}: {x} | {y}", soft_wrap=True)
    for folder, missing in zip((first, second), comparison.missing, strict=True):
        if missing:
            console.print(f"not in {folder}: {', '.join(missing)}", soft_wrap=True)
    if comparison.one_is_real:
        console.print("one flight is real, the other simulated: they share no rows")
    elif comparison.first is not None:
        console.print(f"first difference: {comparison.first}", soft_wrap=True)
    elif comparison.identical:
        console.print("identical")
    else:
        console.print("identical in the columns that both have")
