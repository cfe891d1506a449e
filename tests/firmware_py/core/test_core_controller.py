"""Controller and allocation against the original firmware's recorded outputs and a matrix form in numpy.

MIX is eq. (input_signals) of the paper; the openings of the flaps are their angles times SIGNS.
"""

import functools
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from firmware_py.config import parameters_of
from firmware_py.core.structs import MODE_FLY, MODE_HOVER, MODE_MANUAL
from firmware_py.core.subset import Block
from firmware_py.core_runner import CoreBlocks, default_runner
from hil.config import load_config
from support.paths import VECTORS

ROWS = json.loads((VECTORS / "original_controller.json").read_text())["rows"]
STATES = np.array([row["state"] for row in ROWS])
C = np.array([row["compound_c0_c3"] for row in ROWS])
FLAPS = np.array([row["flaps_rad"] for row in ROWS])
AS_FLOWN = ("allocation.hover_angle=0.393", "controller.limit_u=0.5895", "controller.limit_u3=0.5895")

MIX = np.array([[1, 1, -1, -1], [1, -1, -1, 1], [-1, -1, -1, -1], [-1, 1, -1, 1]])
SIGNS = np.array([1, -1, 1, -1])
HOVER = math.radians(25)
SMALL = 3e-6  # float32 against float64
TABLE_SINE = 4e-5  # the original interpolates a table of 512 sines: 1.9e-5, times the gains
law = settings(deadline=None, max_examples=100)

number = st.floats(-1.375, 1.375, width=32)
four = st.tuples(*4 * (number,))
any_number = st.floats(width=32)


config = functools.cache(load_config)


class Loop:
    """The controller alone, on a state that the test writes."""

    def __init__(self, profile: str = "floaty", overrides: tuple[str, ...] = ()) -> None:
        self.core = CoreBlocks(parameters_of(config(profile, overrides)), default_runner)
        self.parameters: Block = self.core.parameters
        self.data, self.estimator, self.control = self.core.data, self.core.estimator, self.core.control
        self.data.fields.mode = MODE_FLY

    def step(self, state: object = None) -> None:
        if state is not None:
            self.estimator.fields.now[: np.size(state)] = state
        self.core.run.call("control")

    @property
    def u(self) -> NDArray[np.float64]:
        return self.control.fields.u.astype(float)

    @property
    def flaps(self) -> NDArray[np.float64]:
        return self.control.fields.flap.astype(float)

    def forget_height_priority(self) -> None:
        """Let the flaps go anywhere, so that the height never has to give way."""
        self.parameters.fields.opening_min, self.parameters.fields.opening_max = -10.0, 10.0


def identity_loop() -> Loop:
    """Return a loop in which u1..u4 are what the test writes into roll, pitch, r and vz."""
    loop = Loop()
    for name in loop.parameters.memory.dtype.names:
        if name.startswith("gain_"):
            loop.parameters.memory[name] = 0.0
    for name in ("gain_roll", "gain_pitch", "gain_r", "gain_vz"):
        loop.parameters.memory[name] = -1.0
    for name in ("limit_u", "limit_u3"):
        loop.parameters.memory[name] = 1.5
    return loop


def allocate(u: tuple[float, ...], loop: Loop | None = None) -> Loop:
    loop = loop or identity_loop()
    state = np.zeros(16)
    state[6], state[7], state[11], state[5] = u
    loop.step(state)
    return loop


def height_range(
    u: object, hover: float = HOVER, least: float = 0.0, most: float = 0.9
) -> tuple[float, float]:
    """Return the u4 between which no flap saturates; low > high when there is none."""
    d = SIGNS * (MIX[:, :3] @ np.asarray(u, float)[:3])
    return hover + d.max() - most, hover + d.min() - least


# Against the original firmware


def original(state: NDArray[np.float64], free: bool) -> Loop:
    loop = Loop("as-flown", AS_FLOWN)
    if free:
        loop.forget_height_priority()
    loop.step(state)
    return loop


