"""The flow's effect on a robot, from a hover's telemetry: the accelerations that its model does not explain.

With them the design predicts how far another controller lets the robot move. The inputs are those that the flaps really
took, so that limits, limit cycles and excitations do not count as disturbance. The cameras' noise counts as flow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.design.loop import (
    ANGLE,
    DELAY,
    FREQUENCIES,
    POSITION,
    RATE,
    TICK_DELAYS_S,
    VELOCITY,
    Axis,
    Robot,
    dynamics,
)
from hil.errors import LabError
from hil.identify.axes import flap_response
from hil.identify.joint import LATE_S
from hil.identify.record import Array, Record
from hil.identify.spectra import Complex

WINDOW_S = 10.0
BEGIN_S = 2.0  # after the release
USED = 0.8  # of the frequencies below half the sampling rate
PLACES = {0: (1, 3), 1: (0, 4), 2: (5, 5), 3: (2, 2)}  # of an input's position and angle in the pose


@dataclass(frozen=True, slots=True)
class Flow:
    """The disturbance of an axis in a hover, and its mean input and angle."""

    spectrum: Complex  # (L, W, W) on FREQUENCIES, per Hz: of the velocity, of the rate, as the axis has them
    input: float  # [rad] mean
    angle: float  # [rad] mean; 0 for an axis without an angle


def flow_of(record: Record, axis: Axis, robot: Robot) -> Flow:
    """Return the disturbance of an axis of a robot. Raises `LabError` for less than two windows of flight."""
    step = record.period_s
    grid = np.arange(max(record.t[0], record.pose_t[0]) + BEGIN_S, min(record.t[-1], record.pose_t[-1]), step)
    size = round(WINDOW_S / step)
    starts = range(0, len(grid) - size + 1, size // 2)
    if len(starts) < 2:
        raise LabError(
            f"{record.name}: {len(grid) * step:.1f} s of flight: {1.5 * WINDOW_S:g} s after the first {BEGIN_S:g} s are "
            "needed to estimate the flow"
        )
    place, angle = PLACES[axis.input]
    u = np.interp(grid, record.t, record.u[:, axis.input])
    rate = np.interp(grid, record.t, record.rates[:, axis.input]) if axis.input < 3 else np.zeros(len(grid))
    poses = [np.interp(grid, record.pose_t, record.pose[:, column]) for column in (place, angle)]
    w: Array = np.linspace(0.0, 2 * np.pi / step, size + 1)[1 : int(USED * size / 2)]
    taper = np.hanning(size)

    def spectra(values: Array) -> Complex:
        cut = np.array([values[start : start + size] for start in starts])
        cut = (cut - cut.mean(axis=1, keepdims=True)) * taper
        return np.asarray(np.fft.rfft(cut, axis=1)[:, 1 : 1 + len(w)])

    s: Complex = 1j * w
    shown: Complex = np.exp(s * LATE_S)  # by how much poses are later than their stamps
    of: dict[str, Complex] = {
        POSITION: spectra(poses[0]) / shown,
        ANGLE: spectra(poses[1]) / shown,
        RATE: spectra(rate),
    }
    of[VELOCITY] = s * of[POSITION]
    flap = spectra(u) * flap_response(w, 1 / robot["flap_rate"], robot[DELAY] + TICK_DELAYS_S)
    flow, _ = dynamics(axis, robot)
    left = []
    for row, state in enumerate(axis.states):
        if state in (VELOCITY, RATE):
            explained = sum(
                factor * of[other] for factor, other in zip(flow[row], axis.states, strict=False) if factor
            )
            left.append(s * of[state] - explained - flow[row, -1] * flap)
    both = np.stack(left, axis=2)  # (windows, lines, W)
    each = np.einsum("klw,klx->lwx", both, both.conj()) / len(starts) * 2 * step / np.sum(taper**2)
    mean_angle = float(poses[1].mean()) if ANGLE in axis.states and axis.input < 2 else 0.0
    return Flow(_on_lines(w / (2 * np.pi), each), float(u.mean()), mean_angle)


def _on_lines(hertz: Array, each: Complex) -> Complex:
    """Return spectra on FREQUENCIES; the end values beyond both ends."""
    flat = each.reshape(len(hertz), -1)
    at: Sequence[Complex] = [
        np.interp(FREQUENCIES, hertz, column.real) + 1j * np.interp(FREQUENCIES, hertz, column.imag)
        for column in flat.T
    ]
    return np.stack(at, axis=1).reshape(len(FREQUENCIES), *each.shape[1:])
