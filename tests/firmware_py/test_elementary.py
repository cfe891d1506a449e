"""The elementary functions against the C library's, and their bits: plain and compiled, on every processor."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py import elementary
from hil.world import fixed_order

angles = st.floats(-1e6, 1e6)
ULPS = 6  # ours come within 5, the C library within 1


def ulps(value: float, exact: float) -> float:
    return abs(value - exact) / math.ulp(exact)


@given(angles)
def test_sine_cosine_and_tangent(angle: float) -> None:
    assert ulps(elementary.sin(angle), math.sin(angle)) <= ULPS
    assert ulps(elementary.cos(angle), math.cos(angle)) <= ULPS
    assert ulps(elementary.tan(angle), math.tan(angle)) <= ULPS


@pytest.mark.parametrize("quarters", range(-9, 10))
def test_multiples_of_a_quarter_turn(quarters: int) -> None:
    angle = quarters * math.pi / 2
    assert elementary.sin(angle) == pytest.approx(math.sin(angle), abs=1e-16)
    assert elementary.cos(angle) == pytest.approx(math.cos(angle), abs=1e-16)


@pytest.mark.long
@given(st.floats(-745.0, 709.0))
def test_exponential(x: float) -> None:
    assert ulps(elementary.exp(x), math.exp(x)) <= ULPS


def test_exponential_beyond_the_range() -> None:
    assert elementary.exp(-1e300) == elementary.exp(-math.inf) == 0.0
    assert elementary.exp(1e300) == elementary.exp(math.inf) == math.inf


@pytest.mark.long
@given(st.one_of(st.floats(-1.0, 1.0, exclude_min=True), st.floats(0.0, 1e300), st.floats(-1e-9, 1e-9)))
def test_logarithm(x: float) -> None:
    assert ulps(elementary.log_1p(x), math.log1p(x)) <= ULPS


@pytest.mark.long
@given(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9))
def test_angle_of_a_vector(y: float, x: float) -> None:
    x += 0.0  # no zero below zero
    angle = elementary.atan2(y, x)
    assert ulps(angle, math.atan2(y, x)) <= ULPS
    assert math.copysign(1.0, angle) == math.copysign(1.0, y)


@pytest.mark.long
@given(st.floats(-1.0, 1.0))
def test_arc_sine(x: float) -> None:
    assert ulps(elementary.asin(x), math.asin(x)) <= ULPS


@pytest.mark.long
@given(st.floats(0.5, 1.0), st.integers(0, 400))
def test_whole_powers(base: float, exponent: int) -> None:
    assert elementary.power(base, exponent) == pytest.approx(base**exponent, rel=1e-13)


def test_compiled_functions_have_the_bits_of_plain_ones() -> None:
    rng = np.random.default_rng(1)
    for angle, other in rng.uniform(-100.0, 100.0, (5000, 2)).tolist():
        assert fixed_order.sine_ahead(angle, 0) == elementary.sin(angle)
        assert fixed_order.sine_ahead(angle, 1) == elementary.cos(angle)
        assert fixed_order.exp(0.1 * angle) == elementary.exp(0.1 * angle)
        assert fixed_order.atan2(angle, other) == elementary.atan2(angle, other)
