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
