"""How good `floaty identify` is where the truth is known: python tools/identification_coverage.py [ROBOTS] [FOLDER].

Flies identify-u1 to identify-u4 on the plants `methods` and `methods_open` and on ROBOTS (default 5) drawn inside the
Table's ± with servo lags of ±20 %, and says how many of the 95 % intervals hold the truth, the joint fit's and the
instruments', and how far each constant of the joint fit is off on the mean. On two idle cores it takes ten minutes.
"""

import sys
from pathlib import Path

import numpy as np
from rich.console import Console

from hil.campaigns.run import Runner
from hil.identify.identify import IdentifiedConstant, identify
from hil.identify.record import load_record
from hil.laboratory.request import Options
from hil.studies.tuning import EXCITATIONS
from hil.world.paper_table import PAPER_TABLE

FIRST_SEED = 301  # nothing was tuned on these
# With these the robot flies whose rates are damped by its plates alone.
OPEN = (
    "plant.variant=methods_open",
    "controller.gain_y=-0.75",
    "controller.gain_vy=-0.52",
    "controller.gain_roll=0.52",
    "controller.gain_p=0.089",
)
UNTOUCHED = ("z_vz",)  # follows from the plate's physics


def drawn(seed: int) -> tuple[str, ...]:
    """Return the settings of a robot inside the Table's ±."""
    rng = np.random.default_rng(seed)
    factors = [
        f"{name}={rng.uniform(1 - half / abs(value), 1 + half / abs(value)):.4f}"
        for name, (value, half) in PAPER_TABLE.items()
        if name not in UNTOUCHED
    ]
    return (
        f"plant.constant_factors={{{', '.join(factors)}}}",
        f"actuators.tau={0.05 * rng.uniform(0.8, 1.2):.4f}",
    )


def main(count: int, folder: Path) -> None:
    robots = {"methods": (), "methods_open": OPEN} | {
        f"drawn-{seed}": drawn(seed) for seed in range(FIRST_SEED, FIRST_SEED + count)
    }
    flights = {
        f"{robot}-{name}": (name, Options(overrides=settings, seed=4 * number + place))
        for number, (robot, settings) in enumerate(robots.items(), 1)
        for place, name in enumerate(EXCITATIONS)
    }
    with Runner(Console(stderr=True)) as runner:
        runner.log("coverage", flights, folder)
    found: dict[str, list[IdentifiedConstant]] = {}
    for robot in robots:
        records = [load_record(folder / f"{robot}-{name}", "floaty") for name in EXCITATIONS]
        for constant in identify(records).constants:
            if np.isfinite(constant.truth):
                found.setdefault(constant.name, []).append(constant)
    everything = [constant for several in found.values() for constant in several]
    print(
        f"{len(robots)} robots: {np.mean([one.contains_truth for one in everything]):.0%} of the intervals hold the truth, "
        f"{np.mean([abs(one.instrumental[0] - one.truth) <= one.instrumental[1] for one in everything]):.0%} of the "
        "instruments'"
    )
    for name, several in found.items():
        bias = np.mean([one.best / one.truth - 1 for one in several])
        verdicts = [one.verdict for one in several]
        common = max(set(verdicts), key=verdicts.count)
        held = sum(one.contains_truth for one in several)
        print(f"  {name:12} {held} of {len(several)}, off by {bias:+6.1%} on the mean, mostly {common}")


if __name__ == "__main__":
    main(
        int(sys.argv[1]) if len(sys.argv) > 1 else 5,
        Path(sys.argv[2] if len(sys.argv) > 2 else "runs/identification"),
    )
