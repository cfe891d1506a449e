"""Spectra on the lines of the excitation, for each realisation: the responses, and their scatter.

The excitation's phases are new in every realisation (`firmware_py/core/excitation.py`). In each period of 20 s sines and
cosines of all lines are fitted to the existing samples, so that rows may be missing and any rate sufficient for the lines
is allowed. The responses per excitation scatter about their mean over the realisations, by a disturbance of any colour
and by nonlinearity. This gives the covariance of the mean.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import interp1d

from hil.errors import LabError
from hil.research.identify.plates import HEIGHT, SIDEWAYS, straightened
from hil.research.identify.record import Array, Record

Complex = NDArray[np.complexfloating[Any, Any]]
# firmware_py/core/excitation.py
PERIOD_S, REALISATION_S, SPACING_HZ = 20.0, 22.0, 0.05
SETTLING_S = 1.8  # omitted in each realisation; the rest of its 2 s allows for a missing first row
LEAST_PERIODS = 4
HOLE_S = 0.3  # without rows or poses in a period that counts
BREAK_ROWS = 2.5  # after which the excitation may have begun anew
ALIKE_S, ALIKE_ROWS = 2.0, 20  # length and least rows of a beginning that is compared with the first
ALIKE = 0.1  # share of its squares that may be off
LINE = 0.1  # of the strongest line: weaker ones are ignored
NEIGHBOURS = 4  # lines to either side, excited or not, that give the scatter at a line
LEAST_SAMPLES = 1.5  # per unknown of the fit
PURE = 0.05  # allowed share of the excitation off its lines, or changing in size between periods
# The power of w that turns a signal into an acceleration.
POWERS = {**dict.fromkeys(range(8, 11), 1), **dict.fromkeys(range(11, 17), 2)}


@dataclass(frozen=True, slots=True)
class Spectra:
    """An input and its responses on the input's lines; the last axis of `Z` counts input, then outputs."""

    w: Array  # (L,) [rad/s]
    Z: Complex  # (L, S) mean over the periods, per excitation
    C: Complex  # (L, S, S) covariance of that mean
    each: Complex  # (P, L, S) of which Z is the mean
    excitation: Complex  # (L,) of the first period [rad]
    coherence: Array  # (L, S) of each signal with the excitation, over single periods

    @property
    def periods(self) -> int:
        return len(self.each)


def windows(record: Record) -> list[float]:
    """Return the start of each whole period of the excitation, board's clock. Raises `LabError` for too few.

    Periods in which rows or poses are missing for long are left out. After a failsafe the board begins the excitation anew.
    """
    excited = np.flatnonzero(np.any(record.excitation != 0.0, axis=1))
    if not len(excited):
        raise LabError(
            f"{record.name}: no excitation in it: from the flow's disturbance alone no constant can be identified; "
            "fly `identify`"
        )
    t = record.u_t[excited]
    begun = _begun(t, record.excitation[excited])
    last = [float(t[t < following][-1]) for following in (*begun[1:], np.inf)]
    starts = [
        float(start)
        for begin, end in zip(begun, last, strict=True)
        for start in np.arange(begin + SETTLING_S, end + record.period_s + 1e-6 - PERIOD_S, REALISATION_S)
    ]
    whole = [
        start for start in starts if not (_has_hole(record.u_t, start) or _has_hole(record.pose_t, start))
    ]
    if len(whole) < LEAST_PERIODS:
        settled = max(t[-1] - t[0] - SETTLING_S, 0.0)
        holes = (
            f", {len(starts) - len(whole)} more with holes of over {HOLE_S:g} s"
            if len(starts) > len(whole)
            else ""
        )
        again = f", which began {len(begun)} times" if len(begun) > 1 else ""
        raise LabError(
            f"{record.name}: {settled:.1f} s of settled excitation{again}: {len(whole)} realisations of "
            f"{REALISATION_S:g} s{holes}; at least {LEAST_PERIODS} are needed"
        )
    return whole


def _has_hole(t: Array, start: float) -> bool:
    """Return whether samples are missing for long in the period from `start` on."""
    inside = t[(t > start) & (t < start + PERIOD_S)]
    return bool(np.diff(inside, prepend=start, append=start + PERIOD_S).max() > HOLE_S)


def _begun(t: Array, r: Array) -> list[float]:
    """Return when an excitation r (N, 4) began: first, and anew after holes. It always begins with the same phases."""
    begun, step = [float(t[0])], float(np.median(np.diff(t)))
    first = t < t[0] + ALIKE_S
    if np.count_nonzero(first) <= ALIKE_ROWS:
        return begun
    at_first = interp1d(t[first] - t[0], r[first], "cubic", axis=0, bounds_error=False, fill_value=np.nan)
    for place in np.flatnonzero(np.diff(t) > BREAK_ROWS * step):
        after = slice(place + 1, place + 1 + int(np.count_nonzero(first)))
        since = t[after] - t[place + 1]
        for more in np.arange(0.0, t[place + 1] - t[place], 0.01):
            expected = at_first(since + more)
            known = np.isfinite(expected).all(axis=1)
            error = np.sum((expected[known] - r[after][known]) ** 2)
            if np.count_nonzero(known) > ALIKE_ROWS and error < ALIKE * np.sum(r[after][known] ** 2):
                begun.append(float(t[place + 1] - more))
                break
    return begun


