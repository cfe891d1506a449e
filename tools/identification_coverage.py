"""Measures `floaty identify` against known truth: python tools/identification_coverage.py [ROBOTS] [FOLDER] [SEED].

Flies identify-u1 to identify-u4 on ROBOTS (default 20) whose constants and servo lags are drawn within 20 % and masses
within 3 %, in each of six conditions: undisturbed, at corners of that box, with three short dropouts of the cameras, with
two long ones, with 40 ms more latency, in 1 m/s of side wind along y (along x the robot is lost). For each condition it
prints how many of the joint fit's 95 % intervals contain the truth at the flown point, the mean error of each constant
over its mean half interval, and how many constants are called identified although their error exceeds twice their
interval. Flights already in FOLDER are not repeated. A robot takes one to two minutes of one core per condition.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from hil.errors import LabError
from hil.laboratory.request import Options
from hil.research.campaigns.run import Runner
from hil.research.identify.identify import IDENTIFIED, IdentifiedConstant, identify
from hil.research.identify.record import load_record
from hil.research.studies.tuning import EXCITATIONS
from hil.world.floaty.correction import PAPER_TABLE

FIRST_SEED = 1001  # not used in development
UNTOUCHED = ("z_vz",)  # follows from the plate's physics
WRONG = 2.0  # times the half interval
DROPOUTS = ("mocap.dropout@20:0.25", "mocap.dropout@60:0.25", "mocap.dropout@100:0.25")

LONG_DROPOUTS = ("mocap.dropout@40:0.5", "mocap.dropout@90:1")


def drawn(seed: int) -> tuple[str, ...]:
    """Return the settings of a robot."""
    rng = np.random.default_rng(seed)
    return _settings(rng, lambda spread: 1.0 + spread * rng.uniform(-1.0, 1.0))


def corner(seed: int) -> tuple[str, ...]:
    """Return the settings of a robot at a corner of the same box."""
    rng = np.random.default_rng(seed)
    return _settings(rng, lambda spread: 1.0 + spread * rng.choice((-1.0, 1.0)))


def _settings(rng: np.random.Generator, factor: Callable[[float], float]) -> tuple[str, ...]:
    factors = [f"{name}={factor(0.2):.4f}" for name in PAPER_TABLE if name not in UNTOUCHED]
    return (
        f"plant.constant_factors={{{', '.join(factors)}}}",
        f"actuators.tau={0.05 * factor(0.2):.4f}",
        f"plant.mass_factor={factor(0.03):.4f}",
    )


@dataclass(frozen=True, slots=True)
class Condition:
    """How the robots of a table are drawn, and the faults and settings with which they fly."""

    draw: Callable[[int], tuple[str, ...]] = drawn
    faults: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()


CONDITIONS = {
    "as they are": Condition(),
    "corners of the box": Condition(corner),
    "three dropouts": Condition(faults=DROPOUTS),
    "dropouts of 0.5 and 1 s": Condition(faults=LONG_DROPOUTS),
    "40 ms more latency": Condition(faults=("mocap.latency@0=40",)),
    "1 m/s of side wind": Condition(settings=("tunnel.side_wind=[0.0, 1.0, 0.0]",)),
}


def fly(condition: str, seeds: range, folder: Path) -> None:
    """Fly the missing flights."""
    flown = CONDITIONS[condition]
    flights = {
        f"{seed}-{name}": (
            name,
            Options(
                overrides=(*flown.draw(seed), *flown.settings), faults=flown.faults, seed=4 * seed + place
            ),
        )
        for seed in seeds
        for place, name in enumerate(EXCITATIONS)
        if not (folder / f"{seed}-{name}").exists()
    }
    if flights:
        with Runner(Console(stderr=True)) as runner:
            runner.log("coverage", flights, folder)


def table_of(condition: str, seeds: range, folder: Path) -> Table:
    """Return the coverage of one condition."""
    found: dict[str, list[IdentifiedConstant]] = {}
    lost = 0
    for seed in seeds:
        try:
            records = [load_record(folder / f"{seed}-{name}", "floaty") for name in EXCITATIONS]
            constants = identify(records).constants
        except LabError as error:
            print(f"robot {seed}: {error}", file=sys.stderr)
            lost += 1
            continue
        for constant in constants:
            if isfinite(constant.truth) and isfinite(constant.best):
                found.setdefault(constant.name, []).append(constant)
    everything = [constant for several in found.values() for constant in several]
    share = np.mean([one.contains_truth for one in everything])
    wrong = sum(_wrong(one) for one in everything)
    table = Table(
        "constant", "contain", "bias over half interval", "half interval", "identified", "wrong",
        title=f"{condition}: {len(seeds) - lost} robots, {share:.1%} of {len(everything)} intervals contain the truth, "
        f"{wrong} wrong",
    )  # fmt: skip
    for name, several in found.items():
        half = np.mean([one.joint[1] for one in several])
        bias = np.mean([one.best - one.truth for one in several]) / half
        table.add_row(
            name, f"{sum(one.contains_truth for one in several)} of {len(several)}", f"{bias:+.2f}",
            f"{half / np.mean([abs(one.truth) for one in several]):.0%}",
            str(sum(one.verdict == IDENTIFIED for one in several)), str(sum(map(_wrong, several))),
        )  # fmt: skip
    return table


def _wrong(one: IdentifiedConstant) -> bool:
    return one.verdict == IDENTIFIED and abs(one.best - one.truth) > WRONG * one.joint[1]


def main(count: int, folder: Path, first: int) -> None:
    """Fly and print all conditions."""
    seeds = range(first, first + count)
    for condition in CONDITIONS:
        own = folder / condition.replace("/", "-").replace(" ", "-")
        fly(condition, seeds, own)
        Console(width=120).print(table_of(condition, seeds, own))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("robots", type=int, nargs="?", default=20)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("runs/identification"))
    parser.add_argument("seed", type=int, nargs="?", default=FIRST_SEED)
    options = parser.parse_args()
    main(options.robots, options.folder, options.seed)
