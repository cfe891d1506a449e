"""The paper's identification of roll: its arithmetic, beside what its method and others find where the truth is known.

Agility over size: what three similar robots of half to double length are identified to from their flights.
"""

import dataclasses
import json
from dataclasses import astuple
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from hil.config import load_config
from hil.errors import LabError
from hil.research.campaigns.run import Runner
from hil.research.design.linear import point_of
from hil.research.identify.identify import interval_text
from hil.research.identify.two_controllers import SIGMAS
from hil.research.studies import paper_identification
from hil.research.studies.paper import Paper
from hil.research.studies.paper_identification import (
    COLUMNS,
    SIZES,
    WHY,
    PaperConstant,
    constants,
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


def test_the_report_has_the_rows_of_the_identification(tmp_path: Path) -> None:
    rows = [PaperConstant("a", "230 ± 66", "230", "230", "43 ± 131", "211 ± 12", "226 ± 10")]
    report = write_paper(tmp_path, Paper((), (), False), (), None, rows)
    assert report == tmp_path / "report.html"
    text = report.read_text(encoding="utf-8")
    page = Page(text)
    assert WHY.split(":")[0].replace("'", "&#39;") in text
    assert list(page.tables["identification"][-1]) == list(astuple(rows[0]))
    assert list(page.tables["identification"][0]) == list(COLUMNS)
    told = json.loads((tmp_path / "result.json").read_text())["identification"]
    assert told == [dataclasses.asdict(row) for row in rows]


@pytest.mark.parametrize(("yaw", "roll"), [(-1.0, -1.2), (-1.149, -0.849), (-1.151, -0.851)])
def test_an_exponent_over_the_length_goes_with_one_over_it_within_0_15(
    monkeypatch: pytest.MonkeyPatch, yaw: float, roll: float
) -> None:
    """Constants that are exact powers of the length, each with a tenth as its half width."""
    lengths = np.array([load_config(profile).geometry.footprint for profile in SIZES])
    sizes = {"yaw_u3": 100 * (lengths / lengths[1]) ** yaw, "roll_u1": 200 * (lengths / lengths[1]) ** roll}
    asked: list[Any] = []

    def identified(rows: Any) -> Any:
        number = asked[0][1].index(rows[0]) // 2
        return Made(constant=lambda name: Made(joint=(sizes[name][number], 0.1 * sizes[name][number])))

    monkeypatch.setattr(paper_identification, "identified", identified)
    runner: Any = Made(log=lambda name, flights, out: asked.append((flights, [*flights])) or [*flights])
    found = fly_scaling(Path("x"), runner)
    spread = 0.1 / (np.sqrt(2) * np.log(2))  # of a slope through three points a factor of two apart
    for claim, (name, exponent) in zip(found, {"yaw_u3": yaw, "roll_u1": roll}.items(), strict=True):
        listed = ", ".join(f"{value:.0f} ± {0.1 * value:.0f}" for value in sizes[name])
        assert claim.ours == f"{exponent:.2f} ± {spread:.2f} ({listed} 1/s²)"
        assert claim.verdict == ("agrees" if abs(exponent + 1.0) < 0.15 else "differs")
        assert claim.title.startswith(f"{name[:-3]} acceleration")
    flights = {
        name: (one, options["profile"], options["overrides"]) for name, (one, options) in asked[0][0].items()
    }
    rms = {"identify-u3": "excitation.u3=0.03", "identify-u1": "excitation.u1=0.025"}
    assert flights == {f"{size}-{one}": (one, size, (rms[one],)) for size in SIZES for one in rms}
    runner.log = lambda *_: []
    assert fly_scaling(Path("x"), runner) == []
    assert fly_identification(Path("x"), runner) == ()


def test_each_method_has_its_column_and_each_controller_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    def constant(name: str) -> Any:
        n = ("roll_u1", "roll_roll", "roll_rate").index(name) + 1
        return Made(
            truth=10.0 * n,
            two_controllers=(11.0 * n, 1.5),
            instrumental=(12.0 * n, 2.5),
            joint=(np.nan, np.nan),
        )

    loops = {
        "one": Made(starred=(0.0, -61.3), errors=(9.0, 2.0)),
        "two": Made(starred=(0.0, -49.1), errors=(9.0, 1.0)),
    }
    monkeypatch.setattr(paper_identification, "closed_loop", lambda record, axis: loops[record])
    rows = [astuple(row)[1:] for row in constants(Made(constant=constant, free=["one", "two"]))]  # type: ignore[arg-type]
    assert rows[:3] == [("230 ± 66", "230", "10", "11.0 ± 1.5", "12.0 ± 2.5", ""),
        ("-16 ± 10", "-14", "20", "22.0 ± 1.5", "24.0 ± 2.5", ""),
        ("-40 ± 12", "", "30", "33.0 ± 1.5", "36.0 ± 2.5", "")]  # fmt: skip
    starred = [interval_text(value, SIGMAS * error) for value, error in ((-61.3, 2.0), (-49.1, 1.0))]
    assert rows[3:] == [("-60", "", "18", starred[0], "", ""), ("-48.5", "", "18.5", starred[1], "", "")]
    with pytest.raises(LabError, match=r"^x: fell$"):
        paper_identification.identified([Made(outcome="lost", folder="x", error="fell")])  # type: ignore[list-item]


def test_the_sizes_are_similar_robots_each_in_the_updraft_that_carries_it() -> None:
    configs = [load_config(profile) for profile in SIZES]
    lengths = np.array([config.geometry.footprint for config in configs])
    masses = np.array([weigh(config.geometry).mass for config in configs])
    speeds = np.array([config.tunnel.speed for config in configs])
    assert lengths / lengths[1] == pytest.approx([0.5, 1.0, 2.0])
    assert masses / masses[1] == pytest.approx((lengths / lengths[1]) ** 3)
    assert speeds / speeds[1] == pytest.approx(np.sqrt(lengths / lengths[1]))
    assert [point_of(config).speed for config in configs] == pytest.approx(speeds)