@pytest.mark.long
def test_attitude_inputs_of_all_300_states_are_the_original_firmwares() -> None:
    for state, c in zip(STATES, C, strict=True):
        u1, u2, u3, _ = original(state, free=False).u
        assert u2 == pytest.approx(-c[0], abs=TABLE_SINE)
        assert u3 == pytest.approx(c[3], abs=TABLE_SINE)
        y_integral = 0.4 * 0.15 * 0.01  # theirs integrates y as well: at most this in its first step
        assert u1 == pytest.approx(-c[1], abs=y_integral + TABLE_SINE)


@pytest.mark.long
def test_height_input_without_priority_is_the_original_firmwares_up_to_its_upper_limit() -> None:
    limited = 0
    for state, c in zip(STATES, C, strict=True):
        u4 = original(state, free=True).u[3]
        limited += c[2] > 0.393 - TABLE_SINE
        assert min(u4, 0.393) == pytest.approx(c[2], abs=TABLE_SINE)
    assert 0 < limited < 150


@pytest.mark.long
def test_flaps_without_priority_are_the_original_firmwares() -> None:
    compared = 0
    for state, c, flaps in zip(STATES, C, FLAPS, strict=True):
        if c[2] < 0.393 - TABLE_SINE:
            opening = SIGNS * original(state, free=True).flaps
            assert SIGNS * np.clip(opening, 0.0, 0.9) == pytest.approx(flaps, abs=7e-4)
            compared += 1
    assert compared > 190


@pytest.mark.long
def test_where_no_flap_saturates_height_and_flaps_are_the_original_firmwares() -> None:
    given_way = 0
    for state, c, flaps in zip(STATES, C, FLAPS, strict=True):
        low, high = height_range((-c[1], -c[0], c[3]), hover=0.393)
        loop = original(state, free=False)
        if low <= c[2] <= high:
            assert loop.u[3] == pytest.approx(c[2], abs=TABLE_SINE)
            assert loop.flaps == pytest.approx(flaps, abs=7e-4)
        else:
            given_way += 1
            nearest = np.clip(c[2], low, high) if low <= high else (low + high) / 2
            assert loop.u[3] == pytest.approx(nearest, abs=2e-3)
    assert given_way == len(ROWS) - 3  # the recorded states are wild: only three need no priority


# Feedback


states = st.lists(st.floats(-3, 3, width=32), min_size=12, max_size=12)


@pytest.mark.long
@law
@given(states, st.tuples(*4 * (st.floats(-2, 2, width=32),)))
def test_feedback_is_the_papers_in_the_heading_frame(state: list[float], target: tuple[float, ...]) -> None:
    loop = Loop()
    loop.forget_height_priority()
    loop.parameters.fields.target[:] = target
    loop.step(state)
    p, v, (roll, _, yaw), (p_rate, _, r_rate) = np.array(state).reshape(4, 3)
    to_heading = Rotation.from_euler("z", -yaw)
    e, v = to_heading.apply(np.array(target[:3]) - p), to_heading.apply(v)
    e[:2] = np.clip(e[:2], -0.15, 0.15)
    e_yaw = math.remainder(target[3] - yaw, 2 * math.pi)
    integral = np.clip(0.01 * e[2], -0.1, 0.1)
    expected = [
        np.clip(-1.8 * e[1] + 0.78 * v[1] - 1.04 * roll - 0.046 * p_rate, -0.654498, 0.654498),
        np.clip(-2.4 * e[0] + 1.15 * v[0], -0.654498, 0.654498),
        np.clip(1.2 * e_yaw - 0.12 * r_rate, -0.46, 0.46),
        np.clip(3.0 * e[2] - 0.6 * v[2] + integral, -0.654498, 0.654498),
    ]
    if abs(abs(e_yaw) - math.pi) < 1e-5:
        expected[2] = loop.u[2]  # half a turn: either way is right
    assert loop.u == pytest.approx(np.array(expected), abs=1e-5)


