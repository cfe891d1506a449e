"""The flow's effect on a robot, from a hover's telemetry: accelerations that its model does not explain.

From them the design predicts the robot's motion under another controller. The inputs are the flaps' actual ones, so that
limits, limit cycles and excitations do not count as disturbance. The cameras' noise counts as flow.
"""

import numpy as np

from hil.errors import LabError
from hil.research.design.axes import (
    ANGLE,
    DELAY,
    PITCH,
    POSITION,
    RATE,
    ROLL,
    VELOCITY,
    Axis,
    Robot,
    dynamics,
)
from hil.research.design.loop import FREQUENCIES, Complex
from hil.research.design.tune import Flow
from hil.research.identify.joint import LATE_S
from hil.research.identify.record import Array, Record
from hil.research.identify.response import TICK_DELAYS_S, flap_response

WINDOW_S = 10.0
BEGIN_S = 2.0  # after the release
USED = 0.8  # of the frequencies below half the sampling rate


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
    u = np.interp(grid, record.u_t, record.u[:, axis.input])
    poses = {
        state: np.interp(grid, record.pose_t, record.pose[:, column]) for state, column in axis.pose.items()
    }
    w: Array = np.linspace(0.0, 2 * np.pi / step, size + 1)[1 : int(USED * size / 2)]
    taper = np.hanning(size)

    def spectra(values: Array) -> Complex:
        cut = np.array([values[start : start + size] for start in starts])
        cut = (cut - cut.mean(axis=1, keepdims=True)) * taper
        return np.asarray(np.fft.rfft(cut, axis=1)[:, 1 : 1 + len(w)])

    s: Complex = 1j * w
    shown: Complex = np.exp(s * LATE_S)  # lateness of poses against their stamps
    of: dict[str, Complex] = {state: spectra(values) / shown for state, values in poses.items()}
    if POSITION in of:
        of[VELOCITY] = s * of[POSITION]
    if RATE in axis.states:
        of[RATE] = spectra(np.interp(grid, record.t, record.rates[:, axis.input]))
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
    mean_angle = float(poses[ANGLE].mean()) if axis in (ROLL, PITCH) else 0.0
    return Flow(_on_lines(w / (2 * np.pi), each), float(u.mean()), mean_angle)


def _on_lines(hertz: Array, each: Complex) -> Complex:
    """Return spectra on FREQUENCIES; the end values beyond both ends."""
    columns = each.reshape(len(hertz), -1).T
    at = np.stack([np.interp(FREQUENCIES, hertz, column) for column in columns], axis=1)
    return at.reshape(len(FREQUENCIES), *each.shape[1:])
