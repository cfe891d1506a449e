"""The motion capture cameras: noisy, delayed poses of the body, sometimes missing or wrong.

A pose is the truth with noise or, with `markers.enabled`, the fit to eight markers (`hil.board.markers`). Here
frames and arrivals are computed; the harness exposes at `period_us` and delivers.
"""

import math
from dataclasses import replace

import numpy as np

from firmware_py.geometry import IDENTITY, Quaternion, Vector, multiply, rotate
from ground_station.mocap import FROZEN_FRAMES, MocapFrame
from ground_station.unused import Reason
from hil.board.config import MocapConfig
from hil.board.markers import Sighting, VirtualMarkers
from hil.world.body import Motion
from hil.world.fixed_order import normal

Pose = tuple[Vector, Quaternion]

NOISE_ROWS = 512  # frames of noise drawn at once

NOWHERE: Vector = (0.0, 0.0, 0.0)
FORWARD: Vector = (1.0, 0.0, 0.0)
HALF_TURN = (0.0, 0.0, 0.0, 1.0)  # about z, w x y z


class VirtualMocap:
    """The cameras. Plain attributes that may change in flight:

    `dropout`, `outlier` (0..1) share of frames; `wrong_by` [m] error of every position, in random directions;
    `swapped_by` [m] swapped markers turn poses by 180 degrees about z of B and shift them along its x; 0: none;
    `more_latency_us` is added to the configured one; `frozen`: every frame has the last pose, which counts as frozen
    when it has been repeated as often as from OptiTrack. `sighting` is the last exposure's view of the markers, None without
    markers.
    """

    def __init__(
        self, config: MocapConfig, rng: np.random.Generator, markers: VirtualMarkers | None = None
    ) -> None:
        """With `markers`, fit the poses to them."""
        self._config = config
        self._camera_us = max(0, config.latency_us - config.processing_us)
        self._rng = rng
        # Separate streams: a fault changes neither the noise of the other frames nor the other faults.
        self._rng_outlier, self._rng_dropout, self._rng_wrong = rng.spawn(3)
        self._draws: list[list[float]] = []
        self.dropout = config.dropout
        self.outlier = config.outlier
        self.wrong_by = 0.0
        self.swapped_by = 0.0
        self.more_latency_us = 0.0
        self.frozen = 0.0
        self._repeated = 0  # frames
        self._kept: tuple[Pose | None, Sighting | None] = None, None  # of the last frame
        self.markers = markers
        self.sighting: Sighting | None = None
        self._arrival_us = 0  # of the last frame

    def expose(self, now_us: int, body: Motion) -> tuple[MocapFrame, int]:
        """Return the frame of the body as it is now, and its arrival at the ground station.

        Frames keep their order. The cameras' computer causes all delay; the network takes no time.
        """
        latency_us = self._config.latency_us + round(self.more_latency_us)
        self._arrival_us = arrival_us = max(self._arrival_us, now_us + latency_us)
        pose = self._pose(body)
        if self.frozen > 0.0:
            self._repeated += 1
            pose, self.sighting = self._kept
        else:
            self._repeated = 0
            self._kept = pose, self.sighting
        p_WB, q_WB = pose or (NOWHERE, IDENTITY)
        received_us = now_us + self._camera_us
        frame = MocapFrame(now_us, p_WB, q_WB, pose is not None, received_us, arrival_us)
        if pose is not None and self._repeated >= FROZEN_FRAMES:
            frame.valid, frame.unused = False, (Reason.FROZEN, ())
        return frame, arrival_us

    def _pose(self, body: Motion) -> Pose | None:
        """Return the pose with its errors, None when the body is not tracked."""
        if self.markers is None:
            pose: Pose | None = self._noisy_pose(body)
        else:
            self.sighting = self.markers.sighting_of(body.p_WB, body.q_WB)
            pose = self.sighting.pose
        outlier = self.outlier > 0.0 and self._rng_outlier.random() < self.outlier
        offset = _direction(self._rng_outlier) if outlier else NOWHERE
        dropped = self.dropout > 0.0 and self._rng_dropout.random() < self.dropout
        if dropped or pose is None:
            if self.sighting is not None:
                self.sighting = replace(self.sighting, pose=None)
            return None
        p_WB, q_WB = pose
        if outlier:
            p_WB = _shifted(p_WB, self._config.outlier_size, offset)
        if self.wrong_by > 0.0:
            p_WB = _shifted(p_WB, self.wrong_by, _direction(self._rng_wrong))
        if self.swapped_by > 0.0:
            p_WB = _shifted(p_WB, self.swapped_by, rotate(q_WB, FORWARD))
            q_WB = multiply(q_WB, HALF_TURN)
        return p_WB, q_WB

    def _noisy_pose(self, body: Motion) -> Pose:
        if not self._draws:
            self._draws = normal(self._rng, (NOISE_ROWS, 6)).tolist()
        x, y, z, a, b, c = self._draws.pop()
        px, py, pz = body.p_WB.tolist()
        s, half = self._config.position_noise, 0.5 * self._config.rotation_noise
        q_WB = turned(body.q_WB.tolist(), half * a, half * b, half * c)
        return (px + s * x, py + s * y, pz + s * z), q_WB


def _direction(rng: np.random.Generator) -> Vector:
    x, y, z = normal(rng, 3).tolist()
    s = 1.0 / math.sqrt(x * x + y * y + z * z)
    return (s * x, s * y, s * z)


def _shifted(p: Vector, distance: float, direction: Vector) -> Vector:
    return (p[0] + distance * direction[0], p[1] + distance * direction[1], p[2] + distance * direction[2])


def turned(q: list[float], a: float, b: float, c: float) -> Quaternion:
    """Return q (1, a, b, c) of unit length: `q` turned by the small rotation 2 (a, b, c) [rad] in its own frame."""
    w, x, y, z = q
    n = 1.0 / math.sqrt((w * w + x * x + y * y + z * z) * (1.0 + a * a + b * b + c * c))
    return (
        n * (w - x * a - y * b - z * c),
        n * (x + w * a + y * c - z * b),
        n * (y + w * b + z * a - x * c),
        n * (z + w * c + x * b - y * a),
    )
