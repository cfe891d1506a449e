"""The motion capture cameras: noisy poses of the plant, late, sometimes missing or wrong.

Computes frames only; the harness exposes at `period_us` and delivers `latency_us` later.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ground_station.mocap import MocapFrame
from hil.plant.plant import Plant

NOISE_ROWS = 512  # frames of noise drawn at once

Probability = Annotated[float, Field(ge=0, le=1)]


class MocapConfig(BaseModel):
    """Cameras, their computer and the network to the ground station."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    period_us: int = Field(
        5000, ge=1000, le=1_000_000, multiple_of=1000, description="between exposures; paper: 200 Hz"
    )
    latency_us: int = Field(
        38_000,
        ge=0,
        le=1_000_000,
        description="exposure to arrival at the ground station; with the radio's 2 ms the paper's 40 ms",
    )
    position_noise: float = Field(
        0.0005, ge=0, le=0.1, description="white, per axis [m]; physics.md section 6"
    )
    rotation_noise: float = Field(
        0.004, ge=0, le=0.5, description="white, per axis of B [rad]; physics.md section 6"
    )
    dropout: Probability = Field(0.0, description="share of frames in which the body is not tracked")
    outlier: Probability = Field(
        0.0, description="share of frames with a wrong position, e.g. swapped markers"
    )
    outlier_size: float = Field(
        0.3, gt=0, le=5, description="how far a wrong position lies off, random direction [m]; chosen"
    )


class VirtualMocap:
    """The cameras; `dropout` and `outlier` (probabilities) and `blind` may change in flight."""

    def __init__(self, config: MocapConfig, rng: np.random.Generator) -> None:
        self._config = config
        self._rng = rng
        (self._rng_faults,) = rng.spawn(1)  # so that faults leave the noise of the other frames as it was
        self._draws: list[list[float]] = []
        self.dropout = config.dropout
        self.outlier = config.outlier
        self.blind = False

    def expose(self, now_us: int, plant: Plant) -> MocapFrame:
        """Return what the cameras see at this instant; the harness has advanced the plant to it."""
        if not self._draws:
            self._draws = self._rng.standard_normal((NOISE_ROWS, 6)).tolist()
        x, y, z, a, b, c = self._draws.pop()
        if self.blind or (self.dropout > 0.0 and self._rng_faults.random() < self.dropout):
            return MocapFrame(now_us, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), valid=False)
        px, py, pz = plant.p_WB.tolist()
        s = self._config.position_noise
        p_WB = (px + s * x, py + s * y, pz + s * z)
        if self.outlier > 0.0 and self._rng_faults.random() < self.outlier:
            dx, dy, dz = self._rng_faults.standard_normal(3).tolist()
            s = self._config.outlier_size / math.sqrt(dx * dx + dy * dy + dz * dz)
            p_WB = (p_WB[0] + s * dx, p_WB[1] + s * dy, p_WB[2] + s * dz)
        s = 0.5 * self._config.rotation_noise
        return MocapFrame(now_us, p_WB, turned(plant.q_WB.tolist(), s * a, s * b, s * c), valid=True)


def turned(q: list[float], a: float, b: float, c: float) -> tuple[float, float, float, float]:
    """Return q (1, a, b, c) of unit length: `q` turned by the small rotation 2 (a, b, c) [rad] in its own frame."""
    w, x, y, z = q
    n = 1.0 / math.sqrt((w * w + x * x + y * y + z * z) * (1.0 + a * a + b * b + c * c))
    return (
        n * (w - x * a - y * b - z * c),
        n * (x + w * a + y * c - z * b),
        n * (y + w * b + z * a - x * c),
        n * (z + w * c + x * b - y * a),
    )
