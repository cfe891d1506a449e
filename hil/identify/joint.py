"""The two estimates that use the excitation: instrumental variables, and the joint fit of all axes.

Both take the cross spectra with the excitation (`hil.identify.spectra`), which the disturbance does not bias, and weight
each line by the covariance that the disturbance has there, not that of white noise.

Instrumental variables: the axes' equations are linear in their constants; lag and delay are taken from the profile, and
their uncertainty is part of the intervals. Joint fit: all axes at once with one servo lag and one delay, by the errors of
the predicted outputs (`scipy.optimize.least_squares`), started from the former. Where the errors are larger than the scatter
of the periods explains, they are model errors: the intervals grow with them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import t as student

from hil.design.axes import ANGLE, AXES, FLAP, RATE, VELOCITY, Axis
from hil.identify.record import Array, Record
from hil.identify.response import DELAY, LAG, flap_response, outputs, response
from hil.identify.spectra import Complex, Spectra, period_spectra, spectra_of

CONFIDENCE = 0.95
LAG_SPREAD = 0.2  # of the profile's lag, standard deviation
# Half a tick of holding, the PWM period, computing, half the gyro's mean.
DELAY_S, DELAY_SPREAD_S = 0.013, 0.003
# Lateness of a pose against the gyro: half its mean, and the telemetry's latency.
LATE_S, LATE_SPREAD_S = -0.008, 0.003
ROUNDS = 6
# How far curvature moves a constant at the amplitudes of the experiments, standard deviation over its value; when several
# inputs are excited at once, products of three of them lie on lines.
CURVED, CURVED_TOGETHER = 0.04, 0.12
ALIKE = 4  # lines over which the model's errors may be alike
GYRO, CAMERAS = 1, 2  # places of a turn's rate and angle in its spectra


@dataclass(frozen=True, slots=True)
class Estimate:
    """Values and their 95 % intervals by name, with the inputs of the fit."""

    values: Mapping[str, float]
    errors: Mapping[str, float]  # half widths of the intervals
    misfit: float  # of the errors, over the scatter; 1: the model explains all
    late: tuple[float, ...] = ()  # [s] of the poses' stamps, by record
    covariance: Array | None = None  # of the values, in their order


@dataclass(frozen=True, slots=True)
class Excited:
    """An axis in a record."""

    axis: Axis
    record: int
    spectra: Spectra


def excited_axes(records: Sequence[Record]) -> list[Excited]:
    """Return the axes that are excited, by record. Raises `LabError` for a record that cannot be used."""
    found = []
    for number, record in enumerate(records):
        periods = period_spectra(record)
        for axis in AXES:
            if len(periods[0][axis.input]):
                found.append(Excited(axis, number, spectra_of(record, periods, axis.input, outputs(axis))))
    return found


def pose_lateness(excited: Sequence[Excited], record: int) -> float:
    """Return by how much poses are later than their stamps [s]: the gyro's angle against the cameras'."""
    above = below = 0.0
    for one in excited:
        if one.record != record or len(outputs(one.axis)) < 2:
            continue
        Z, w = one.spectra.Z, one.spectra.w
        ratio = Z[:, GYRO] / (1j * w) / Z[:, CAMERAS]
        variance = one.spectra.C[:, GYRO, GYRO].real / np.abs(Z[:, GYRO]) ** 2
        variance += one.spectra.C[:, CAMERAS, CAMERAS].real / np.abs(Z[:, CAMERAS]) ** 2
        above += float(np.sum(np.angle(ratio) * w / variance))
        below += float(np.sum(w * w / variance))
    return above / below if below else LATE_S


def instrumental(excited: Sequence[Excited], lag: float) -> Estimate:
    """Return the constants of every excited axis by instrumental variables, with the profile's servo lag [s]."""
    values: dict[str, float] = {}
    errors: dict[str, float] = {}
    misfits = []
    for axis in AXES:
        own = [(one.spectra, pose_lateness(excited, one.record)) for one in excited if one.axis is axis]
        if not own:
            continue
        for names, rows in _equations(axis):
            theta, covariance, misfit = _regress(own, rows, lag, DELAY_S)
            for spread, other in (
                (LAG_SPREAD * lag, _regress(own, rows, 1.05 * lag, DELAY_S)[0] - theta),
                (DELAY_SPREAD_S, _regress(own, rows, lag, DELAY_S + 0.05 * lag)[0] - theta),
            ):
                slope = other / (0.05 * lag)
                covariance = covariance + np.outer(slope, slope) * spread**2
            freedom = max(1, 2 * sum(len(spectra.w) for spectra, _ in own) - len(theta))
            values |= dict(zip(names, theta.tolist(), strict=True))
            half = student.ppf(0.5 + CONFIDENCE / 2, freedom) * np.sqrt(np.diag(covariance))
            errors |= dict(zip(names, half.tolist(), strict=True))
            misfits.append(misfit)
    return Estimate(values, errors, max(misfits, default=float("nan")))


