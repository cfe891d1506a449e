"""The four decoupled axes of the robot: one table of inputs, states, gains and constants.

    roll:  p' = a flap + b p + c roll + d vy      y:  vy' = e flap + h roll + g vy + k p
           (pitch and x alike)
    yaw:   r' = a flap + b r                      z:  vz' = e flap + g vz
    flap' = flap_rate (u - flap)

Symbols of the paper's Methods. Constants have their names in a profile's [model], except k (`NUISANCES`): flaps above the
centre of mass push sideways when the robot turns, an effect missing in the Table and in the model on board.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.config import LabConfig

Matrix = NDArray[np.float64]
Robot = Mapping[str, float]  # constants of a [model], and `delay`

STEP_S = 0.01  # of the controller
DELAY = "delay"  # [s] from the end of a gyro sample's tick to the servo: control 1 ms later, half a PWM period, computing
OWN_DELAY_S = 0.003
POSITION, VELOCITY, ANGLE, RATE, FLAP = "position", "velocity", "angle", "rate", "flap"

# Units of the constants, by affected state and cause, in the order of the equations.
UNITS: Mapping[tuple[str, str], str] = {
    (RATE, FLAP): "1/s²",
    (RATE, RATE): "1/s",
    (RATE, ANGLE): "1/s²",
    (RATE, VELOCITY): "rad/s/m",
    (VELOCITY, FLAP): "m/s²/rad",
    (VELOCITY, ANGLE): "m/s²/rad",
    (VELOCITY, VELOCITY): "1/s",
    (VELOCITY, RATE): "m/s/rad",
}
UNITS_OF_STATES: Mapping[str, str] = {
    POSITION: "m",
    VELOCITY: "m/s",
    ANGLE: "rad",
    RATE: "rad/s",
    FLAP: "rad",
}
NUISANCES = ("y_rate", "x_rate")


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """An input, the states behind it, and the names of its gains and constants in a profile."""

    name: str
    coordinate: str  # x, y or z that it moves; empty for yaw
    input: int
    states: tuple[str, ...]  # first the controlled one: the integral of the next, without effect on others
    gains: tuple[str, ...]  # by state, then of the first one's integral, if any
    constants: tuple[str, ...]  # in the order of UNITS

    @property
    def label(self) -> str:
        """The name with the coordinate that the axis moves."""
        return f"{self.name}, {self.coordinate}" if ANGLE in self.states and self.coordinate else self.name

    @property
    def main(self) -> str:
        """The state that the axis controls."""
        return self.states[0]

    @property
    def terms(self) -> dict[str, tuple[str, str]]:
        """The affected state and the cause of each constant."""
        causes = (*self.states[1:], FLAP)
        own = [term for term in UNITS if term[0] in causes and term[1] in causes]
        return dict(zip(self.constants, own, strict=True))

    @property
    def pose(self) -> dict[str, int]:
        """The states in a pose, each with its column among x y z, roll pitch yaw."""
        place = {POSITION: "xyz".index(self.coordinate)} if self.coordinate else {}
        return place | ({ANGLE: 3 + self.input} if ANGLE in self.states else {})


TURN = (POSITION, VELOCITY, ANGLE, RATE)
AXES = (
    Axis("roll", "y", 0, TURN, ("gain_y", "gain_vy", "gain_roll", "gain_p"),
         ("roll_u1", "roll_rate", "roll_roll", "roll_vy", "y_u1", "y_roll", "y_vy", "y_rate")),
    Axis("pitch", "x", 1, TURN, ("gain_x", "gain_vx", "gain_pitch", "gain_q"),
         ("pitch_u2", "pitch_rate", "pitch_pitch", "pitch_vx", "x_u2", "x_pitch", "x_vx", "x_rate")),
    Axis("yaw", "", 2, (ANGLE, RATE), ("gain_yaw", "gain_r"), ("yaw_u3", "yaw_rate")),
    Axis("height", "z", 3, (POSITION, VELOCITY), ("gain_z", "gain_vz", "gain_iz"), ("z_u4", "z_vz")),
)  # fmt: skip
ROLL, PITCH, YAW, HEIGHT = AXES


def robot_of(config: LabConfig) -> dict[str, float]:
    return {**config.model.model_dump(), DELAY: OWN_DELAY_S}


def gains_in(config: LabConfig, axis: Axis) -> Matrix:
    return np.array([getattr(config.controller, name) for name in axis.gains])


def dynamics(axis: Axis, robot: Robot) -> tuple[Matrix, Matrix]:
    """Return the matrix of states and flap in continuous time, and the columns (flap command, accelerations of the flow)."""
    values = dict.fromkeys(NUISANCES, 0.0) | dict(robot)
    states, n = (*axis.states, FLAP), len(axis.states)
    flow = np.zeros((n + 1, n + 1))
    integrals = range(0, n, 2)
    flow[integrals, range(1, n, 2)] = 1.0
    for name, (affected, cause) in axis.terms.items():
        flow[states.index(affected), states.index(cause)] = values[name]
    flow[n, n] = -values["flap_rate"]
    columns = np.zeros((n + 1, 1 + len(integrals)))
    columns[n, 0] = values["flap_rate"]
    columns[range(1, n, 2), range(1, 1 + len(integrals))] = 1.0
    return flow, columns
