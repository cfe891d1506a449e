"""What a learned law sees and what its answer means, against scipy's rotation and the profile's limits."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from firmware_py.config import parameters_of
from firmware_py.core.observation import ACTIONS, OBSERVATIONS, act, observe
from firmware_py.core.structs import Control, Estimator
from hil.config import load_config

CONFIG = load_config("floaty")
number = st.floats(-1.5, 1.5, width=32)


@pytest.mark.long
@settings(deadline=None, max_examples=100)
@given(st.tuples(*16 * (number,)), st.tuples(*4 * (number,)), st.tuples(*4 * (number,)))
def test_an_observation_is_error_and_motion_in_heading_frame(state: Any, target: Any, previous: Any) -> None:
    parameters, estimator = parameters_of(CONFIG), Estimator.allocate()
    estimator.fields.now[:], parameters.fields.target[:] = state, target
    out = np.full(OBSERVATIONS, np.nan, np.float32)
    observe(parameters.fields, estimator.fields, np.array(previous, np.float32), out)
    yaw = state[8]
    R_HG = Rotation.from_euler("z", -yaw)
    error_H = R_HG.apply(np.subtract(target[:3], state[:3]))
    limit = float(parameters.fields.limit_xy)
    error_H[:2] = np.clip(error_H[:2], -limit, limit)
    yaw_error = math.remainder(target[3] - yaw, 2 * math.pi)
    expected = [*error_H, *R_HG.apply(state[3:6]), state[6], state[7], yaw_error, *state[9:], *previous]
    assert out.tolist() == pytest.approx(expected, abs=2e-6)


def test_an_action_is_limited_and_means_a_share_of_each_input_s_limit() -> None:
    parameters, control = parameters_of(CONFIG), Control.allocate()
    parameters.fields.limit_u, parameters.fields.limit_u3 = 0.5, 0.25
    action = np.array([3.0, -0.5, 0.5, -math.inf], np.float32)
    act(parameters.fields, action, control.fields)
    assert action.tolist() == [1.0, -0.5, 0.5, -1.0]
    assert control.fields.u.tolist() == [0.5, -0.25, 0.125, -0.5]


def test_a_nan_action_stays_nan_for_the_guard() -> None:
    parameters, control = parameters_of(CONFIG), Control.allocate()
    act(parameters.fields, np.full(ACTIONS, np.nan, np.float32), control.fields)
    assert np.isnan(control.fields.u).all()
