"""The core's float32 functions against numpy in float64, over everything that a float32 can hold."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from firmware_py.core import maths

f32 = np.float32
law = settings(deadline=None)  # the first call compiles
any_number = st.floats(width=32)  # NaN, infinities, denormals and -0.0 included
angles = st.floats(-1000, 1000, width=32)
finite = st.floats(width=32, allow_nan=False, allow_infinity=False)
LARGEST = float(np.finfo(f32).max)


def turn_apart(a: float, b: float) -> float:
    """Return the distance of two angles on the circle."""
    return abs(math.remainder(a - b, 2 * math.pi))


@pytest.mark.long
@law
@given(finite, finite)
@example(0.0, -1.0)
@example(-0.0, -1.0)
@example(1.0, 0.0)
@example(-1.401298464324817e-45, 1.401298464324817e-45)
@example(LARGEST, -LARGEST)
@example(1.0, 0.4142135679721832)
def test_arc_tangent_is_exact_to_3e_7_on_the_circle(y: float, x: float) -> None:
    got = float(maths.atan2(f32(y), f32(x)))
    if x == 0.0 and y == 0.0:
        assert got == 0.0
    else:
        assert turn_apart(got, math.atan2(y, x)) < 3e-7
        assert math.copysign(1, got) == math.copysign(1, y) or y == 0.0


@pytest.mark.long
@law
@given(st.floats(-1, 1, width=32) | any_number)
@example(1.0)
@example(-1.0)
@example(0.9999999403953552)
def test_arc_sine_is_exact_to_3e_7_and_saturates_outside_its_domain(x: float) -> None:
    expected = math.asin(min(max(x, -1.0), 1.0)) if x == x else -math.pi / 2
    assert float(maths.asin(f32(x))) == pytest.approx(expected, abs=3e-7)


@pytest.mark.long
@law
@given(st.floats(-10, 10, width=32))
@example(3.1415927410125732)
@example(-3.1415927410125732)
@example(9.42477798461914)
def test_wrapped_angle_is_the_same_angle_inside_half_a_turn(x: float) -> None:
    got = float(maths.wrap(f32(x)))
    assert turn_apart(got, x) < 5e-7
    assert abs(got) <= float(f32(math.pi))


@pytest.mark.long
@law
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@given(any_number, any_number)
@example(math.nan, math.nan)
@example(math.inf, -math.inf)
@example(math.nan, 1.0)
@example(1.0, math.nan)
@example(math.inf, 1.0)
def test_no_number_gives_more_than_a_bounded_number(y: float, x: float) -> None:
    for function in (maths.sin, maths.cos):
        assert abs(float(function(f32(x)))) <= 1.0 + 1e-7
    for angle in (maths.wrap(f32(x)), maths.atan2(f32(y), f32(x))):
        assert abs(float(angle)) <= float(f32(math.pi))
    assert abs(float(maths.asin(f32(x)))) <= math.pi / 2 + 3e-7


@pytest.mark.long
@law
@given(angles | any_number)
@example(1000.0)
@example(-1000.0)
@example(0.7853981852531433)
def test_sine_and_cosine_are_exact_to_1e_7_wrap_to_6e_5_and_saturate_beyond_1000_rad(x: float) -> None:
    held = float(np.clip(x, -1000.0, 1000.0)) if x == x else -1000.0
    assert float(maths.sin(f32(x))) == pytest.approx(math.sin(held), abs=1.0e-7)
    assert float(maths.cos(f32(x))) == pytest.approx(math.cos(held), abs=1.0e-7)
    assert turn_apart(float(maths.wrap(f32(x))), held) < 6e-5


@pytest.mark.long
@law
@given(any_number, finite, finite)
def test_clamp_is_numpys_and_takes_nan_to_the_lower_bound(x: float, a: float, b: float) -> None:
    low, high = min(a, b), max(a, b)
    expected = low if x != x else float(np.clip(x, low, high))
    assert float(maths.clamp(f32(x), f32(low), f32(high))) == expected


@pytest.mark.long
@law
@given(any_number)
def test_finite_is_numpys(x: float) -> None:
    assert bool(maths.finite(f32(x))) == bool(np.isfinite(x))


@pytest.mark.long
@law
@given(finite)
@example(9.019999504089355)
@example(-9.020000457763672)
@example(1e-45)
@example(LARGEST)
def test_hyperbolic_tangent_is_exact_to_4e_7_and_never_beyond_one(x: float) -> None:
    got = float(maths.tanh(f32(x)))
    assert got == pytest.approx(math.tanh(x), abs=4e-7)
    assert abs(got) <= 1.0
    assert math.copysign(1, got) == math.copysign(1, x)


def test_hyperbolic_tangent_is_exact_to_4e_7_of_its_value_everywhere() -> None:
    x = np.concatenate([np.linspace(-9.1, 9.1, 40_001), np.logspace(-30, 0, 2_001)]).astype(f32)
    x = x[x != 0]
    exact = np.tanh(x.astype(float))
    assert np.abs(np.array([maths.tanh(a) for a in x]) / exact - 1).max() < 4e-7


def test_hyperbolic_tangent_of_nan_is_nan() -> None:
    assert np.isnan(maths.tanh(f32(math.nan)))
