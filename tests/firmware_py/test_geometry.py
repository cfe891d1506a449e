"""Attitudes against scipy."""

from math import pi

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from firmware_py import geometry

component = st.floats(-1.0, 1.0)
angle = st.floats(-pi, pi)
vector = st.tuples(*[st.floats(-10.0, 10.0)] * 3)


@st.composite
def quaternions(draw):
    q = np.array(draw(st.tuples(component, component, component, component)))
    norm = np.linalg.norm(q)
    assume(norm > 1e-3)
    return tuple((q / norm).tolist())


def scipy_of(q):
    return Rotation.from_quat(q, scalar_first=True)


@pytest.mark.long
@given(quaternions(), quaternions())
def test_product_is_scipys_composition(a, b):
    ours = scipy_of(geometry.multiply(a, b))
    assert (ours.inv() * (scipy_of(a) * scipy_of(b))).magnitude() < 1e-9
    assert geometry.multiply(geometry.conjugate(a), a) == pytest.approx(geometry.IDENTITY, abs=1e-12)


@pytest.mark.long
@given(quaternions(), vector)
def test_rotation_of_a_vector_is_scipys(q, v):
    assert geometry.rotate(q, v) == pytest.approx(scipy_of(q).apply(v), abs=1e-9)
    assert geometry.rotation_matrix(q) @ v == pytest.approx(scipy_of(q).apply(v), abs=1e-9)


@pytest.mark.long
@given(angle, angle, angle)
def test_euler_angles_become_scipys_attitude(roll, pitch, yaw):
    ours = scipy_of(geometry.from_euler_zyx(roll, pitch, yaw))
    assert (ours.inv() * Rotation.from_euler("ZYX", (yaw, pitch, roll))).magnitude() < 1e-9


@pytest.mark.long
@given(quaternions())
def test_attitude_becomes_scipys_euler_angles(q):
    assume(abs(scipy_of(q).as_matrix()[2, 0]) < 1 - 1e-6)  # not straight up or down
    yaw, pitch, roll = scipy_of(q).as_euler("ZYX")
    ours = geometry.to_euler_zyx(q)
    difference = [geometry.wrap_angle(a - b) for a, b in zip(ours, (roll, pitch, yaw), strict=True)]
    assert difference == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert geometry.euler_zyx_of(np.array([q, q])) == pytest.approx(np.array([ours, ours]), abs=1e-12)


def test_looking_straight_up_is_a_pitch_of_a_right_angle():
    assert geometry.to_euler_zyx(geometry.from_euler_zyx(0.0, pi / 2, 0.0))[1] == pytest.approx(
        pi / 2, abs=1e-7
    )


@pytest.mark.long
@given(angle, vector)
def test_yaw_turns_about_the_vertical(yaw, v):
    expected = Rotation.from_euler("z", yaw).apply(v)
    assert geometry.rotate(geometry.yaw_quaternion(yaw), v) == pytest.approx(expected, abs=1e-9)


@pytest.mark.long
@given(st.floats(-1000.0, 1000.0))
def test_wrapped_angle_is_the_same_direction_within_half_a_turn(a):
    wrapped = geometry.wrap_angle(a)
    assert -pi < wrapped <= pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * a), abs=1e-9)


def test_half_a_turn_has_one_name():
    assert geometry.wrap_angle(-pi) == geometry.wrap_angle(pi) == pi
