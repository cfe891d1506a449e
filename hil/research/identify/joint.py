"""The two estimates that use the excitation: instrumental variables, and the joint fit of all axes.

Both use the cross spectra with the excitation (`hil.research.identify.spectra`), which the disturbance does not bias, and
weight each line by the disturbance's covariance there, not by that of white noise.

Instrumental variables: the axes' equations are linear in their constants; lag and delay are taken from the profile, and
their uncertainty is part of the intervals. Joint fit: all axes at once with one servo lag and one delay, by the errors of
the predicted outputs (`scipy.optimize.least_squares`), started from the former. Errors beyond the scatter of the periods
are model errors: the intervals grow with them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import t as student

from hil.research.design.axes import ANGLE, AXES, FLAP, NUISANCES, RATE, VELOCITY, Axis
from hil.research.identify.record import Array, Record
from hil.research.identify.response import DELAY, LAG, flap_response, outputs, response
from hil.research.identify.spectra import Complex, Spectra, period_spectra, spectra_of
from hil.world.motion import GRAVITY

CONFIDENCE = 0.95
LAG_SPREAD = 0.2  # of the profile's lag, standard deviation
# Half a tick of holding, the PWM period, computing, half the gyro's mean.
DELAY_S, DELAY_SPREAD_S = 0.013, 0.003
# Lateness of a pose against the gyro: half the gyro's mean, and the telemetry's latency.
LATE_S, LATE_SPREAD_S = -0.008, 0.003
ROUNDS = 6
# Errors of the identities of flat plates, standard deviations.
STIFFNESS_SPREAD, STIFFNESS_LEAST = 0.05, 0.1  # of the value, and [rad/s/m]
DAMPING_SPREAD, TURN_SPREAD = 0.03, 0.015  # [1/s], [m/s/rad]
DIFFERENCE = 1e-6  # of a parameter over its size
# Of a constant, standard deviation: curvature that `hil.research.identify.plates` does not straighten.
BENT = 0.03
SIGMAS = 1.96
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
    """Return the excited axes by record. Raises `LabError` for an unusable record."""
    found = []
    for number, record in enumerate(records):
        periods = period_spectra(record)
        for axis in AXES:
            if len(periods[0][axis.input]):
                found.append(Excited(axis, number, spectra_of(record, periods, axis.input, outputs(axis))))
    return found


def pose_lateness(excited: Sequence[Excited], record: int) -> float:
    """Return the lateness of poses against their stamps [s]: the gyro's angle against the cameras'."""
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
    # The telemetry signal of each state, and the factor on it. Angles are the gyro's.
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


@dataclass(frozen=True, slots=True)
class JointFit:
    """The least-squares problem of all excited axes; parameters are in units of `scale`, the poses' lateness last."""

    excited: Sequence[Excited]
    names: Sequence[str]
    records: Sequence[int]
    scale: Array
    lag: float  # [s] of the profile
    known: Callable[[Mapping[str, float]], list[float]]  # differences from prior knowledge, in its units

    def parted(self, x: Array) -> tuple[dict[str, float], dict[int, float]]:
        """Return constants by name, and the lateness of poses by record [s]."""
        theta = (x * self.scale).tolist()
        late = dict(zip(self.records, theta[len(self.names) :], strict=True))
        return dict(zip(self.names, theta, strict=False)), late

    def prior(self, x: Array) -> Array:
        """Return the parameters' differences from prior knowledge."""
        values, late = self.parted(x)
        usual = [(values[LAG] / self.lag - 1) / LAG_SPREAD, (values[DELAY] - DELAY_S) / DELAY_SPREAD_S]
        usual += [(late[record] - LATE_S) / LATE_SPREAD_S for record in self.records]
        return np.array([*usual, *self.known(values)])

    def errors(self, x: Array) -> Array:
        """Return all errors in units of their scatter."""
        values, late = self.parted(x)
        return np.concatenate(
            [*(whitened(one, values, late[one.record]) for one in self.excited), self.prior(x)]
        )

    def slopes(self, x: Array) -> Array:
        """Return the derivatives of the errors, of each axis only by its own parameters."""
        at, known = self.errors(x), self.prior(x)
        found = np.zeros((len(at), len(x)))
        for column, name in enumerate([*self.names, *self.records]):
            moved = x.copy()
            moved[column] += DIFFERENCE
            values, late = self.parted(moved)
            row = 0
            for one in self.excited:
                end = row + 2 * len(one.spectra.w) * len(outputs(one.axis))
                if name in (LAG, DELAY, one.record) or name in one.axis.constants:
                    found[row:end, column] = whitened(one, values, late[one.record]) - at[row:end]
                row = end
            found[row:, column] = self.prior(moved) - known
        return found / DIFFERENCE

    def solved(self, x: Array) -> OptimizeResult:
        """Return the solution reached from x."""
        return least_squares(self.errors, x, self.slopes, x_scale="jac", max_nfev=100)


