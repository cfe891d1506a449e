"""Computes the gains of profiles/lqr.py from the model of a profile: python tools/lqr_gains.py [PROFILE].

The model is the core's own, the controller's step 10 ms, the weights Bryson's: what counts as one unit of error.
"""

import sys

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from firmware_py.config import FirmwareConfig, parameters_of
from firmware_py.core.model import derivative
from firmware_py.core.structs import ATTITUDE, FLAP, POSITION, RATE, STATES, VELOCITY
from hil.config import load_config
from hil.design.loop import held
from hil.world.body import MIX

STEP_S = 0.01
ACCEPTED = {  # by state
    POSITION: 0.05, POSITION + 1: 0.05, POSITION + 2: 0.03,  # [m]
    VELOCITY: 0.2, VELOCITY + 1: 0.2, VELOCITY + 2: 0.2,  # [m/s]
    ATTITUDE: 0.15, ATTITUDE + 1: 0.15, ATTITUDE + 2: 0.1,  # [rad]
    RATE: 2.0, RATE + 1: 2.0, RATE + 2: 2.0,  # [rad/s]
}  # fmt: skip
ACCEPTED_INPUT = (0.1, 0.1, 0.1, 0.1)  # [rad] u1..u4
NAMES = {  # state by state, of the four inputs
    0: {POSITION + 1: "gain_y", VELOCITY + 1: "gain_vy", ATTITUDE: "gain_roll", RATE: "gain_p"},
    1: {POSITION: "gain_x", VELOCITY: "gain_vx", ATTITUDE + 1: "gain_pitch", RATE + 1: "gain_q"},
    2: {ATTITUDE + 2: "gain_yaw", RATE + 2: "gain_r"},
    3: {POSITION + 2: "gain_z", VELOCITY + 2: "gain_vz"},
}
Matrix = NDArray[np.float64]


def model(config: FirmwareConfig) -> tuple[Matrix, Matrix]:
    """Return the model in discrete time, (16, 16) and (16, 4): the inputs hold over a step."""
    parameters = parameters_of(config)
    A = np.zeros((STATES, STATES))
    for state in range(STATES):
        x, dx = np.zeros(STATES, np.float32), np.zeros(STATES, np.float32)
        x[state] = 1.0
        derivative(parameters.memory[0], np.float32(0.0), np.float32(1.0), x, dx)
        A[:, state] = dx
    B = np.zeros((STATES, 4))
    B[FLAP:] = config.model.flap_rate * MIX
    return held(A, B, STEP_S)


def regulator(config: FirmwareConfig) -> Matrix:
    """Return the optimum K of u = -K x, (4, 16)."""
    A, B = model(config)
    Q = np.diag([1 / ACCEPTED[state] ** 2 if state in ACCEPTED else 0.0 for state in range(STATES)])
    R = np.diag([1 / limit**2 for limit in ACCEPTED_INPUT])
    P = solve_discrete_are(A, B, Q, R)
    K: Matrix = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    return K


def gains(K: Matrix) -> dict[str, float]:
    """Return the 16 numbers of which K is made: on the states, and on what the flaps have reached of each input."""
    found = {}
    for row, names in NAMES.items():
        found |= {name: float(K[row, state]) for state, name in names.items()}
        found[f"gain_u{row + 1}"] = float(K[row, FLAP:] @ MIX[:, row])
    return found


if __name__ == "__main__":
    for name, gain in gains(regulator(load_config(*sys.argv[1:2]))).items():
        print(f"{name} = {gain:.6g}")
