"""`floaty identify`: estimates every constant from a set of flights, by three methods, and judges the reliability.

The instrumental variables and the joint fit use flights with an excitation, the paper's method pairs without one and with
different gains. Constants refer to the mean flap angles of the flights. A constant is `identified` when the joint fit's
95 % interval is narrow, the instruments agree, the response follows the excitation and the linear model explains the log;
`weak` when its sign and size are known; else `not identifiable`: its number is then arbitrary.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import combinations
from math import floor, hypot, inf, isnan, log10, nan

import numpy as np

from hil.errors import LabError
from hil.research.design.axes import AXES, NUISANCES
from hil.research.identify.joint import Estimate, Excited, excited_axes, identities, instrumental, joint
from hil.research.identify.plates import plant_of, turns_of
from hil.research.identify.record import Record
from hil.research.identify.response import DELAY, LAG, UNIT
from hil.research.identify.spectra import windows
from hil.research.identify.two_controllers import two_controllers
from hil.world.floaty.correction import PAPER_TABLE, OperatingPoint

IDENTIFIED, WEAK, UNKNOWN = "identified", "weak", "not identifiable"
NARROW, KNOWN = 0.25, 0.7  # half width of the interval over the value
EXPLAINED = 10.0  # largest misfit at which the linear model explains the log
# Shares of the rows. With u2 of 0.16 rad rms flaps are at their limits in 16 %, and x_pitch is wrong; in the flights of the
# experiments in less than 4 %.
SATURATED, LOST = 0.15, 0.30
COHERENT = 0.35  # smallest mean coherence of an axis with its excitation; pure noise has 1 over the realisations plus 1
PLAUSIBLE = 10.0  # times the profile's value


@dataclass(frozen=True, slots=True)
class IdentifiedConstant:
    """One constant: (value, half width of its 95 % interval) by method; NaN where a method gives none."""

    name: str
    unit: str
    paper: tuple[float, float]  # value and printed ±
    truth: float  # of the plant's linearisation
    two_controllers: tuple[float, float]
    instrumental: tuple[float, float]
    joint: tuple[float, float]
    verdict: str
    why: str

    @property
    def best(self) -> float:
        return self.joint[0]

    @property
    def cells(self) -> dict[str, str]:
        """The texts of a table's row, by heading."""
        return {
            "constant": self.name, "paper": _printed(*self.paper), "truth": interval_text(self.truth),
            "paper's method": interval_text(*self.two_controllers),
            "instruments": interval_text(*self.instrumental), "joint fit": interval_text(*self.joint),
            "unit": self.unit, "verdict": f"{self.verdict}: {self.why}",
        }  # fmt: skip

    @property
    def differs(self) -> bool:
        """Whether the instruments and the joint fit contradict each other."""
        return abs(self.joint[0] - self.instrumental[0]) > hypot(self.joint[1], self.instrumental[1])

    @property
    def contains_truth(self) -> bool:
        """Whether the joint interval contains the truth."""
        return abs(self.joint[0] - self.truth) <= self.joint[1]


@dataclass(frozen=True, slots=True)
class Identification:
    constants: tuple[IdentifiedConstant, ...]
    excited: tuple[Excited, ...]
    estimate: Estimate  # of the joint fit
    records: tuple[Record, ...]  # with an excitation, in the order of `excited`
    free: tuple[Record, ...]  # without

    def constant(self, name: str) -> IdentifiedConstant:
        return next(constant for constant in self.constants if constant.name == name)


def rows_of(constants: Sequence[IdentifiedConstant]) -> list[dict[str, str]]:
    """Return the rows of a table of constants, without columns that are empty in every row."""
    rows = [constant.cells for constant in constants]
    filled = [name for name in rows[0] if any(row[name] for row in rows)] if rows else []
    return [{name: row[name] for name in filled} for row in rows]


def _printed(value: float, half: float) -> str:
    """Return a value of the paper as it is printed there; empty without one."""
    return "" if isnan(value) else f"{value:g}" + ("" if isnan(half) else f" ± {half:g}")


def interval_text(value: float, half: float = nan, digits: int = 4) -> str:
    """Return a value with the half width of its interval, both to the half width's second digit; empty without a value.

    A value alone has `digits` digits.
    """
    if isnan(value):
        return ""
    if not 0.0 < half < inf:
        return np.format_float_positional(value, digits, fractional=False, trim="-")
    places = 1 - floor(log10(half))
    return " ± ".join(f"{round(number, places):.{max(places, 0)}f}" for number in (value, half))


def identify(records: Sequence[Record]) -> Identification:
    """Return the identification from flights. Raises `LabError` for logs that determine no constant."""
    for record in records:
        if record.lost_rows > LOST:
            raise LabError(
                f"{record.name}: {record.lost_rows:.0%} of the telemetry's rows are missing; at most {LOST:.0%} may be"
            )
    for one, other in combinations(records, 2):
        if _is_same(one, other):
            raise LabError(f"{other.name}: the same flight as {one.name}: each flight counts once")
    rich = tuple(record for record in records if record.excitation.any())
    free = tuple(record for record in records if not record.excitation.any())
    printed = two_controllers(free)
    if not rich and not printed:
        names = ", ".join(record.name for record in records)
        raise LabError(
            f"{names}: no excitation, and no two flights with different attitude gains: from the flow's disturbance alone "
            "no constant can be identified; fly identify, or identify-u1 to identify-u4"
        )
    excited = tuple(excited_axes(rich))
    model = (rich or free)[0].config.model
    by_instruments = instrumental(excited, 1.0 / model.flap_rate)
    fitted = _joint(excited, by_instruments, rich[0]) if excited else Estimate({}, {}, nan)
    constants = []
    paper = PAPER_TABLE if records[0].config.robot.has_plates else {}
    for name, truth in _truths(records[0], rich, excited).items():
        constant = IdentifiedConstant(
            name, UNIT[name], paper.get(name, (nan, nan)), truth, printed.get(name, (nan, nan)),
            (by_instruments.values.get(name, nan), by_instruments.errors.get(name, nan)),
            (fitted.values.get(name, nan), fitted.errors.get(name, nan)), "", "",
        )  # fmt: skip
        own = [one for one in excited if name in (*one.axis.constants, LAG, DELAY)]
        verdict, why = _verdict(constant, Evidence.of(fitted, rich, own), getattr(model, name, nan))
        constants.append(replace(constant, verdict=verdict, why=why))
    return Identification(tuple(constants), excited, fitted, rich, free)