def joint(
    excited: Sequence[Excited],
    lag: float,
    begin: Sequence[Mapping[str, float]],
    known: Callable[[Mapping[str, float]], list[float]],
) -> Estimate:
    """Return all excited axes' constants, lag and delay by the joint fit, the best of several starts.

    `lag` [s] is the profile's; `known` returns the constants' differences from prior knowledge, in units of its uncertainty.
    """
    names = [name for axis in AXES if any(one.axis is axis for one in excited) for name in axis.constants]
    names += [LAG, DELAY]
    records = sorted({one.record for one in excited})
    late = [pose_lateness(excited, record) for record in records]
    starts = [{LAG: lag, DELAY: DELAY_S} | dict(one) for one in begin]
    starts += [starts[0] | {LAG: lag * (1 + LAG_SPREAD)}, starts[0] | {LAG: lag * (1 - LAG_SPREAD)}]
    size = np.abs([starts[0][name] for name in names])
    scale = np.concatenate([np.maximum(size, 1e-3), np.full(len(records), LATE_SPREAD_S)])
    fit = JointFit(excited, names, records, scale, lag, known)
    solutions = [fit.solved(np.array([*(one[name] for name in names), *late]) / scale) for one in starts]
    found = min(solutions, key=lambda result: float(result.cost))
    misfit = 2 * found.cost / max(1, len(found.fun) - len(found.x))
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * max(1.0, misfit) * np.outer(scale, scale)
    values = dict(zip(names, (found.x * scale).tolist(), strict=False))
    spread = np.sqrt(np.diag(covariance))[: len(names)]
    spread = np.hypot(spread, [0.0 if name == DELAY else BENT * abs(values[name]) for name in names])
    half = SIGMAS * spread
    errors, lateness = dict(zip(names, half.tolist(), strict=True)), (found.x * scale).tolist()[len(names) :]
    own = covariance[: len(names), : len(names)]
    return Estimate(values, errors, float(misfit), tuple(lateness), own)


def identities(values: Mapping[str, float], speed: float, turns: Mapping[str, float]) -> list[float]:
    """Return the constants' differences from the identities of flat plates in a flow, in usual units.

    A horizontal velocity tilts the wind like the same angle of the robot (docs/explanation/plant.md). `speed` [m/s] is
    the tunnel's, `turns` the plates' x_rate and y_rate.
    """
    left = []
    if "roll_vy" in values:
        expected = -values["roll_roll"] / speed
        left += [(values["roll_vy"] - expected) / (STIFFNESS_SPREAD * abs(expected) + STIFFNESS_LEAST)]
        left += [(values["y_vy"] + (GRAVITY + values["y_roll"]) / speed) / DAMPING_SPREAD]
    if "pitch_vx" in values:
        expected = values["pitch_pitch"] / speed
        left += [(values["pitch_vx"] - expected) / (STIFFNESS_SPREAD * abs(expected) + STIFFNESS_LEAST)]
        left += [(values["x_vx"] + (GRAVITY - values["x_pitch"]) / speed) / DAMPING_SPREAD]
    return left + [(values[name] - turns[name]) / TURN_SPREAD for name in NUISANCES if name in values]


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
