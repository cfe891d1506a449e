"""A control law's observations and actions in a recorded flight, as data for imitation learning.

They follow `firmware_py/core/observation.py`, computed from the log by the board's own function.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from firmware_py.config import FirmwareConfig, parameters_of
from firmware_py.core.observation import ACTIONS, OBSERVATIONS, observe
from firmware_py.core.structs import Estimator
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
def observe_rows(parameters: Any, estimator: Any, states: Rows, previous: Rows, out: Rows) -> None:
    """Write the observation of every row."""
    for n in range(len(states)):
        estimator.now[:] = states[n]
        observe(parameters, estimator, previous[n], out[n])


def demonstrations_of(log: pa.Table, config: FirmwareConfig) -> Demonstrations:
    """Return the steps in the log of a flight with this profile; none if it never closed the loop."""
    columns = {name: log.column(name).to_numpy() for name in ("t", "supervisor.state", *STATE, *INPUTS)}
    parameters = parameters_of(config)
    values: Any = parameters.fields
    limits = np.array([values.limit_u, values.limit_u, values.limit_u3, values.limit_u])
    states = np.stack([columns[name] for name in STATE], axis=1).astype(np.float32)
    inputs = np.stack([columns[name] for name in INPUTS], axis=1)
    actions = np.clip(inputs / limits, -1.0, 1.0).astype(np.float32)
    previous = np.concatenate([np.zeros((1, ACTIONS), np.float32), actions[:-1]])[: len(actions)]
    observations = np.zeros((len(states), OBSERVATIONS), np.float32)
    observe_rows(parameters.arg, Estimator.allocate().arg, states, previous, observations)
    closed = columns["supervisor.state"] == State.FLYING
    return Demonstrations(columns["t"][closed], observations[closed], actions[closed])