def test_height_error_is_integrated_at_100_hz_up_to_its_limit_and_forgotten_when_the_loop_opens() -> None:
    loop = Loop()
    for step in range(1, 31):
        loop.step([0, 0, -0.2])
        assert loop.control.fields.integral_z == pytest.approx(min(0.01 * 0.2 * step, 0.1), abs=1e-6)
    for _ in range(30):
        loop.step([0, 0, -0.2])
    assert loop.control.fields.integral_z == pytest.approx(0.1)
    for mode in (MODE_HOVER, MODE_MANUAL):
        loop.control.fields.integral_z = 0.1
        loop.data.fields.mode = mode
        loop.step()
        assert loop.control.fields.integral_z == 0.0
        assert not loop.u.any()


# Allocation


@pytest.mark.long
@law
@given(four)
def test_allocation_is_the_matrix_form_of_the_priority_rule(u: tuple[float, ...]) -> None:
    low, high = height_range(u)
    u4 = (low + high) / 2 if low > high else np.clip(u[3], low, high)
    openings = HOVER + SIGNS * (MIX @ [*u[:3], u4])
    loop = allocate(u)
    assert loop.flaps == pytest.approx(SIGNS * np.clip(openings, 0.0, 0.9), abs=SMALL)
    assert loop.control.fields.command == pytest.approx(loop.flaps - SIGNS * HOVER, abs=SMALL)


@pytest.mark.long
@law
@given(st.tuples(*4 * (any_number,)), any_number, any_number)
def test_openings_never_leave_their_limits(u: tuple[float, ...], gain: float, hover: float) -> None:
    loop = identity_loop()
    loop.parameters.fields.gain_roll = gain
    loop.parameters.fields.hover_angle = hover
    openings = SIGNS * allocate(u, loop).flaps
    assert openings.min() >= 0.0
    assert openings.max() <= float(np.float32(0.9))
    assert all(21_000 <= count <= 42_000 for count in loop.control.fields.count)


@pytest.mark.long
@law
@given(st.tuples(*4 * (st.floats(-0.3125, 0.3125, width=32),)))
def test_attitude_inputs_are_realised_exactly_whenever_any_height_allows_it(u: tuple[float, ...]) -> None:
    low, high = height_range(u)
    realised = MIX.T @ (allocate(u).flaps - SIGNS * HOVER) / 4  # the columns of MIX are orthogonal, length 2
    if low <= high:
        assert realised[:3] == pytest.approx(np.array(u[:3]), abs=SMALL)
        candidates = np.linspace(low, high, 101)
        assert abs(realised[3] - u[3]) <= np.abs(candidates - u[3]).min() + SMALL  # height gives way least
    assert low - SMALL <= realised[3] <= high + SMALL or low > high


# Modes


@pytest.mark.parametrize("mode", [MODE_HOVER, 3, -1])
def test_open_loop_holds_the_hover_angles_whatever_the_state(mode: int) -> None:
    loop = Loop()
    loop.data.fields.mode = mode
    loop.step([1.0] * 12)
    assert loop.flaps == pytest.approx(SIGNS * HOVER, abs=SMALL)
    assert not loop.control.fields.command.any()


@pytest.mark.long
@law
@given(st.tuples(*4 * (any_number,)))
def test_angles_from_outside_are_held_within_a_quarter_turn(angles: tuple[float, ...]) -> None:
    loop = Loop()
    loop.data.fields.mode = MODE_MANUAL
    loop.data.fields.manual[:] = angles
    loop.step()
    expected = [-math.pi / 2 if a != a else np.clip(a, -math.pi / 2, math.pi / 2) for a in angles]
    assert loop.flaps == pytest.approx(expected, abs=SMALL)
    assert loop.control.fields.command == pytest.approx(np.array(expected) - SIGNS * HOVER, abs=SMALL)
