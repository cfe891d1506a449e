"""The arithmetic behind the paper's table, the studies and tuning: spreads, misses, medians, what counts as better."""

from math import isnan, nan, sqrt
from types import SimpleNamespace
from typing import Any

import pytest

from hil.config import load_config
from hil.errors import LabError
from hil.research.design.tune import GainTask, refuse_late
from hil.research.studies.paper import Paper, Spread, Trials
from hil.research.studies.study import outcome_of


def result(outcome: str = "completed", passed: bool = True, **metrics: float) -> Any:
    return SimpleNamespace(outcome=outcome, passed=passed, metrics={"failsafe": 0.0} | metrics, failed=[])


def placed(x: float, y: float = 0.0, z: float = 0.0, **more: Any) -> Any:
    return result(rms_x=x, rms_y=y, rms_z=z, **more)


def test_a_spread_is_the_sample_s_deviation_in_the_displayed_unit() -> None:
    spread = Spread.of("rms_x", [placed(value) for value in (0.01, 0.02, 0.04, nan)])
    assert (spread.unit, spread.count, spread.low, spread.high) == ("cm", 3, 1.0, 4.0)
    assert spread.mean == pytest.approx(7 / 3)
    assert spread.deviation == pytest.approx(sqrt((16 + 1 + 25) / 9 / 2))
    assert isnan(Spread.of("rms_x", [placed(0.01)]).deviation)
    assert str(Spread.of("rms_x", [placed(nan)])) == str(Spread.of("held_up_to", [placed(0.01)])) == "–"
    assert str(Spread.of("lost", [result(lost=0.0)])) == "0"


@pytest.mark.parametrize(
    ("metric", "bound", "value", "missed"),
    [
        ("rms_x", 0.02, 0.03, "misses by 1 cm"),
        ("rms_x", 0.03, 0.02, ""),
        ("rms_x", 0.03, 0.03, ""),
        ("peak_rate", 2.0, 1.5, "misses by 29 deg/s"),
        ("peak_rate", 1.5, 2.0, ""),
    ],
)
def test_a_value_misses_the_paper_s_when_worse(metric: str, bound: float, value: float, missed: str) -> None:
    row: Any = SimpleNamespace(claims={metric: SimpleNamespace(bound=bound)})
    assert Trials("floaty", (result(**{metric: value}),)).missed(row, metric) == missed


def test_the_misses_of_both_profiles_are_those_of_their_means() -> None:
    row: Any = SimpleNamespace(claims={name: SimpleNamespace(bound=0.5) for name in ("settle", "rms_x")})
    slow, fast = (result(settle=settle, rms_x=0.4) for settle in (0.75, 0.45))
    good, bad = Trials("floaty", (fast, fast)), Trials("as-flown", (slow, fast))
    assert Paper((("x", row, (good, bad)),), (), False).misses == [
        (row, "as-flown", ["settle misses by 0.1 s"])
    ]


def test_a_row_holds_when_every_one_of_its_flights_does_and_there_are_some() -> None:
    assert Trials("floaty", (result(), result())).holds
    assert not Trials("floaty", (result(), result(passed=False))).holds
    assert not Trials("floaty", ()).holds


def test_the_representative_flight_has_the_median_error_and_a_lost_one_is_the_worst() -> None:
    lost, *flown = placed(0.0, outcome="lost"), placed(0.03), placed(0.01), placed(0.02)
    assert Trials("floaty", (lost, *flown)).representative_first() == [flown[2], flown[1], flown[0], lost]
    assert Trials("floaty", tuple(flown)).representative_first() == [flown[2], flown[1], flown[0]]
    assert Trials("floaty", (lost,)).representative_first() == [lost]


@pytest.mark.parametrize(
    ("flown", "outcome"),
    [
        (result(), "holds"), (result(passed=False), "degrades"), (result(failsafe=0.01), "failsafe"),
        (result("reset"), "failsafe"), (result("lost", failsafe=1.0), "lost"), (result("error"), "error"),
        (result("interrupted"), "error"),
    ],
)  # fmt: skip
def test_a_flight_holds_degrades_is_opened_by_the_supervisor_lost_or_an_error(
    flown: Any, outcome: str
) -> None:
    assert outcome_of(flown) == outcome


@pytest.mark.parametrize(
    ("delay_ms", "late_ms", "refused"), [(5, 9, False), (4.9, 9, True), (9, 4.9, True), (9, 5, False)]
)
def test_gains_with_less_margin_than_the_link_fail(delay_ms: float, late_ms: float, refused: bool) -> None:
    axis: Any = SimpleNamespace(
        least=SimpleNamespace(delay=1e-3 * delay_ms),
        least_late=1e-3 * late_ms,
        axis=SimpleNamespace(label="yaw"),
    )
    if not refused:
        refuse_late([axis], 5e-3)
        return
    with pytest.raises(
        LabError, match=r"refused: yaw tolerates 4\.9 ms of delay, and poses arrive up to 5\.0 ms"
    ):
        refuse_late([axis], 5e-3)


def test_the_flaps_have_the_smaller_way_to_their_limits() -> None:
    near = load_config("floaty", ["allocation.opening_min=0.2", "allocation.opening_max=0.8"]).allocation
    task: Any = SimpleNamespace(config=SimpleNamespace(allocation=near))
    assert GainTask.flap_range.fget(task) == pytest.approx(
        min(0.8 - near.hover_angle, near.hover_angle - 0.2)
    )
