"""Computes the gains of firmware_py/logic/laws/lqr.py from the model of a profile: python tools/lqr_gains.py [PROFILE].

One regulator per axis, on its states and on the input that its flaps have reached. The axes are decoupled, so the four
are the optimum of all 16 states. The weights are Bryson's: one accepted error counts as one unit.
"""

import sys

from hil.config import LabConfig, load_config
from hil.research.design.axes import (
    ANGLE,
    AXES,
    HEIGHT,
    POSITION,
    RATE,
    STEP_S,
    VELOCITY,
    YAW,
    dynamics,
    robot_of,
)
from hil.research.design.gains import regulator
from hil.research.design.loop import held

ACCEPTED = {POSITION: 0.05, VELOCITY: 0.2, ANGLE: 0.15, RATE: 2.0}  # [m], [m/s], [rad], [rad/s]
BETTER = {YAW: {ANGLE: 0.1}, HEIGHT: {POSITION: 0.03}}
ACCEPTED_INPUT = 0.1  # [rad]


def gains(config: LabConfig) -> dict[str, float]:
    """Return the 16 numbers of the matrix: on the states, and on each input that the flaps have reached."""
    found = {}
    for axis in AXES:
        Phi, Gamma = held(*dynamics(axis, robot_of(config)), STEP_S)
        K = regulator(axis, Phi, Gamma[:, :1], ACCEPTED | BETTER.get(axis, {}), ACCEPTED_INPUT).tolist()
        found |= dict(zip([*axis.gains[: len(axis.states)], f"gain_u{axis.input + 1}"], K, strict=True))
    return found


if __name__ == "__main__":
    for name, gain in gains(load_config(*sys.argv[1:2])).items():
        print(f"{name} = {gain:.6g}")
