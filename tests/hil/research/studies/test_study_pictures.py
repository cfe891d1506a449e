"""Studies, the mounted robot and tuning: their tables, pictures and costs from values that are all different."""

import csv
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex

from hil.config import load_config
from hil.laboratory.request import Options
from hil.pictures.curves import BLUE, ORANGE
from hil.research.campaigns.jobs import Job, Row
from hil.research.design import optimise, tune
from hil.research.design.axes import ANGLE, ROLL
from hil.research.design.loop import FREQUENCIES
from hil.research.design.optimise import exercise, front
from hil.research.design.tune import Flow, GainTask, cost, motion
from hil.research.learn.tasks import reward_of
from hil.research.studies import drag_model
from hil.research.studies.drag_model import MountedRow
from hil.research.studies.paper_report import study_picture
from hil.research.studies.study import Expected, Study, Variant, summarise


def flight(
    variant: str,
    size: float,
    cm: float,
    outcome: str = "completed",
    passed: bool = True,
    failsafe: float = 0.0,
) -> tuple[Job, Row]:
    """A flight of a study: `cm` is its error along x; along z twice that."""
    job = Job(0, "hover", {}, {"study": "s", "variant": variant, "size": size})
    metrics = {"rms_x": 0.01 * cm, "rms_y": 0.0, "rms_z": 0.02 * cm, "failsafe": failsafe}
    return job, Row(job, outcome, "", passed, "", metrics, {})


def test_a_study_is_summed_up_by_variant_and_size_and_drawn_over_its_sizes() -> None:
    variants = tuple(Variant(name, lambda size: Options(), Expected(holds_to=0.5)) for name in ("first",
        "second", "unflown"))  # fmt: skip
    study = Study("s", "q", "wind", "m/s", (0.0, 0.5, 2.0), variants)
    flown = [flight("second", 2.0, 9.0, "lost"), flight("first", 0.0, 1.0),
        flight("first", 0.5, 2.0, passed=False), flight("first", 0.5, 4.0, failsafe=1.0),
        flight("first", 0.5, 3.0, passed=False), flight("second", 0.0, 5.0),
        flight("second", 0.0, 9.0, "reset"), flight("first", 2.0, 9.0, "error")]  # fmt: skip
    result = summarise(study, flown)
    root = 5.0**0.5  # of 1 and 2
    assert [[(cell.size, cell.outcomes, cell.errors) for cell in curve.cells] for curve in result.curves] == [
        [(0.0, ("holds",), (pytest.approx(0.01 * root),)),
         (0.5, ("degrades", "failsafe", "degrades"), tuple(pytest.approx(0.01 * n * root) for n in (2, 4, 3))), (2.0,
         ("error",), ())],
        [(0.0, ("holds", "failsafe"), (pytest.approx(0.05 * root),)), (2.0, ("lost",), ())],
    ]  # fmt: skip
    assert [curve.variant.name for curve in result.curves] == ["first", "second"]
    above, below = study_picture(result).axes
    assert [(line.get_label(), to_hex(line.get_color())) for line in above.lines] == [("first", BLUE),
        ("second", ORANGE)]  # fmt: skip
    assert above.lines[0].get_xydata() == pytest.approx(np.array([(0, root), (1, 3 * root)]))
    assert above.lines[1].get_xydata() == pytest.approx(np.array([(0, 5 * root)]))
    band = above.collections[0].get_paths()[0].vertices
    assert {round(y / root, 6) for x, y in band.tolist() if x == 1.0} == {2.0, 4.0}
    assert above.get_yscale() == "log"
    cells = [(one.get_position(), one.get_text()) for one in below.texts]
    assert [place for place, _ in cells] == [(0, 0), (1, 0), (2, 0), (0, 1), (2, 1)]
    assert [text.partition(" ")[2] for _, text in cells] == ["", "2/3", "", "1/2", ""]
    assert [text.get_text() for text in below.get_yticklabels()] == ["first", "second"]
    assert [text.get_text() for text in below.get_xticklabels()] == ["0", "0.5", "2"]
    assert below.get_xlabel() == "wind [m/s]"
    assert below.get_ylim()[0] > below.get_ylim()[1], "the first variant is on top"
    centres = [
        (one.get_x() + one.get_width() / 2, one.get_y() + one.get_height() / 2) for one in below.patches
    ]
    assert centres == [pytest.approx(place) for place, _ in cells]


