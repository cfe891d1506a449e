"""The errors that metrics are made of are those that the board flies on."""

from math import pi

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.geometry import from_euler_zyx, in_goal_frame, to_euler_zyx
from hil.laboratory.metrics import attitude_error, position_error

length, angle, tilt = st.floats(-3.0, 3.0), st.floats(-pi, pi), st.floats(-1.2, 1.2)
place = st.tuples(length, length, length)
rows = st.tuples(place, st.tuples(tilt, tilt, angle).map(lambda euler: from_euler_zyx(*euler)), place, angle)


@given(st.lists(rows, min_size=1, max_size=5))
def test_errors_are_the_pose_in_the_goal_frame(flight) -> None:
    values = np.array([(*p_WB, *q_WB, *p_WG, yaw) for p_WB, q_WB, p_WG, yaw in flight]).T
    names = [f"truth.{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    names += [f"goal.{name}" for name in ("x", "y", "z", "yaw")]
    table = pa.table(dict(zip(names, values, strict=True)))
    poses = [in_goal_frame(*row) for row in flight]
    assert position_error(table) == pytest.approx(np.array([p_GB for p_GB, _ in poses]), abs=1e-12)
    off = attitude_error(table) - np.array([to_euler_zyx(q_GB) for _, q_GB in poses])
    off[:, 2] = np.remainder(off[:, 2] + pi, 2 * pi) - pi  # half a turn is the same either way
    assert off == pytest.approx(np.zeros_like(off), abs=1e-9)
