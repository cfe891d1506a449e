"""Spectra on the lines of the excitation, period by period: the responses, and how far each period scatters.

In every period of 20 s sines and cosines of all excited lines are fitted to the samples that there are, so that rows may be
missing and the rate may be any that suffices for the lines. The mean over the periods is the cross spectrum with the
excitation; the scatter about it is disturbance of any colour, and gives the covariance, line by line and between the
signals, of the mean.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.errors import LabError
from hil.identify.record import Array, Record

Complex = NDArray[np.complexfloating[Any, Any]]
PERIOD_S, SPACING_HZ = 20.0, 0.05  # firmware_py/core/excitation.py
SETTLING_S = 2.0  # left out after the excitation begins
LEAST_PERIODS = 4
LINE = 0.1  # of the strongest line: weaker ones do not count
# Share of a response that curvature, dead band and couplings cause, and that averaging does not reduce.
NOT_LINEAR = 0.03
NEIGHBOURS = 4  # lines to either side that give the disturbance of a line
LEAST_SAMPLES = 1.5  # per unknown of the fit
PURE = 0.05  # share of the excitation that may differ from period to period
# The power of w that turns a signal into an acceleration.
POWERS = {**dict.fromkeys(range(8, 11), 1), **dict.fromkeys(range(11, 17), 2)}


@dataclass(frozen=True, slots=True)
class Spectra:
    """An input and its responses on the input's lines; the last axis of `Z` counts input, then outputs."""

    w: Array  # (L,) [rad/s]
    Z: Complex  # (L, S) mean over the periods, per excitation
    C: Complex  # (L, S, S) covariance of that mean
    excitation: Complex  # (L,) that Z refers to [rad]
    periods: int
    coherence: Array  # (L, S) of each signal with the excitation, over single periods