def test_the_mounted_robot_s_table_and_picture_have_model_mean_and_deviation_of_each_quantity(
    tmp_path: Path,
) -> None:
    rows = [MountedRow("kinked", "u1", 10.0 * n, np.arange(6) + n, np.arange(6) + n + 0.5,
        np.full(6, 0.25 * n)) for n in (1, 2, 3)]  # fmt: skip
    drag_model.write_csv(rows, tmp_path / "table.csv")
    header, *lines = csv.reader((tmp_path / "table.csv").read_text(encoding="utf-8").splitlines())
    assert header == [
        "robot",
        "sweep",
        "angle_deg",
        *(f"{q}_{kind}" for q in drag_model.QUANTITIES for kind in ("model", "mean", "deviation")),
    ]
    assert lines[1][:9] == ["kinked", "u1", "20.0", "2", "2.5", "0.5", "3", "3.5", "0.5"]
    for index, axes in enumerate(drag_model._draw(rows, 25.0).axes):
        measured, model, hover = axes.lines
        assert measured.get_xydata().tolist() == [[10.0 * n, index + n + 0.5] for n in (1, 2, 3)]
        assert model.get_xydata().tolist() == [[10.0 * n, float(index + n)] for n in (1, 2, 3)]
        assert (measured.get_label(), model.get_label(), hover.get_xdata()[0]) == ("measured", "model", 25.0)
        band = axes.collections[0].get_paths()[0].vertices
        assert {y for x, y in band.tolist() if x == 20.0} == {index + 2.0, index + 3.0}
        assert axes.get_ylabel() == drag_model.LABELS[index]
        assert axes.get_xlabel() == ("flap angle [deg]" if index > 2 else "")


@pytest.mark.parametrize(("distance", "tilt", "yaw", "change", "reward"),
    [(0, 0, 0, 0, 1.0), (0.03, 0, 0, 0, 0.7), (0, 0.15, 0, 0, 0.9), (0, 0, -0.2, 0, 0.9),
    (0, 0, 0, 2.0, 0.99), (0.06, 0.3, 0.4, 16.0, 0.12)])  # fmt: skip
def test_a_reward_halves_its_parts_at_their_scales(
    distance: float, tilt: float, yaw: float, change: float, reward: float
) -> None:
    assert reward_of(distance, tilt, yaw, change) == pytest.approx(reward)


def task() -> GainTask:
    config = load_config()
    return GainTask(ROLL, Flow(np.zeros((len(FREQUENCIES), 2, 2)), 0.02, 0.1), config, Made(), 0.01)  # type: ignore[arg-type]


def loop(states: list[float], u: float, size: float = 1e-6, radius: float = 0.9, late_s: float = 0.0) -> Any:
    """A loop that answers with these variances, open with an integrator's phase."""
    hertz = np.asarray(FREQUENCIES)
    L = size / (2j * np.pi * hertz) * np.exp(-2j * np.pi * hertz * late_s)
    return Made(radius=lambda gains: radius, response_to=lambda flow, gains: (np.array(states), u),
        open_loop=lambda gains: L)  # fmt: skip


