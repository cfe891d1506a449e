"""A failing flight is reduced to the least that still fails: planted robots say what that is."""

import math
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from hil.errors import LabError
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import Fault, parse
from hil.research.campaigns.sampling import draw
from hil.research.campaigns.shrink import Reflight, Trial, harmless, shrink
from support.campaigns import spec_of

FAULTS = (
    "mocap.dropout@1:2=1",
    "push.y@1:3=12",
    "servo.slow.1@0=0.1",
    "imu.saturation@0=5",
    "wind.side_y@0=-6",
)
DURATION_S = 10.0


def trial(*faults: str, settings: tuple[str, ...] = ("a.b=1", "c.d=2")) -> Trial:
    return Trial(settings, tuple(map(parse, faults)))


def size_of(one: Trial, kind: str, otherwise: float) -> float:
    return next((fault.size for fault in one.faults if fault.kind == kind), otherwise)


def span_of(one: Trial, kind: str) -> float:
    return next((fault.duration_s for fault in one.faults if fault.kind == kind), 0.0)


def test_only_the_fault_that_matters_is_left_with_the_smallest_size_and_time_that_fail() -> None:
    least = shrink(
        trial(*FAULTS),
        DURATION_S,
        lambda one: size_of(one, "push.y", 0.0) >= 7.0 and span_of(one, "push.y") >= 0.5,
    )
    (push,) = least.faults
    assert (push.kind, push.start_s) == ("push.y", 1.0)
    assert 7.0 <= push.size <= 7.0 + 12.0 / 64
    assert 0.5 <= push.duration_s <= 0.5 + 3.0 / 64
    assert least.settings == ()


@pytest.mark.parametrize(
    ("kind", "fails", "low", "high"),
    [
        ("servo.slow.1", lambda size: size <= 0.4, 0.4 - 0.9 / 64, 0.4),
        ("imu.saturation", lambda size: size <= 50.0, 50.0 - 1995 / 64, 50.0),
        ("wind.side_y", lambda size: size <= -2.0, -2.0 - 6.0 / 64, -2.0),
        ("mocap.dropout", lambda size: size >= 0.3, 0.3, 0.3 + 1.0 / 64),
    ],
)
def test_sizes_shrink_to_harmless(kind: str, fails: Callable[[float], bool], low: float, high: float) -> None:
    least = shrink(trial(*FAULTS), DURATION_S, lambda one: fails(size_of(one, kind, harmless(kind) or 0.0)))
    (fault,) = least.faults
    assert fault.kind == kind
    assert low <= fault.size <= high


def test_two_faults_that_fail_together_are_both_reduced() -> None:
    least = shrink(
        trial(*FAULTS),
        DURATION_S,
        lambda one: size_of(one, "push.y", 0.0) >= 7.0 and span_of(one, "mocap.dropout") >= 0.5,
    )
    assert {fault.kind for fault in least.faults} == {"push.y", "mocap.dropout"}
    assert 7.0 <= size_of(least, "push.y", 0.0) <= 7.0 + 12.0 / 64
    assert 0.5 <= span_of(least, "mocap.dropout") <= 0.5 + 2.0 / 64


def test_a_parameter_without_which_it_holds_stays_and_each_other_part_costs_two_flights() -> None:
    """Besides the whole: one without all parameters, which holds, and one without the part; the last holds."""
    flown: list[Trial] = []

    def fails(one: Trial) -> bool:
        flown.append(one)
        return "c.d=2" in one.settings

    assert shrink(trial(*FAULTS), DURATION_S, fails) == Trial(("c.d=2",), ())
    assert len(flown) == 1 + 2 * (len(FAULTS) + 1) + 1


def test_a_fault_to_the_end_that_needs_all_its_time_stays_as_it_is_written() -> None:
    fault = Fault("servo.stuck.1", 2.0, math.inf, 0.0)
    least = shrink(Trial((), (fault,)), DURATION_S, lambda one: one.faults == (fault,))
    assert least.faults == (fault,)


def test_a_fault_that_the_flights_end_cuts_off_lasts_no_longer_than_to_there() -> None:
    tried: list[float] = []

    def fails(one: Trial) -> bool:
        tried.extend(fault.duration_s for fault in one.faults)
        return bool(one.faults)

    shrink(trial("push.y@8:9=12", settings=()), DURATION_S, fails)
    assert max(span for span in tried if span != 9.0) <= DURATION_S - 8.0


def test_a_flight_that_fails_differently_is_not_the_shrunk_one_and_each_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def flown(outcome: str, *failed: str, cause: str = "") -> SimpleNamespace:
        broken = [SimpleNamespace(metric=name) for name in failed]
        return SimpleNamespace(passed=not failed, outcome=outcome, failed=broken, cause=cause)

    results = [flown("completed", "max_x", "in_box"), flown("lost", "lost", cause="fell"), flown("completed"),
        flown("completed", "max_x")]  # fmt: skip
    limits: list[object] = []
    monkeypatch.setattr(
        "hil.research.campaigns.shrink.fly_within",
        lambda request, limit: limits.append(limit) or results.pop(0),
    )
    spec, told = spec_of(limits={"wall_s": 7.0}), []
    reflight = Reflight(spec, draw(spec, 0), told.append)
    whole = Trial(("a=1",), (parse("push.y@1=2"), parse("push.x@2=3")))
    monkeypatch.setattr(Reflight, "request", lambda reflight, trial: trial)
    assert [reflight.fails(one) for one in (whole, whole, Trial((), ()), whole)] == [True, False, False, True]
    parts = "push.y@1=2 push.x@2=3 a=1"
    assert told == [f"fails: {parts} (max_x, in_box)", f"fails otherwise: {parts} (fell)", "holds: nothing but its seed",
        f"fails: {parts} (max_x)"]  # fmt: skip
    assert limits == [spec.limits] * 4


def test_a_passing_flight_cannot_be_shrunk() -> None:
    with pytest.raises(LabError, match="does not fail"):
        shrink(trial(*FAULTS), DURATION_S, lambda one: False)


def test_harmless_sizes_can_be_written() -> None:
    for name, kind in KINDS.items():
        size = harmless(name)
        if kind.sized:
            assert size is not None
            assert str(Fault(name, 0.0, 1.0, size))
        else:
            assert size is None


def test_the_shrunk_flight_is_the_drawn_one() -> None:
    spec = spec_of(flights=8, sampling="sobol")
    drawn = next(one for one in (draw(spec, index) for index in range(8)) if one.options["faults"])
    reflight = Reflight(spec, drawn, print)
    settings, faults = drawn.options["overrides"], drawn.options["faults"]
    assert reflight.whole == Trial(tuple(settings), tuple(parse(str(fault)) for fault in faults))
    request = reflight.request(reflight.whole)
    assert (request.seed, request.overrides) == (drawn.options["seed"], settings)
    assert request.planned_faults == reflight.whole.faults