def windows(record: Record) -> list[float]:
    """Return when each whole period of the excitation begins, board's clock. Raises `LabError` when there are too few."""
    excited = np.any(record.excitation != 0.0, axis=1)
    if not excited.any():
        raise LabError(
            f"{record.name}: no excitation in it: from the flow's disturbance alone no constant can be identified; "
            "fly `identify`"
        )
    start, end = record.t[excited][0] + SETTLING_S, record.t[excited][-1]
    count = int((end - start + record.period_s) // PERIOD_S)
    if count < LEAST_PERIODS:
        raise LabError(
            f"{record.name}: {end - start:.1f} s of excitation: {count} periods of {PERIOD_S:g} s after it settled; "
            f"at least {LEAST_PERIODS} are needed"
        )
    return [float(start + PERIOD_S * index) for index in range(count)]


def excited_lines(record: Record, starts: Sequence[float]) -> list[NDArray[np.int_]]:
    """Return the lines of each input, as multiples of 0.05 Hz. Raises `LabError` for rows too far apart."""
    nyquist = 0.5 / record.period_s
    every = np.arange(1, int(0.8 * nyquist / SPACING_HZ) + 1)
    inside = (record.t >= starts[0]) & (record.t < starts[0] + PERIOD_S)
    t, r = record.t[inside], record.excitation[inside]
    n = round(PERIOD_S / record.period_s)
    grid = starts[0] + PERIOD_S / n * np.arange(n)
    found = []
    for i in range(4):
        whole = np.interp(grid, t, r[:, i])
        amplitude = np.abs(np.fft.rfft(whole))[1 : len(every) + 1]
        strongest = float(amplitude.max(initial=0.0))
        found.append(every[amplitude > LINE * strongest] if strongest > 1e-6 * n else every[:0])
    return found


def _basis(t: Array, w: Array) -> Array:
    return np.concatenate(
        [np.cos(np.outer(t, w)), np.sin(np.outer(t, w)), t[:, None] ** 0, t[:, None] / PERIOD_S - 0.5], axis=1
    )


def _fit(t: Array, values: Array, w: Array, name: str) -> Complex:
    """Return the complex amplitudes (L, S), x = Re(X e^{jwt})."""
    basis = _basis(t, w)
    if len(t) < LEAST_SAMPLES * basis.shape[1]:
        raise LabError(
            f"{name}: {len(t)} samples in a period of {PERIOD_S:g} s for {len(w)} lines: at least "
            f"{int(np.ceil(LEAST_SAMPLES * basis.shape[1]))} are needed"
        )
    parts = np.linalg.lstsq(basis, values, rcond=None)[0]
    count = len(w)
    return np.asarray(parts[:count] - 1j * parts[count : 2 * count])


def period_spectra(record: Record) -> tuple[list[NDArray[np.int_]], Array, Complex]:
    """Return each input's lines, all lines w (L,) [rad/s], and all signals by period (P, L, 17).

    Signals: excitation of the four inputs, the four inputs, three gyro rates, and the pose's six.
    """
    starts = windows(record)
    own = excited_lines(record, starts)
    excited = np.concatenate(own)
    lines = np.arange(1, 1 + excited.max(initial=0))  # those in between give the disturbance
    if not len(lines):
        raise LabError(
            f"{record.name}: rows of {record.period_s * 1e3:.0f} ms are too far apart for the excitation's lines"
        )
    w = 2 * np.pi * SPACING_HZ * lines
    of_board = np.concatenate([record.excitation, record.u, record.rates], axis=1)
    periods = []
    for start in starts:
        rows = (record.t >= start - 1e-6) & (record.t < start + PERIOD_S - 1e-6)
        poses = (record.pose_t >= start - 1e-6) & (record.pose_t < start + PERIOD_S - 1e-6)
        board = _fit(record.t[rows] - start, of_board[rows], w, record.name)
        seen = _fit(record.pose_t[poses] - start, record.pose[poses], w, record.name)
        periods.append(np.concatenate([board, seen], axis=1))
    P = np.array(periods)
    r = P[:, :, :4]
    astray = float(np.sqrt(np.mean(np.abs(r - r.mean(axis=0)) ** 2) / np.mean(np.abs(r) ** 2)))
    if astray > PURE:
        raise LabError(
            f"{record.name}: the logged excitation does not repeat every {PERIOD_S:g} s, {astray:.0%} of it differs: are "
            "the time stamps right?"
        )
    return own, w, P


def spectra_of(
    record: Record, periods: tuple[list[NDArray[np.int_]], Array, Complex], axis: int, signals: Sequence[int]
) -> Spectra:
    """Return an input's spectra with some signals, counted as in `period_spectra` after the inputs: 8 to 16."""
    own, w_all, P = periods
    chosen = np.isin(np.round(w_all / (2 * np.pi * SPACING_HZ)).astype(int), own[axis])
    if not chosen.any():
        raise LabError(f"{record.name}: u{axis + 1} is not excited in it")
    columns = [4 + axis, *signals]
    count = len(P)
    r = P[:, :, axis][:, chosen]
    every = P[:, :, columns]
    scatter = every - every.mean(axis=0)
    # As accelerations the spectra have no steep slopes.
    flat = w_all[:, None] ** np.array([POWERS.get(signal, 0) for signal in columns])
    scatter = scatter * flat
    # The covariance of a single period, at every line.
    each = np.einsum("pls,plt->lst", scatter, scatter.conj()) / (count - 1)
    covariance = np.empty((chosen.sum(), len(columns), len(columns)), complex)
    places = np.flatnonzero(chosen)
    for row, place in enumerate(places):
        near = each[max(0, place - NEIGHBOURS) : place + NEIGHBOURS + 1]
        covariance[row] = near.mean(axis=0) / np.outer(flat[place], flat[place])
    excitation = r.mean(axis=0)
    Z = every[:, chosen].mean(axis=0) / excitation[:, None]
    C = covariance / count / np.abs(excitation)[:, None, None] ** 2
    power = np.abs(Z) ** 2
    noise = np.einsum("lss->ls", C).real * count
    outputs = np.arange(1, len(columns))
    C[:, outputs, outputs] += NOT_LINEAR**2 * power[:, outputs]
    return Spectra(w_all[chosen], Z, C, excitation, count, power / (power + noise))