def check_held_out(held_out: Record, records: Sequence[Record]) -> None:
    """Raise `LabError` for a flight that cannot validate the fit of others."""
    windows(held_out)
    if any(_is_same(held_out, record) for record in records):
        raise LabError(f"--validate {held_out.name}: it is one of the fitted flights; expected another")
    fitted = np.any([record.excitation.any(axis=0) for record in records], axis=0)
    if not (fitted & held_out.excitation.any(axis=0)).any():
        raise LabError(f"--validate {held_out.name}: it excites no input of the fit")


def _is_same(one: Record, other: Record) -> bool:
    return np.array_equal(one.t, other.t) and np.array_equal(one.rates, other.rates)


def _joint(excited: Sequence[Excited], by_instruments: Estimate, record: Record) -> Estimate:
    """Return the joint fit, started at the instruments' and the profile's constants; a Floaty's includes the identities."""
    config, turns = record.config, dict.fromkeys(NUISANCES, 0.0)
    known: Callable[[Mapping[str, float]], list[float]] = _nothing
    if config.robot.has_plates:
        turns = turns_of(record)
        known = partial(identities, speed=config.plant.airspeed, turns=turns)
    begin = [by_instruments.values, {**config.model.model_dump(), **turns}]
    return joint(excited, 1.0 / config.model.flap_rate, begin, known)


def _nothing(values: Mapping[str, float]) -> list[float]:
    return []


def _truths(record: Record, rich: Sequence[Record], excited: Sequence[Excited]) -> dict[str, float]:
    """Return every constant's true value at its excitation's flight, else at that of `record`; NaN if unknown."""
    flown = {one.axis.name: rich[one.record] for one in reversed(excited)}
    every: dict[str, float] = {}
    for axis in AXES:
        truth = truth_of(flown.get(axis.name, record))
        every |= {name: truth.get(name, nan) for name in axis.constants}
    return every | {LAG: truth.get(LAG, nan), DELAY: nan}


def operating_point(record: Record) -> OperatingPoint:
    u, attitude = record.u.mean(axis=0).tolist(), record.pose[:, 3:].mean(axis=0).tolist()
    tunnel = record.config.tunnel
    return OperatingPoint((*u,), (*attitude,), tunnel.side_wind, tunnel.fan_factor * tunnel.speed)


def truth_of(record: Record) -> dict[str, float]:
    """Return the plant's own constants at the point where a simulated Floaty flew; none for another flight."""
    config = record.config
    if not record.simulated or not config.robot.has_plates:
        return {}
    truth = plant_of(config).linearise(operating_point(record))
    return {**asdict(truth), LAG: config.actuators.tau}


@dataclass(frozen=True, slots=True)
class Evidence:
    """The evidence against a constant, besides its interval."""

    misfit: float
    saturated: float  # share of the rows of the worst record
    coherence: float  # of the axis' most coherent output with the excitation, mean over the lines

    @classmethod
    def of(cls, fitted: Estimate, records: Sequence[Record], own: Sequence[Excited]) -> Evidence:
        """Return the evidence for a constant of the axes `own`; lag and delay are those of all axes."""
        coherence = [float(one.spectra.coherence[:, 1:].max(axis=1).mean()) for one in own]
        saturated = max((record.saturated for record in records), default=0.0)
        return cls(fitted.misfit, saturated, max(coherence, default=1.0))


def _verdict(one: IdentifiedConstant, evidence: Evidence, usual: float) -> tuple[str, str]:
    """Return the verdict and its reason; `usual` is the constant in the flown profile, NaN if it has none."""
    value, half = one.joint
    if value != value:
        return UNKNOWN, "its axis is not excited"
    if one.name == DELAY:
        return WEAK, "held near the value that follows from the firmware's timing"
    if evidence.saturated > SATURATED:
        share = f"{evidence.saturated:.0%}"
        return UNKNOWN, f"flaps are at their limits in {share} of a log's rows: the response is not linear"
    if evidence.misfit > EXPLAINED:
        return UNKNOWN, f"the linear model misses the log by {evidence.misfit**0.5:.1f} times its scatter"
    if evidence.coherence < COHERENT:
        return UNKNOWN, f"coherence {evidence.coherence:.2f}: the response hardly follows the excitation"
    if one.differs:
        return UNKNOWN, "the instruments and the joint fit exclude each other"
    relative = half / abs(value) if value else float("inf")
    if relative <= KNOWN and abs(value) > PLAUSIBLE * abs(usual):
        return WEAK, f"± {relative:.0%}, but more than {PLAUSIBLE:g} times the profile's {usual:.4g}"
    if relative <= NARROW:
        return IDENTIFIED, f"± {relative:.0%}"
    if relative <= KNOWN:
        return WEAK, f"± {relative:.0%}: longer or stronger excitation"
    return UNKNOWN, f"± {relative:.0%}: the log hardly depends on it"
