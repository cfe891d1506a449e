"""A control law's observations and actions in a recorded flight, as data for imitation learning.

They follow `firmware_py/core/observation.py`, computed from the log by the board's own function.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from firmware_py.compiling import bound
from firmware_py.config import FirmwareConfig, parameters_of
from firmware_py.core.observation import ACTIONS, OBSERVATIONS, observe
from firmware_py.core.structs import Estimator, Parameters
from firmware_py.core.subset import Block, F32s
from firmware_py.wire.supervisor import State
from hil.world.fixed_order import compiled

STATE = [f"estimate.{name}" for name in (*"xyz", "vx", "vy", "vz", "roll", "pitch", "yaw", *"pqr")]
STATE += [f"estimate.flap_{number}" for number in (1, 2, 3, 4)]
INPUTS = [f"control.u{number}" for number in (1, 2, 3, 4)]
Rows = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Demonstrations:
    """The controller's steps with the loop closed, one row per 10 ms."""

    t_us: NDArray[np.int64]  # (N,) of the log; without the steps of an open loop
    observations: Rows  # (N, 20)
    actions: Rows  # (N, 4), -1..1


@compiled
def observe_board(parameters: Parameters, estimator: Estimator, previous: F32s, out: F32s) -> None:
    """Write the observation from the memory of a board's core."""
    observe(parameters, estimator, previous, out)


def observer(
    parameters: Block[Parameters], estimator: Block[Estimator], previous: Rows, out: Rows
) -> Callable[[], object]:
    """Return what writes the observation `out` (20,) of a board after its `previous` action (4,)."""
    return bound(observe_board, parameters, estimator, previous, out)


def demonstrations_of(log: pa.Table, config: FirmwareConfig) -> Demonstrations:
    """Return the steps in the log of a flight with this profile; none if it never closed the loop."""
    columns = {name: log.column(name).to_numpy() for name in ("t", "supervisor.state", *STATE, *INPUTS)}
    parameters = parameters_of(config)
    values: Any = parameters.fields
    limits = np.array([values.limit_u, values.limit_u, values.limit_u3, values.limit_u])
    states = np.stack([columns[name] for name in STATE], axis=1).astype(np.float32)
    inputs = np.stack([columns[name] for name in INPUTS], axis=1)
    actions = np.clip(inputs / limits, -1.0, 1.0).astype(np.float32)
    previous, estimator = np.zeros(ACTIONS, np.float32), Estimator.allocate()
    observations, seen = np.zeros((len(states), OBSERVATIONS), np.float32), np.zeros(OBSERVATIONS, np.float32)
    see = observer(parameters, estimator, previous, seen)
    for state, action, observation in zip(states, actions, observations, strict=True):
        estimator.fields.now[:] = state
        see()
        observation[:], previous[:] = seen, action
    closed = columns["supervisor.state"] == State.FLYING
    return Demonstrations(columns["t"][closed], observations[closed], actions[closed])
