"""The state estimate from a stream of poses: a linear Kalman filter with position, velocity, attitude, rate.

All axes are alike: the uncertainty of position and velocity, and the gains for a pose, are computed for one axis,
and likewise for angle and rate. The attitude is a reference quaternion; the filter's angle is the small rotation
from it, which is moved into the reference after every step.
"""

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

from firmware_py.geometry import IDENTITY, Quaternion, Vector

SPEED = 1.0  # [m/s] of a robot seen for the first time, one standard deviation per axis; chosen
RATE = 5.0  # [rad/s] likewise
NOTHING: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of a measured value, and of its second derivative, which is constant for a step."""

    value: float
    acceleration: float


class Covariance(NamedTuple):
    """The variances and the covariance of a value and its slope. A tuple: each frame makes four of them."""

    value: float
    both: float
    slope: float

    def predicted(self, t: float, noise: Noise) -> "Covariance":
        """Return the covariance after `t` [s]: F P F' + Q with F = (1 t; 0 1), Q = a^2 (t^4/4 t^3/2; t^3/2 t^2)."""
        change, shift = t * noise.acceleration, 0.5 * t * t * noise.acceleration  # of slope and value
        both = self.both + t * self.slope
        return Covariance(
            self.value + t * (self.both + both) + shift * shift,
            both + shift * change,
            self.slope + change * change,
        )

    def gains(self, noise: Noise) -> tuple[float, float]:
        """Return the weights of a measurement for value and slope [1, 1/s]: P H' / (H P H' + R)."""
        total = self.value + noise.value * noise.value
        return self.value / total, self.both / total

    def updated(self, k_value: float, k_slope: float) -> "Covariance":
        """Return the covariance after a measurement with these gains: (I - K H) P."""
        return Covariance(
            self.value - k_value * self.value,
            self.both - k_value * self.both,
            self.slope - k_slope * self.both,
        )


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
        self._step_s = step_s
        self._noises = Noise(position_noise, acceleration), Noise(rotation_noise, angular_acceleration)
        self._first = (
            Covariance(position_noise * position_noise, 0.0, SPEED * SPEED),
            Covariance(rotation_noise * rotation_noise, 0.0, RATE * RATE),
        )
        self._covariances = self._first
        self._p = self._v = self._theta = self._w = NOTHING
        self._q = IDENTITY  # reference

    @property
    def pose(self) -> tuple[Vector, Quaternion]:
        """Position and attitude of B in W."""
        return self._p, self._q

    def begin(self, p_WB: Vector, q_WB: Quaternion) -> None:
        """Start from this pose and forget everything before it."""
        self._p, self._v, self._theta, self._w = p_WB, NOTHING, NOTHING, NOTHING
        self._covariances = self._first
        w, x, y, z = q_WB
        n = 1.0 / sqrt(w * w + x * x + y * y + z * z)
        self._q = (n * w, n * x, n * y, n * z)

    def predict(self, steps: int, widen: bool) -> None:
        """Predict `steps` ahead; without `widen` the uncertainty stays unchanged."""
        for _ in range(steps - 1):
            self._move()
            self._turn()
        self._move()
        if widen:
            for _ in range(steps):
                position, rotation = self._covariances
                self._covariances = (
                    position.predicted(self._step_s, self._noises[0]),
                    rotation.predicted(self._step_s, self._noises[1]),
                )

    @property
    def variances(self) -> tuple[float, float]:
        """The variances of the next pose's distance and rotation from the prediction, per axis [m^2, rad^2]."""
        (position, rotation), (p, r) = self._covariances, self._noises
        return position.value + p.value * p.value, rotation.value + r.value * r.value

    def deviation(self, p_WB: Vector, q_WB: Quaternion) -> tuple[float, float, Vector]:
        """Return the squared distance from the prediction [m^2, rad^2], and the rotation from the reference.

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
        """Take a pose, as position and rotation from the reference; return velocity in W and rate in B."""
        (position, rotation), (of_position, of_rotation) = self._covariances, self._noises
        k_p, k_v = position.gains(of_position)
        k_theta, k_w = rotation.gains(of_rotation)
        self._covariances = position.updated(k_p, k_v), rotation.updated(k_theta, k_w)
        self._p, self._v = _corrected(self._p, self._v, p_WB, k_p, k_v)
        self._theta, self._w = _corrected(self._theta, self._w, theta, k_theta, k_w)
        self._turn()
        return self._v, self._w

    def leave_out(self) -> tuple[Vector, Vector]:
        """Skip this frame's pose; return velocity and rate as predicted."""
        self._turn()
        return self._v, self._w

    def _move(self) -> None:
        """Predict the state one step ahead."""
        t = self._step_s
        (x, y, z), (vx, vy, vz), (p, q, r) = self._p, self._v, self._w
        self._p = (x + t * vx, y + t * vy, z + t * vz)
        self._theta = (t * p, t * q, t * r)

    def _turn(self) -> None:
        """Move the attitude error into the reference."""
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


def _corrected(
    value: Vector, slope: Vector, measured: Vector, gain: float, slope_gain: float
) -> tuple[Vector, Vector]:
    """Return three values and their slopes after a measurement."""
    x, y, z = value
    a, b, c = slope
    dx, dy, dz = measured[0] - x, measured[1] - y, measured[2] - z
    return (
        (x + gain * dx, y + gain * dy, z + gain * dz),
        (a + slope_gain * dx, b + slope_gain * dy, c + slope_gain * dz),
    )
