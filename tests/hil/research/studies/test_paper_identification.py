"""The paper's identification of roll: its arithmetic, beside what its method and others find where the truth is known.

Agility over size: what three similar robots of half to double length are identified to from their flights.
"""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from hil.config import load_config
from hil.research.campaigns.run import Runner
from hil.research.design.claims import AGREES
from hil.research.design.linear import point_of
from hil.research.studies.paper import Paper
from hil.research.studies.paper_identification import (
    COLUMNS,
    SIZES,
    WHY,
    PaperConstant,
    fly_identification,
    fly_scaling,
)
from hil.research.studies.paper_report import write_paper
from hil.world.floaty.geometry import weigh
from support.html_page import Page


def number(text: str) -> float:
    return float(text.split()[0])


@pytest.mark.long
def test_the_papers_method_misses_what_the_others_find(tmp_path: Path) -> None:
    with Runner(Console(quiet=True)) as runner:
        a, c, b, first, second = fly_identification(tmp_path, runner)
    assert [row.arithmetic for row in (a, c)] == ["230", "-14"]
    truth = [number(row.truth) for row in (a, c, b, first, second)]
    # The Table's, at its hover angle; the robot flies at a smaller one.
    assert truth == pytest.approx([230, -16, -40, -62, -50.5], rel=0.13)
    assert [row.paper for row in (first, second)] == ["-60", "-48.5"]
    for row in (a, b):
        value, half = (number(part) for part in row.joint.split("±"))
        assert abs(value - number(row.truth)) < 1.5 * half
    assert abs(number(b.paper_method) - -40.0) > 0.5 * 40.0, "it finds no damping"


@pytest.mark.long
def test_the_report_has_the_rows_of_the_identification(tmp_path: Path) -> None:
    rows = [PaperConstant("a", "230 ± 66", "230", "230", "43 ± 131", "211 ± 12", "226 ± 10")]
    text = write_paper(tmp_path, Paper((), (), False), (), None, rows).read_text(encoding="utf-8")
    page = Page(text)
    assert WHY.split(":")[0].replace("'", "&#39;") in text
    assert list(page.tables["identification"][-1]) == list(dataclasses.astuple(rows[0]))
    assert list(page.tables["identification"][0]) == list(COLUMNS)
    told = json.loads((tmp_path / "result.json").read_text())["identification"]
    assert told == [dataclasses.asdict(row) for row in rows]


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