def test_a_cost_is_motion_in_units_and_a_hundred_times_what_exceeds_each_condition() -> None:
    asked, gains, names = task(), np.array([0.5, 0.0, 0.0, 0.0]), ROLL.states
    allocation = asked.config.allocation
    hover, reach = allocation.hover_angle, asked.flap_range
    gains[names.index(ANGLE)] = 0.3
    assert asked.offset(gains) == pytest.approx(-(0.02 + 0.3 * 0.1) / 0.5)
    assert reach == pytest.approx(min(allocation.opening_max - hover, hover - allocation.opening_min))
    allowed, states = tune.OF_FLAPS * reach, [1e-4, 2e-4, 3e-4, 4e-4]
    gains[0] = small = (
        0.2 * reach / asked.config.controller.limit_xy
    )  # a fifth of the flaps at the largest error
    calm = cost(loop(states, 1e-6), asked, gains)
    moved = np.add(states, [asked.offset(gains) ** 2, 0, 0, 0])
    spread = float(np.sqrt(moved[0]))
    far = 100 * max(0.0, tune.SIGMAS * spread / tune.BOX_M - 1.0)
    by_hand = (sum(v / tune.UNITS[state] ** 2 for v, state in zip(moved, names,
        strict=True)) + 1e-6 / allowed**2)  # fmt: skip
    assert calm == pytest.approx(by_hand + far)
    moving = motion(loop(states, 1e-6), asked, gains)
    assert (moving.main, moving.input) == pytest.approx((spread, 1e-3))
    assert cost(loop(states, (1.5 * allowed) ** 2), asked, gains) - calm == pytest.approx(50.0 + 2.25,
        rel=1e-3)  # fmt: skip
    assert cost(loop(states, 1e-6, radius=1.0), asked, gains) == 2.0 * tune.TOO_MUCH
    gains[0] = small * 10.0  # twice the flaps
    near = np.add(states, [asked.offset(gains) ** 2, 0, 0, 0])
    twice = sum(v / tune.UNITS[state] ** 2 for v, state in zip(near, names, strict=True)) + 1e-6 / allowed**2
    far = 100 * max(0.0, tune.SIGMAS * float(np.sqrt(near[0])) / tune.BOX_M - 1.0)
    assert cost(loop(states, 1e-6), asked, gains) == pytest.approx(twice + far + 100.0)
    # an integrator that crosses 1 at 2 rad/s with 60 ms of delay: its margin is (pi/2 - 0.12) / 2 s
    crossing = loop(states, 1e-6, size=2.0, late_s=0.06)
    assert tune.delay_margin(crossing.open_loop(gains)) == pytest.approx((np.pi / 2 - 0.12) / 2.0, rel=1e-3)
    late = replace(asked, delay=(np.pi / 2 - 0.12) / 2.0)
    peak = 100 * max(0.0, tune.peak_of(crossing.open_loop(gains)) / tune.PEAK - 1.0)
    assert cost(crossing, late, gains) == pytest.approx(twice + far + 100.0 + peak + 100.0, rel=1e-3)


def robots(*figures: tuple[float, float]) -> Any:
    return tuple(Made(stiffness=-stable, reached=lambda figure, value=value: value) for stable,
        value in figures)  # fmt: skip


def test_a_front_has_the_robots_that_no_other_beats_in_both_the_most_stable_first() -> None:
    tried = robots((1.0, 5.0), (3.0, 2.0), (2.0, 2.0), (2.5, 4.0), (3.0, 1.0), (0.5, 4.5), (0.1, 9.0))
    assert front(tried, "speed-range").tolist() == [[3.0, 2.0], [2.5, 4.0], [1.0, 5.0], [0.1, 9.0]]


def test_an_exercise_trades_mass_or_span_for_the_lower_updraft(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half the speed is carried with a quarter of the mass, or at twice the span."""
    ranges = {"slow": (9.0, 9.9), "fast": (16.0, 24.0), "none": (np.nan, np.nan)}
    monkeypatch.setattr(optimise, "held", lambda point: ranges[point.name])
    monkeypatch.setattr(optimise, "weigh", lambda geometry: Made(mass=0.4))
    points = {name: Made(point=Made(name=name, geometry=Made(footprint=0.25))) for name in ranges}
    assert exercise(Made(reference=points["slow"], best=points["fast"]), 8.0, 12.0) == [  # type: ignore[arg-type]
        "the robot as it is holds 9.00 to 9.90 m/s, a ratio of 1.100; 1.500 are needed",
        "the best shape holds 16.00 to 24.00 m/s, a ratio of 1.500; 1.500 are needed",
        "with 100 g instead of 400 g at the same span, or 50.0 cm instead of 25.0 cm at the same mass, it holds 8 to "
        "12.00 m/s; the wider one turns by -50 % per input",
    ]
    (line, *_) = exercise(Made(reference=points["none"], best=points["slow"]), 8.0, 12.0)  # type: ignore[arg-type]
    assert line == "the robot as it is does not fly at its hover: no range"
