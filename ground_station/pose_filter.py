"""The state behind a stream of poses: a linear Kalman filter with position, velocity, attitude, rate.

All axes are alike: one filter of filterpy, for position, velocity, angle and rate of one axis, says how uncertain they are
and with which gains a pose counts; the state itself is plain numbers. While poses come without a gap, uncertainty and
gains stand still and filterpy rests: 3 instead of 40 us. The attitude lives in a reference quaternion; the filter's angle
is the small rotation that it is off, which goes into the reference after every step.
"""

from math import sqrt
from typing import Any

import numpy as np

from firmware_py.geometry import IDENTITY, Quaternion, Vector

SPEED = 1.0  # [m/s] of a robot that is seen for the first time, one standard deviation per axis; chosen
RATE = 5.0  # [rad/s] likewise
SETTLED = 1e-6  # gain and steady gain differ by less than this share of the largest
STEPS_MAX = 10_000  # until the gain stands still; 10 to 200 are usual
NOTHING: Vector = (0.0, 0.0, 0.0)

Gains = tuple[float, float, float, float]  # of position and velocity [1, 1/s], of angle and rate


class PoseFilter:
    """Steps of `step_s` [s]; noise of poses [m, rad] and of accelerations [m/s^2, rad/s^2], constant for a step."""

    def __init__(
        self,
        step_s: float,
        position_noise: float,
        rotation_noise: float,
        acceleration: float,
        angular_acceleration: float,
    ) -> None:
        # Here, because filterpy brings scipy.stats: about a second that no other command shall wait for.
        from filterpy.common import Q_discrete_white_noise
        from filterpy.kalman import KalmanFilter

        self._step_s = step_s
        self._noise2 = position_noise**2, rotation_noise**2
        filter_: Any = KalmanFilter(dim_x=4, dim_z=2)
        filter_.F = np.kron(np.eye(2), [[1.0, step_s], [0.0, 1.0]])
        filter_.H = np.kron(np.eye(2), [[1.0, 0.0]])
        filter_.R = np.diag(self._noise2)
        filter_.Q = np.zeros((4, 4))
        filter_.Q[:2, :2] = Q_discrete_white_noise(2, step_s, acceleration**2)
        filter_.Q[2:, 2:] = Q_discrete_white_noise(2, step_s, angular_acceleration**2)
        self._filter = filter_
        self._first_P = np.diag([self._noise2[0], SPEED**2, self._noise2[1], RATE**2])
        self._p = self._v = self._theta = self._w = NOTHING
        self._q = IDENTITY  # reference
        self._settle()

    def _settle(self) -> None:
        """Find what gain and uncertainty settle to."""
        filter_, gain = self._filter, np.zeros((4, 2))
        filter_.P = self._first_P
        for _ in range(STEPS_MAX):
            filter_.predict()
            self._steady_prior = filter_.P
            filter_.update(np.zeros(2))
            if np.abs(filter_.K - gain).max() < 0.1 * SETTLED * gain.max():
                break
            gain = filter_.K
        self._steady_K, self._steady_P = filter_.K, filter_.P
        self._margin = SETTLED * float(self._steady_K.max())
        self._steady_variances = self._variances_of(self._steady_prior)
        self._steady_gains = self._gains = _gains_of(filter_.K)
        self._steady = False
        self.variances = self._steady_variances

    @property
    def pose(self) -> tuple[Vector, Quaternion]:
        """Position and attitude of B in W."""
        return self._p, self._q

    def begin(self, p_WB: Vector, q_WB: Quaternion) -> None:
        """Know this pose and nothing before it."""
        self._p, self._v, self._theta, self._w = p_WB, NOTHING, NOTHING, NOTHING
        self._filter.P = self._first_P
        w, x, y, z = q_WB
        n = 1.0 / sqrt(w * w + x * x + y * y + z * z)
        self._q = (n * w, n * x, n * y, n * z)
        self._steady = False

    def predict(self, steps: int, widen: bool) -> None:
        """Go on by `steps`; without `widen` the uncertainty stays as it is. `variances` are of the next pose then.

        They are those of its distance and of its rotation from the prediction, per axis [m^2, rad^2].
        """
        for _ in range(steps - 1):
            self._move()
            self._turn()
        self._move()
        if self._steady and steps == 1:
            return
        self._steady = False
        if widen:
            for _ in range(steps):
                self._filter.predict()
        self.variances = self._variances_of(self._filter.P)

    def off(self, p_WB: Vector, q_WB: Quaternion) -> tuple[float, float, Vector]:
        """How far a pose is from the prediction, squared [m^2, rad^2], and its rotation from the reference.

        Rotations are twice Gibbs's vector, 2 tan(angle / 2) about the axis [rad]: the angle itself where it is small, and
        far beyond every gate where it is not.
        """
        x, y, z = self._p
        a, b, c = self._theta
        dx, dy, dz = p_WB[0] - x, p_WB[1] - y, p_WB[2] - z
        w, x, y, z = self._q
        qw, qx, qy, qz = q_WB
        cosine = w * qw + x * qx + y * qy + z * qz
        s = 2.0 / (cosine if abs(cosine) > 1e-9 else 1e-9)
        theta = (
            s * (w * qx - x * qw - y * qz + z * qy),
            s * (w * qy + x * qz - y * qw - z * qx),
            s * (w * qz - x * qy + y * qx - z * qw),
        )
        da, db, dc = theta[0] - a, theta[1] - b, theta[2] - c
        return dx * dx + dy * dy + dz * dz, da * da + db * db + dc * dc, theta

    def update(self, p_WB: Vector, theta: Vector) -> tuple[Vector, Vector]:
        """Take a pose, as position and rotation from the reference; returns velocity in W and rate in B."""
        if not self._steady:
            self._weigh()
        k_p, k_v, k_theta, k_w = self._gains
        self._p, self._v = _corrected(self._p, self._v, p_WB, k_p, k_v)
        self._theta, self._w = _corrected(self._theta, self._w, theta, k_theta, k_w)
        self._turn()
        return self._v, self._w

    def _weigh(self) -> None:
        """Find the gains of the next pose, and what uncertainty it leaves."""
        filter_ = self._filter
        filter_.update(np.zeros(2))
        if np.abs(filter_.K - self._steady_K).max() >= self._margin:
            self._gains = _gains_of(filter_.K)
            return
        filter_.P, self._gains = self._steady_P, self._steady_gains
        self.variances, self._steady = self._steady_variances, True

    def leave_out(self) -> tuple[Vector, Vector]:
        """Take no pose this time; returns velocity and rate as predicted."""
        if self._steady:
            self._filter.P, self._steady = self._steady_prior, False
        self._turn()
        return self._v, self._w

    def _move(self) -> None:
        """Predict the state one step ahead."""
        t = self._step_s
        (x, y, z), (vx, vy, vz), (p, q, r) = self._p, self._v, self._w
        self._p = (x + t * vx, y + t * vy, z + t * vz)
        self._theta = (t * p, t * q, t * r)

    def _turn(self) -> None:
        """Put the attitude error into the reference."""
        a, b, c = self._theta
        w, x, y, z = self._q
        a, b, c = 0.5 * a, 0.5 * b, 0.5 * c
        w, x, y, z = (
            w - x * a - y * b - z * c,
            w * a + x + y * c - z * b,
            w * b - x * c + y + z * a,
            w * c + x * b - y * a + z,
        )
        n = 1.0 / sqrt(w * w + x * x + y * y + z * z)
        self._q = (n * w, n * x, n * y, n * z)
        self._theta = NOTHING

    def _variances_of(self, prior: Any) -> tuple[float, float]:
        return float(prior[0, 0]) + self._noise2[0], float(prior[2, 2]) + self._noise2[1]


def _gains_of(K: Any) -> Gains:
    return float(K[0, 0]), float(K[1, 0]), float(K[2, 1]), float(K[3, 1])


def _corrected(
    value: Vector, slope: Vector, measured: Vector, gain: float, slope_gain: float
) -> tuple[Vector, Vector]:
    """Three values and their slopes, after a measurement."""
    x, y, z = value
    a, b, c = slope
    dx, dy, dz = measured[0] - x, measured[1] - y, measured[2] - z
    return (
        (x + gain * dx, y + gain * dy, z + gain * dz),
        (a + slope_gain * dx, b + slope_gain * dy, c + slope_gain * dz),
    )
