"""The flight core on the bench: poses and ticks go in, state comes out."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from firmware_py.config import parameters_of
from firmware_py.core.structs import GOAL_ABSOLUTE, MODE_FLY
from firmware_py.core_runner import CoreBlocks, default_runner
from hil.config import load_config

Vector = NDArray[np.float64]
CONFIG = load_config()
LEVEL = (1.0, 0.0, 0.0, 0.0)


class Core:
    """The flight core on the bench: poses and ticks go in, state comes out."""

    def __init__(self, **parameters: float) -> None:
        blocks = CoreBlocks(parameters_of(CONFIG), default_runner)
        self.parameters, self.data, self.estimator = blocks.parameters, blocks.data, blocks.estimator
        self.control, self.sampling, self.supervisor = blocks.control, blocks.sampling, blocks.supervisor
        self.report, self.call = blocks.report, blocks.run.call
        self.sampling.fields.phase = 9  # the estimator's tick comes in this step
        for name, value in parameters.items():
            self.parameters.memory[name] = value
        self.data.fields.poses_absolute, self.data.fields.goal_kind = 1, GOAL_ABSOLUTE  # seen from W's origin
        self.fields = self.estimator.fields
        self.call("reset")

    def pose(self, p: object, q: object = LEVEL, age_us: int = 40_000) -> int:
        """File a pose that will be `age_us` old at the next tick."""
        data = self.data.fields
        data.pose_position[:], data.pose_quaternion[:], data.pose_age_us = p, q, age_us
        return self.call("file_pose")

    def tick(self, gyro_sum: object = (0, 0, 0), samples: int = 10, command: object = (0, 0, 0, 0)) -> None:
        """Run one tick on gyro counts and the command (deviation from hover [rad]) that held until now."""
        data = self.data.fields
        data.gyro_sum[:], data.gyro_samples = gyro_sum, samples
        self.control.fields.command[:] = command
        self.call("estimate")

    def fly(self) -> None:
        self.data.fields.mode = MODE_FLY
        self.call("control")

    @property
    def x(self) -> Vector:
        return self.fields.x.astype(float)

    @property
    def now(self) -> Vector:
        return self.fields.now.astype(float)

    @property
    def P(self) -> Vector:
        return self.fields.P.astype(float)

    @property
    def counters(self) -> dict[str, int]:
        names = ("fused", "refused", "jumps", "too_old", "invalid", "bounded", "resets")
        return {name: int(getattr(self.fields, name)) for name in names if getattr(self.fields, name)}


def quaternion(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Vector:
    q: Vector = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat(scalar_first=True)
    return q


def counts(omega: object, samples: int = 10) -> list[int]:
    """Return the summed gyro counts of body rates [rad/s]; the chip sits at -45 deg in the body."""
    omega_S = Rotation.from_euler("z", -45, degrees=True).inv().apply(np.asarray(omega, float))
    per_count = math.radians(2000) / 32768
    return [round(rate / per_count * samples) for rate in omega_S]


def turned(angle: float | Vector) -> float | Vector:
    return np.remainder(np.asarray(angle) + math.pi, 2 * math.pi) - math.pi
