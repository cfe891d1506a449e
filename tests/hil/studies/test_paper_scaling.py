"""Agility over size: what three similar robots of half to double length are identified to from their flights."""

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from hil.campaigns.run import Runner
from hil.config import load_config
from hil.design.claims import AGREES
from hil.design.linear import point_of
from hil.floaty.geometry import weigh
from hil.studies.paper_identification import SIZES, fly_scaling


@pytest.mark.long
def test_flights_of_three_sizes_show_that_agility_goes_with_one_over_the_length(tmp_path: Path) -> None:
    with Runner(Console(quiet=True)) as runner:
        claims = fly_scaling(tmp_path, runner)
    assert [claim.title.split()[0] for claim in claims] == ["yaw", "roll"]
    for claim in claims:
        exponent, half = (float(part) for part in claim.ours.split(" (")[0].split(" ± "))
        assert abs(exponent + 1.0) < half < 0.2
        assert claim.verdict == AGREES


def test_the_sizes_are_similar_robots_each_in_the_updraft_that_carries_it() -> None:
    configs = [load_config(profile) for profile in SIZES]
    lengths = np.array([config.geometry.footprint for config in configs])
    masses = np.array([weigh(config.geometry).mass for config in configs])
    speeds = np.array([config.tunnel.speed for config in configs])
    assert lengths / lengths[1] == pytest.approx([0.5, 1.0, 2.0])
    assert masses / masses[1] == pytest.approx((lengths / lengths[1]) ** 3)
    assert speeds / speeds[1] == pytest.approx(np.sqrt(lengths / lengths[1]))
    assert [point_of(config).speed for config in configs] == pytest.approx(speeds)
