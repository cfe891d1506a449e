"""The paper's method, as printed in its Methods: two flights with different controllers, only the flow's disturbance.

Each flight gives the closed loop's constants by eq. (roll_dynamics_sys_of_equations): jw A' = [A' A Y'] [b* c* d*], least
squares over the low frequencies of windows of 4 s, as in the author's script. The two give, by eq.
(roll_dynamics_input_const), a = (c1* - c2*) / (c1 - c2) with the controllers' own c, then b, c and d.

It does not recover a known plant. A' is the derivative of the same A, so that jw A' = -w^2 A holds in every bin for any
robot: least squares find b* near 0 and c* near the mean of -w^2 over the spectrum (`hil.research.identify.pages` shows it).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.errors import LabError
from hil.research.design.axes import ANGLE, PITCH, POSITION, RATE, ROLL, VELOCITY, Axis
from hil.research.identify.record import Array, Record
from hil.research.identify.spectra import Complex

RATE_HZ, WINDOW = 50.0, 200  # samples; the author's script
BINS = slice(1, 20)  # 0.25 to 4.75 Hz
TAPER = (0.0, 1 / 3, 2 / 3)
SIGMAS = 1.96  # of a 95 % interval


@dataclass(frozen=True, slots=True)
class ClosedLoop:
    """The estimate from one flight's spectra by eq. (roll_dynamics_sys_of_equations)."""

    starred: Array  # (3,) b*, c*, d*
    errors: Array  # (3,) standard
    w: Array  # (N,) [rad/s] of the bins, all windows
    angle: Complex  # (N,)
    acceleration: Complex  # (N,) jw A'


def input_constant(starred: Sequence[float], own: Sequence[float]) -> tuple[float, float]:
    """Return a and c of the open loop from c* of two flights and the controllers' own c: eq. (roll_dynamics_input_const)."""
    a = (starred[0] - starred[1]) / (own[0] - own[1])
    return a, starred[0] - a * own[0]


def closed_loop(record: Record, axis: Axis) -> ClosedLoop:
    """Return a flight's closed-loop constants. Raises `LabError` for one without a window of 4 s."""
    grid = np.arange(record.pose_t[0], record.pose_t[-1], 1 / RATE_HZ)
    angle = np.interp(grid, record.pose_t, record.pose[:, axis.pose[ANGLE]])
    place = np.interp(grid, record.pose_t, record.pose[:, axis.pose[POSITION]])
    rate, velocity = (0.5 * RATE_HZ * (x[2:] - x[:-2]) for x in (angle, place))
    count = len(rate) // WINDOW
    if count < 1:
        raise LabError(
            f"{record.name}: {len(rate) / RATE_HZ:.1f} s of flight; the paper's method takes windows of 4 s"
        )
    taper = np.ones(WINDOW)
    taper[:3], taper[-3:] = TAPER, TAPER[::-1]
    w = 2 * np.pi * RATE_HZ / WINDOW * np.arange(WINDOW // 2 + 1)[BINS]

    def spectra(values: Array) -> Complex:
        pieces = values[: count * WINDOW].reshape(count, WINDOW)
        return np.asarray(np.fft.rfft(pieces * taper, axis=1)[:, BINS] / WINDOW).ravel()

    A_dot, A, Y_dot = spectra(rate), spectra(angle[1:-1]), spectra(velocity)
    every_w = np.tile(w, count)
    left = 1j * every_w * A_dot
    right = np.stack([A_dot, A, Y_dot], axis=1)
    weight = np.conj(A)  # both sides times the angle's conjugate, as in the script's active variant
    rows = right * weight[:, None]
    M, b = (
        np.concatenate([rows.real, rows.imag]),
        np.concatenate([(left * weight).real, (left * weight).imag]),
    )
    starred = np.linalg.lstsq(M, b, rcond=None)[0]
    variance = np.sum((b - M @ starred) ** 2) / (len(b) - 3)
    errors = np.sqrt(variance * np.diag(np.linalg.pinv(M.T @ M)))
    return ClosedLoop(starred, errors, every_w, A, left)


def two_controllers(records: Sequence[Record]) -> dict[str, tuple[float, float]]:
    """Return a, b, c, d of roll and pitch with 95 % errors, from the first two records with different gains on the angle."""
    found: dict[str, tuple[float, float]] = {}
    for axis in (ROLL, PITCH):
        gains = [axis.gains[axis.states.index(state)] for state in (RATE, ANGLE, VELOCITY)]
        input_name, *names = axis.constants[:4]
        pair = _pair(records, gains[1])
        if pair is None:
            continue
        loops = [closed_loop(record, axis) for record in pair]
        own = [[-getattr(record.config.controller, gain) for gain in gains] for record in pair]
        a, _ = input_constant([loop.starred[1] for loop in loops], [one[1] for one in own])
        spread = float(np.hypot(loops[0].errors[1], loops[1].errors[1]) / abs(own[0][1] - own[1][1]))
        found[input_name] = (a, SIGMAS * spread)
        for index, name in enumerate(names):
            value = float(loops[0].starred[index] - a * own[0][index])
            error = float(np.hypot(loops[0].errors[index], spread * own[0][index]))
            found[name] = (value, SIGMAS * error)
    return found


def _pair(records: Sequence[Record], gain: str) -> tuple[Record, Record] | None:
    """Return two records without excitation and with different gains; None if there are none."""
    free = [record for record in records if not record.excitation.any()]
    for other in free[1:]:
        if getattr(other.config.controller, gain) != getattr(free[0].config.controller, gain):
            return free[0], other
    return None
