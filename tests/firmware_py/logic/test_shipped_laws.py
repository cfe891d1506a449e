"""The laws that ship beside the built-in one: only the error to the goal counts, on every axis and from every side."""

from types import ModuleType

import numpy as np
import pytest

from firmware_py.config import parameters_of
from firmware_py.core.structs import ATTITUDE, POSITION, VELOCITY, Control, Estimator
from firmware_py.core.subset import f32
from firmware_py.logic.laws import lqr, original
from firmware_py.logic.loading import load_logic
from hil.config import load_config

GOAL, TURN = np.array([0.3, -0.2, 1.1]), 0.7


def inputs(law: ModuleType, state: np.ndarray, goal: np.ndarray, yaw: float) -> list[float]:
    """u1 to u4 for an estimate (16,) and a target of position and yaw."""
    config = load_config("floaty", (f"logic.controller={law.__name__.rpartition('.')[2]}",))
    logic = load_logic(config.logic)
    assert logic is not None
    parameters, estimator, control = parameters_of(config), Estimator.allocate(), Control.allocate()
    own, memory = law.Gains.allocate(), [law.Memory.allocate().fields] if hasattr(law, "Memory") else []
    for name, value in logic.values.items():
        setattr(own.fields, name, f32(value))
    parameters.fields.target[:3], parameters.fields.target[3] = goal, f32(yaw)
    estimator.fields.now[: len(state)] = state
    law.control_law(parameters.fields, estimator.fields, control.fields, own.fields, *memory)
    return control.fields.u.tolist()  # type: ignore[no-any-return]


@pytest.mark.parametrize("law", [lqr, original], ids=["lqr", "original"])
def test_a_goal_and_a_robot_that_are_moved_and_turned_together_need_the_same_inputs(law: ModuleType) -> None:
    state = np.random.default_rng(1).uniform(-0.02, 0.02, 16)
    expected = inputs(law, state, np.zeros(3), 0.0)
    assert len({round(u, 5) for u in expected}) == 4
    turn = np.array([[np.cos(TURN), -np.sin(TURN), 0.0], [np.sin(TURN), np.cos(TURN), 0.0], [0.0, 0.0, 1.0]])
    moved = state.copy()
    moved[POSITION : POSITION + 3] = GOAL + turn @ state[POSITION : POSITION + 3]
    moved[VELOCITY : VELOCITY + 3] = turn @ state[VELOCITY : VELOCITY + 3]
    moved[ATTITUDE + 2] += TURN
    assert inputs(law, moved, GOAL, TURN) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_original_law_integrates_y_and_z_to_their_own_limits_until_it_is_reset(side: float) -> None:
    config = load_config(overrides=("logic.controller=original",))
    logic = load_logic(config.logic)
    assert logic is not None
    block, estimator, control = parameters_of(config), Estimator.allocate().fields, Control.allocate().fields
    parameters, own, memory = block.fields, original.Gains.allocate().fields, original.Memory.allocate()
    for name, value in logic.values.items():
        setattr(own, name, f32(value))
    own.limit_iy, parameters.limit_iz = f32(0.003), f32(0.002)
    parameters.target[:] = (0.0, 0.05 * side, 0.04 * side, 0.0)
    without = []  # the inputs less those by the integrals
    for tick in range(1, 9):
        original.control_law(parameters, estimator, control, own, memory.fields)
        y, z = side * min(0.0005 * tick, 0.003), side * min(0.0004 * tick, 0.002)
        assert (memory.fields.integral_y, memory.fields.integral_z) == pytest.approx((y, z))
        without.append(np.subtract(control.u, (own.gain_iy * y, 0.0, 0.0, parameters.gain_iz * z)))
    assert np.ptp(without, axis=0) == pytest.approx(np.zeros(4), abs=1e-6)
    original.reset_law(memory.fields)
    assert memory.bytes() == original.Memory.allocate().bytes()
    parameters.target[2] = 9.0 * side
    original.control_law(parameters, estimator, control, own, memory.fields)
    assert control.u[3] == (parameters.hover_angle if side > 0.0 else -parameters.limit_u)
