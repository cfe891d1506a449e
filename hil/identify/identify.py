"""`floaty identify`: estimates of every constant from a set of flights, by three methods, and how reliable they are.

Flights with an excitation go to the instrumental variables and the joint fit, pairs without one and with different gains to
the paper's method. A constant is `identified` when the joint fit's 95 % interval is narrow and the linear model explains the
log, `weak` when its sign and size are known, else `not identifiable`; then its number is only where the fit stopped.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isnan, nan

from hil.design.axes import AXES
from hil.errors import LabError
from hil.identify.joint import Estimate, Excited, excited_axes, instrumental, joint
from hil.identify.record import Record
from hil.identify.response import DELAY, LAG, UNIT
from hil.identify.two_controllers import two_controllers
from hil.laboratory.robot import Streams
from hil.world.paper_table import PAPER_TABLE
from hil.world.plant import Plant

IDENTIFIED, WEAK, UNKNOWN = "identified", "weak", "not identifiable"
NARROW, KNOWN = 0.25, 0.7  # half width of the interval over the value
EXPLAINED = 10.0  # misfit beyond which the linear model does not explain the log
SATURATED, LOST = 0.05, 0.30  # shares of the rows


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
        """The joint fit's value."""
        return self.joint[0]

    @property
    def contains_truth(self) -> bool:
        """Whether the joint interval contains the truth."""
        return abs(self.joint[0] - self.truth) <= self.joint[1]


@dataclass(frozen=True, slots=True)
class Identification:
    """The estimated constants of a robot."""

    constants: tuple[IdentifiedConstant, ...]
    excited: tuple[Excited, ...]
    estimate: Estimate  # of the joint fit
    records: tuple[Record, ...]  # with an excitation, in the order that `excited` refers to
    free: tuple[Record, ...]  # without

    def constant(self, name: str) -> IdentifiedConstant:
        """Return one by its name."""
        return next(constant for constant in self.constants if constant.name == name)


def interval_text(value: float, half: float = nan, digits: int = 4) -> str:
    """Return a value with the half width of its interval; empty without a value."""
    if isnan(value):
        return ""
    return f"{value:.{digits}g}" + ("" if isnan(half) else f" ± {half:.2g}")


def identify(records: Sequence[Record]) -> Identification:
    """Return the identification from flights. Raises `LabError` for logs that determine no constant."""
    for record in records:
        if record.lost_rows > LOST:
            raise LabError(
                f"{record.name}: {record.lost_rows:.0%} of the telemetry's rows are missing; at most {LOST:.0%} may be"
            )
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
    lag = 1.0 / (rich or free)[0].config.model.flap_rate
    by_instruments = instrumental(excited, lag)
    fitted = joint(excited, lag, by_instruments.values) if excited else Estimate({}, {}, nan)
    truth = _truth(records[0])
    constants = []
    for name in [name for axis in AXES for name in axis.constants] + [LAG, DELAY]:
        printed_pair, instruments, joint_pair = (
            printed.get(name, (nan, nan)),
            (by_instruments.values.get(name, nan), by_instruments.errors.get(name, nan)),
            (fitted.values.get(name, nan), fitted.errors.get(name, nan)),
        )
        verdict, why = _verdict(name, joint_pair, fitted, rich)
        constants.append(
            IdentifiedConstant(
                name, UNIT[name], PAPER_TABLE.get(name, (nan, nan)), truth.get(name, nan), printed_pair, instruments,
                joint_pair, verdict, why,
            )
        )  # fmt: skip
    return Identification(tuple(constants), excited, fitted, rich, free)


def _truth(record: Record) -> Mapping[str, float]:
    """Return the plant's own constants; none for a real flight."""
    if not record.simulated:
        return {}
    config = record.config
    plant = Plant(config.geometry, config.plant, config.tunnel, config.actuators, Streams.of_seed(1).gusts)
    return {**asdict(plant.linearise()), LAG: config.actuators.tau}


def _verdict(
    name: str, found: tuple[float, float], fitted: Estimate, records: Sequence[Record]
) -> tuple[str, str]:
    value, half = found
    if value != value:
        return UNKNOWN, "its axis is not excited"
    if name == DELAY:
        return WEAK, "held near the value that follows from the firmware's timing"
    worst = max(record.saturated for record in records)
    if worst > SATURATED:
        return (
            UNKNOWN,
            f"flaps are at their limits in {worst:.0%} of a log's rows: the response is not linear",
        )
    if fitted.misfit > EXPLAINED:
        return UNKNOWN, f"the linear model misses the log by {fitted.misfit**0.5:.1f} times its scatter"
    relative = half / abs(value) if value else float("inf")
    if relative <= NARROW:
        return IDENTIFIED, f"± {relative:.0%}"
    if relative <= KNOWN:
        return WEAK, f"± {relative:.0%}: longer or stronger excitation"
    return UNKNOWN, f"± {relative:.0%}: the log hardly depends on it"