# Shapes (L, S) and (L, n, S): left side and regressors as combinations of the spectra's signals.
Rows = tuple[Complex, Complex]


def _equations(axis: Axis) -> Iterator[tuple[list[str], Callable[[Array, Complex, float], Rows]]]:
    """Yield names of constants, and the function (w, F, late) that returns left side and regressors of their equation."""
    for affected in (RATE, VELOCITY):
        names = [name for name, term in axis.terms.items() if term[0] == affected]
        if names:
            yield names, partial(_equation, axis, affected)


def _equation(axis: Axis, affected: str, w: Array, F: Complex, late: float) -> Rows:
    s: Complex = 1j * w
    signals = 1 + len(outputs(axis))
    # What telemetry says of each state: a signal, and the factor on it. Angles are those of the gyro.
    of = {FLAP: (0, F), RATE: (1, s**0), ANGLE: (1, 1 / s), VELOCITY: (signals - 1, s * np.exp(s * late))}
    causes = [cause for state, cause in axis.terms.values() if state == affected]
    combined = np.zeros((len(w), 1 + len(causes), signals), complex)
    for row, state in enumerate((affected, *causes)):
        signal, factor = of[state]
        combined[:, row, signal] = factor * (s if row == 0 else 1)
    return combined[:, 0], combined[:, 1:]


def _regress(
    own: Sequence[tuple[Spectra, float]],
    rows: Callable[[Array, Complex, float], Rows],
    lag: float,
    delay: float,
) -> tuple[Array, Array, float]:
    """Return the constants of one equation, their covariance, and the misfit; weights follow the constants."""
    sides = [rows(spectra.w, flap_response(spectra.w, lag, delay), late) for spectra, late in own]
    left, right = (np.concatenate(side) for side in zip(*sides, strict=True))
    w, Z, C = (np.concatenate([getattr(spectra, name) for spectra, _ in own]) for name in ("w", "Z", "C"))
    count = right.shape[1]
    weights = 1.0 / w**2
    for _ in range(ROUNDS):
        root = np.sqrt(weights)
        A = root[:, None] * np.einsum("lns,ls->ln", right, Z)
        b = root * np.einsum("ls,ls->l", left, Z)
        both, target = np.concatenate([A.real, A.imag]), np.concatenate([b.real, b.imag])
        theta = np.linalg.lstsq(both, target, rcond=None)[0]
        mix = left - np.einsum("lns,n->ls", right, theta)
        weights = 2.0 / np.einsum("ls,lst,lt->l", mix, C, mix.conj()).real
    residual = target - both @ theta
    misfit = float(np.sum(residual**2) / max(1, len(target) - count))
    covariance = np.linalg.pinv(both.T @ both) * max(1.0, misfit)
    return theta, covariance, misfit


