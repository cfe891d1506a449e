"""The state behind a stream of poses: one linear Kalman filter (filterpy) with position, velocity, attitude, rate.

The attitude lives in a reference quaternion; the filter holds the small rotation that it is off, which goes into the
reference after every step. Noise is the same on all axes, so that two numbers tell how far off a pose may be. While poses
come without a gap, gain and covariance stand still, and filterpy's steady-state steps do without them: 13 instead of 45 us.
"""

from math import sqrt
from typing import Any

import numpy as np

from firmware_py.geometry import IDENTITY, Quaternion, Vector

SPEED = 1.0  # [m/s] of a robot that is seen for the first time, one standard deviation per axis; chosen
RATE = 5.0  # [rad/s] likewise
SETTLED = 1e-6  # gain and steady gain differ by less than this share of the largest
STEPS_MAX = 10_000  # until the gain stands still; 10 to 200 are usual
P, V, THETA, W = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)  # parts of the state


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

        self._noise2 = position_noise**2, rotation_noise**2
        filter_: Any = KalmanFilter(dim_x=12, dim_z=6)
        filter_.x = np.zeros(12)
        filter_.F = np.kron(np.eye(2), np.kron([[1.0, step_s], [0.0, 1.0]], np.eye(3)))
        filter_.H[:3, P] = filter_.H[3:, THETA] = np.eye(3)
        filter_.R = np.diag(np.repeat(self._noise2, 3))
        filter_.Q = np.zeros((12, 12))
        for part, noise in ((slice(0, 6), acceleration), (slice(6, 12), angular_acceleration)):
            filter_.Q[part, part] = Q_discrete_white_noise(
                2, step_s, noise**2, block_size=3, order_by_dim=False
            )
        self._filter = filter_
        self._q = IDENTITY  # reference
        self._first_P = np.diag(np.repeat([self._noise2[0], SPEED**2, self._noise2[1], RATE**2], 3))
        self._settle()

    def _settle(self) -> None:
        """Find what gain and covariance settle to."""
        filter_, gain = self._filter, np.zeros((12, 6))
        filter_.P = self._first_P
        for _ in range(STEPS_MAX):
            filter_.predict()
            self._steady_prior = filter_.P
            filter_.update(np.zeros(6))
            if np.abs(filter_.K - gain).max() < 0.1 * SETTLED * gain.max():
                break
            gain = filter_.K
        self._steady_K, self._steady_P = filter_.K, filter_.P
        self._margin = SETTLED * float(self._steady_K.max())
        self._steady_variances = self._variances_of(self._steady_prior)
        self._steady = False
        self.variances = self._steady_variances

    @property
    def pose(self) -> tuple[Vector, Quaternion]:
        """Position and attitude of B in W."""
        x, y, z = self._filter.x[P].tolist()
        return (x, y, z), self._q

    def begin(self, p_WB: Vector, q_WB: Quaternion) -> None:
        """Know this pose and nothing before it."""
        self._filter.x = np.array([*p_WB, *[0.0] * 9])
        self._filter.P = self._first_P
        w, x, y, z = q_WB
        n = 1.0 / sqrt(w * w + x * x + y * y + z * z)
        self._q = (n * w, n * x, n * y, n * z)
        self._steady = False

    def predict(self, steps: int, widen: bool) -> None:
        """Go on by `steps`; without `widen` the uncertainty stays as it is. `variances` are of the next pose then.

        They are those of its distance and of its rotation from the prediction, per axis [m^2, rad^2].
        """
        filter_ = self._filter
        if self._steady and steps == 1:
            filter_.predict_steadystate()
            return
        self._steady = False
        step = filter_.predict if widen else filter_.predict_steadystate
        for _ in range(steps - 1):
            step()
            self._turn()
        step()
        self.variances = self._variances_of(filter_.P)

    def off(self, p_WB: Vector, q_WB: Quaternion) -> tuple[float, float, Vector]:
        """How far a pose is from the prediction, squared [m^2, rad^2], and its rotation from the reference.

        Rotations are twice Gibbs's vector, 2 tan(angle / 2) about the axis [rad]: the angle itself where it is small, and
        far beyond every gate where it is not.
        """
        x, y, z, _, _, _, a, b, c, _, _, _ = self._filter.x.tolist()
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
        filter_, z = self._filter, [*p_WB, *theta]
        if self._steady:
            filter_.update_steadystate(z)
        else:
            filter_.update(z)
            if np.abs(filter_.K - self._steady_K).max() < self._margin:
                filter_.K, filter_.P = self._steady_K, self._steady_P
                self.variances, self._steady = self._steady_variances, True
        return self._turn()

    def leave_out(self) -> tuple[Vector, Vector]:
        """Take no pose this time; returns velocity and rate as predicted."""
        if self._steady:
            self._filter.P, self._steady = self._steady_prior, False
        return self._turn()

    def _turn(self) -> tuple[Vector, Vector]:
        """Put the attitude error into the reference; returns velocity and rate."""
        state = self._filter.x
        _, _, _, vx, vy, vz, a, b, c, p, q, r = state.tolist()
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
        state[THETA] = 0.0
        return (vx, vy, vz), (p, q, r)

    def _variances_of(self, prior: Any) -> tuple[float, float]:
        return float(prior[0, 0]) + self._noise2[0], float(prior[6, 6]) + self._noise2[1]