def excited_lines(record: Record, starts: Sequence[float]) -> list[NDArray[np.int_]]:
    """Return the lines of each input, as multiples of 0.05 Hz. Raises `LabError` for rows too far apart."""
    nyquist = 0.5 / record.period_s
    every = np.arange(1, int(0.8 * nyquist / SPACING_HZ) + 1)
    inside = (record.u_t >= starts[0]) & (record.u_t < starts[0] + PERIOD_S)
    t, r = record.u_t[inside], record.excitation[inside]
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
    try:
        parts = np.linalg.solve(basis.T @ basis, basis.T @ values)
    except np.linalg.LinAlgError:
        raise LabError(
            f"{name}: too many samples in a row are missing in a period of {PERIOD_S:g} s"
        ) from None
    count = len(w)
    return np.asarray(parts[:count] - 1j * parts[count : 2 * count])


def period_spectra(record: Record) -> tuple[list[NDArray[np.int_]], Array, Complex]:
    """Return each input's lines, all lines w (L,) [rad/s], and all signals by period (P, L, 17).

    Signals: excitation of the four inputs, the four inputs, three gyro rates, and the pose's six.
    """
    starts = windows(record)
    own = excited_lines(record, starts)
    excited = np.concatenate(own)
    lines = np.arange(1, 1 + excited.max(initial=0))  # lines in between absorb the disturbance
    if not len(lines):
        raise LabError(
            f"{record.name}: rows of {record.period_s * 1e3:.0f} ms are too far apart for the excitation's lines"
        )
    w = 2 * np.pi * SPACING_HZ * lines
    straight = straightened(record)
    commanded = np.concatenate([record.excitation, straight.u], axis=1)
    of_board = np.concatenate([record.rates, straight.bent], axis=1)
    periods = []
    for start in starts:
        parts = []
        for t, values in ((record.u_t, commanded), (record.t, of_board), (record.pose_t, record.pose)):
            rows = (t >= start - 1e-6) & (t < start + PERIOD_S - 1e-6)
            parts.append(_fit(t[rows] - start, values[rows], w, record.name))
        rates, bent, seen = parts[1][:, :3], parts[1][:, 3:], parts[2]
        seen[:, [SIDEWAYS, HEIGHT]] += bent / w[:, None] ** 2
        periods.append(np.concatenate([parts[0], rates, seen], axis=1))
    P = np.array(periods)
    _refuse_impure(record.name, lines, own, np.abs(P[:, :, :4]))
    return own, w, P


def _refuse_impure(name: str, lines: NDArray[np.int_], own: Sequence[NDArray[np.int_]], sizes: Array) -> None:
    """Raise `LabError` for an excitation (P, L, 4) that is not an equal sum of its lines in every period."""
    expected = np.zeros_like(sizes)
    for i, chosen in enumerate(own):
        expected[:, np.isin(lines, chosen), i] = sizes[:, np.isin(lines, chosen), i].mean(axis=0)
    astray = float(np.sqrt(np.mean((sizes - expected) ** 2) / np.mean(sizes**2)))
    if astray > PURE:
        raise LabError(
            f"{name}: the logged excitation is not the same sum of lines in every period of {PERIOD_S:g} s, {astray:.0%} of "
            "it differs: are the time stamps right?"
        )


def spectra_of(
    record: Record, periods: tuple[list[NDArray[np.int_]], Array, Complex], axis: int, signals: Sequence[int]
) -> Spectra:
    """Return an input's spectra with some signals, counted as in `period_spectra` after the inputs: 8 to 16."""
    own, w_all, P = periods
    lines = np.round(w_all / (2 * np.pi * SPACING_HZ)).astype(int)
    places = np.flatnonzero(np.isin(lines, own[axis]))
    if not len(places):
        raise LabError(f"{record.name}: u{axis + 1} is not excited in it")
    columns, count = [4 + axis, *signals], len(P)
    w, r = w_all[places], P[:, places, axis]
    every = P[:, places][:, :, columns] / r[:, :, None]
    Z = every.mean(axis=0)
    # As accelerations the spectra have no steep slopes.
    flat = w_all[:, None] ** np.array([POWERS.get(signal, 0) for signal in columns])
    scatter = P[:, :, columns]
    scatter[:, places] -= Z * r[:, :, None]
    scatter *= flat
    # Of a single period, at every line; odd curvature also appears on the lines between.
    power_of = np.einsum("pls,plt->lst", scatter, scatter.conj()) / count
    power_of[places] *= count / (count - 1)
    others = np.isin(lines, np.concatenate([found for i, found in enumerate(own) if i != axis]))
    C = np.empty((len(places), len(columns), len(columns)), complex)
    size = np.mean(np.abs(r), axis=0)
    for row, place in enumerate(places.tolist()):
        near = slice(max(0, place - NEIGHBOURS), place + NEIGHBOURS + 1)
        mean = power_of[near][~others[near]].mean(axis=0)
        C[row] = mean / np.outer(flat[place], flat[place]) / size[row] ** 2 / count
    power, noise = np.abs(Z) ** 2, np.einsum("lss->ls", C).real * count
    return Spectra(w, Z, C, every, r[0], power / (power + noise))