def joint(
    excited: Sequence[Excited],
    lag: float,
    start: Mapping[str, float],
    fixed: Mapping[str, float] | None = None,
) -> Estimate:
    """Return all excited axes' constants, lag and delay by the joint fit; `fixed` ones keep their values."""
    fixed = fixed or {}
    names = [name for axis in AXES if any(one.axis is axis for one in excited) for name in axis.constants]
    names = [name for name in (*names, LAG, DELAY) if name not in fixed]
    records = sorted({one.record for one in excited})
    begin = {**start, LAG: lag, DELAY: DELAY_S} | dict(fixed)
    x0 = np.array([*(begin[name] for name in names), *(pose_lateness(excited, record) for record in records)])
    scale = np.concatenate([np.maximum(np.abs(x0[: len(names)]), 1e-3), np.full(len(records), LATE_SPREAD_S)])

    def errors(x: Array) -> Array:
        theta = x * scale
        values = {**begin, **dict(zip(names, theta[: len(names)], strict=True))}
        late = dict(zip(records, theta[len(names) :], strict=True))
        parts = [whitened(one, values, late[one.record]) for one in excited]
        prior = [(values[LAG] / lag - 1) / LAG_SPREAD, (values[DELAY] - DELAY_S) / DELAY_SPREAD_S]
        return np.concatenate(
            [*parts, prior, [(late[record] - LATE_S) / LATE_SPREAD_S for record in records]]
        )

    found = least_squares(errors, x0 / scale, x_scale="jac", max_nfev=200)
    count = len(found.fun)
    misfit = 2 * found.cost / max(1, count - len(x0))
    inverse = np.linalg.pinv(found.jac.T @ found.jac)
    covariance = inverse @ _meat(excited, found.fun, found.jac) @ inverse * np.outer(scale, scale)
    half = student.ppf(0.5 + CONFIDENCE / 2, max(1, count - len(x0))) * np.sqrt(np.diag(covariance))
    theta = found.x * scale
    together = len({one.record for one in excited}) < len(excited)
    curved = 2.0 * (CURVED_TOGETHER if together else CURVED) * np.abs(theta[: len(names)])
    curved *= [name not in (LAG, DELAY) for name in names]
    half = np.hypot(half[: len(names)], curved)
    return Estimate(
        dict(zip(names, theta.tolist()[: len(names)], strict=True)),
        dict(zip(names, half.tolist(), strict=True)),
        float(misfit),
        tuple(theta.tolist()[len(names) :]),
        covariance[: len(names), : len(names)],
    )


def _meat(excited: Sequence[Excited], errors: Array, J: Array) -> Array:
    """Return the information matrix with each output's actual errors: larger than the scatter, and correlated from line
    to line, where the linear model does not explain everything.
    """
    weights = np.ones(len(errors))
    place = 0
    for one in excited:
        shown, count = len(outputs(one.axis)), len(one.spectra.w)
        block = slice(place, place + 2 * shown * count)
        place += 2 * shown * count
        own = errors[block].reshape(2, count, shown)
        power = np.mean(own**2, axis=(0, 1))
        alike = power.copy()
        for step in range(1, min(ALIKE, count - 1) + 1):
            alike += 2 * (1 - step / (ALIKE + 1)) * np.mean(own[:, step:] * own[:, :-step], axis=(0, 1))
        weights[block] = np.broadcast_to(np.maximum(np.maximum(alike, power), 1.0), own.shape).ravel()
    meat: Array = (J * weights[:, None]).T @ J
    return meat


def whitened(one: Excited, values: Mapping[str, float], late: float) -> Array:
    """Return the errors of the predicted outputs in units of their scatter, real and imaginary parts."""
    Z, C = one.spectra.Z, one.spectra.C
    G = response(one.axis, values, one.spectra.w, late)
    error = Z[:, 1:] - G * Z[:, :1]
    T = np.concatenate(
        [-G[:, :, None], np.broadcast_to(np.eye(G.shape[1]), (len(G), G.shape[1], G.shape[1]))], axis=2
    )
    covariance = np.einsum("lis,lst,ljt->lij", T, C, T.conj())
    white = np.sqrt(2.0) * np.linalg.solve(np.linalg.cholesky(covariance), error[:, :, None])[:, :, 0]
    return np.concatenate([white.real.ravel(), white.imag.ravel()])
