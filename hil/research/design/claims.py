"""Compares the paper's claims about its design with the plate model of a robot, with reasons for differences.

Sections: "Embodied intelligence through design optimization" with Fig. robustness f and g; of the Supplement "Detailed
derivation of scaling analysis", "Force analysis", "Torque analysis" and the Table of dynamics constants.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import degrees

import numpy as np

from hil.research.design import sweeps
from hil.research.design.authority import wrenches
from hil.research.design.axes import AXES, PITCH, ROLL
from hil.research.design.linear import Point, places
from hil.research.design.trim import balanced
from hil.world.floaty.correction import PAPER_TABLE
from hil.world.floaty.geometry import weigh

AGREES, DIFFERS, NOTHING = "agrees", "differs", "no value"
ROUGHLY = 0.15  # relative deviation that "approximately" covers

DESIGN, SCALING = "Design optimization, Fig. robustness f, g", "Scaling analysis"
FORCES, CONSTANTS = "Force and torque analysis", "Table of dynamics constants"

# Why a constant of the Table differs: docs/explanation/plant.md, Where the paper contradicts itself
RATES = (
    "Plates damp by 1 to 3 1/s; the Table's value is that of a loop closed by the firmware's own rate gain."
)
PITCH_INERTIA = "13 times too large for any plate model of 0.34 kg: as if I_yy were 1e-4 kg m²."
SIDE = (
    "The five force constants mix balance, plate model and flight: no one geometry has them all. With the firmware's "
    "measured normal-force factor z/u4 is 3.05 and y/u1 -4.81."
)
WHY = {
    "roll_rate": RATES, "pitch_rate": RATES, "yaw_rate": RATES, "pitch_u2": PITCH_INERTIA, "pitch_pitch": PITCH_INERTIA,
    "y_u1": SIDE, "y_roll": SIDE, "x_u2": SIDE, "x_pitch": SIDE, "z_u4": SIDE,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim of the paper and the computed value."""

    title: str
    place: str
    paper: str
    ours: str
    verdict: str
    why: str = ""  # reason for the difference, or a reading aid


def _near(ours: float, paper: float) -> str:
    return AGREES if abs(ours - paper) <= ROUGHLY * abs(paper) else DIFFERS


def _holds(whether: bool) -> str:
    return AGREES if whether else DIFFERS


def text_of(poles: list[complex]) -> str:
    found = []
    for pole in poles:
        if pole.imag > 1e-9:
            found.append(f"{pole.real:.2f} ± {pole.imag:.2f}i")
        elif abs(pole.imag) <= 1e-9:
            found.append(f"{pole.real:.2f}")
    return ", ".join(found) + " 1/s"


def claims(
    point: Point,
    stability: sweeps.Stability,
    angles: sweeps.HoverAngles,
    laws: tuple[sweeps.PowerLaw, ...],
    model_error: float,
) -> list[Claim]:
    """Return every claim of the design sections, with the figures of one robot."""
    return [
        *_flat_high(point),
        *_stable(point, stability),
        *_authority(point, angles),
        *_scale(point, laws),
        *_forces(point, model_error),
    ]


def _flat_high(point: Point) -> Iterator[Claim]:
    """Yield the claims about flat flaps with the centre of mass in their plane."""
    high = sweeps.flat_high(point).linear
    lowered = balanced(point.geometry, 0.0, kink_angle=0.0)
    moved = replace(point, geometry=lowered).linear.constants.roll_roll
    unstable, growth = high.constants.roll_roll, high.growth(ROLL)
    yield Claim(
        "flat flaps, centre of mass in their plane: f_αα", DESIGN, "≈ +100 1/s²", f"{unstable:+.1f} 1/s²",
        _near(unstable, 100.0),
        f"At the inertia of the robot as it is; with masses moved up it is smaller, and f_αα {moved:+.0f}. The paper gives "
        "neither the inertia nor the height of its first robot.",
    )  # fmt: skip
    yield Claim(
        "the same: unstable pole", DESIGN, "p₁ ≈ 9.5 1/s", f"{growth:.2f} 1/s", _near(growth, 9.5),
        "√f_αα would be the pole without damping and without the drift in y.",
    )  # fmt: skip
    yield Claim(
        "flat flaps: pitch is stable by its V", DESIGN, "stable", text_of(high.poles(PITCH)),
        _holds(high.growth(PITCH) < 0.0),
    )  # fmt: skip


def _stable(point: Point, sweep: sweeps.Stability) -> Iterator[Claim]:
    linear, f = point.linear, point.linear.constants
    ours = f"{f.roll_roll:+.1f} 1/s²"
    yield Claim("kink and low centre of mass: f_αα", DESIGN, "≈ -16 1/s²", ours, _near(f.roll_roll, -16.0))
    first_pole = linear.poles(ROLL)[0]
    yield Claim(
        "the same: roll poles", DESIGN, "-0.5 ± 4i", text_of(linear.poles(ROLL)),
        _holds(abs(first_pole - complex(-0.5, 4.0)) < ROUGHLY * 4.0),
        "The real pole is the drift in y. These poles need a rate constant of -1 to -2, not the Table's -40.",
    )  # fmt: skip
    yield Claim(
        "kink angle: optimised for stability with a margin", DESIGN, "42.5°; margin not given",
        f"stable from {degrees(sweep.crossing):.1f}° on: {degrees(point.geometry.kink_angle - sweep.crossing):+.1f}°",
        _holds(point.geometry.kink_angle > sweep.crossing),
    )  # fmt: skip
    ours, holds = text_of(linear.poles(PITCH)), _holds(linear.growth(PITCH) < 0)
    yield Claim("pitch stays stable by its V", DESIGN, "stable", ours, holds)
    yield Claim(
        "rates are damped in roll and pitch", DESIGN, "both < 0", f"{f.roll_rate:.2f}, {f.pitch_rate:.2f} 1/s",
        _holds(f.roll_rate < 0 and f.pitch_rate < 0),
    )  # fmt: skip
    own = np.zeros_like(linear.A, dtype=bool)
    for states in [*map(places, AXES), [5, 8]]:
        own[np.ix_(states, states)] = True
    foreign = float(np.abs(linear.A[~own]).max())
    ours, holds = f"largest entry between parts {foreign:.0e}", _holds(foreign < 1e-6)
    yield Claim("dynamics decouple into roll, pitch, yaw and height", DESIGN, "four parts", ours, holds)


def _authority(point: Point, angles: sweeps.HoverAngles) -> Iterator[Claim]:
    for criterion in angles.criteria:
        best, low, high = (degrees(angle) for angle in angles.best(criterion))
        yield Claim(
            f"best hover angle by {criterion}", DESIGN, "20 to 25°",
            f"{best:.1f}°; within 5 % from {low:.1f} to {high:.1f}°",
            _holds(low <= 25.0 and high >= 20.0), "The paper does not say how it weighs the axes against one another.",
        )  # fmt: skip
    yaw, *rest = (angles.constants[name] for name in ("yaw", "roll", "pitch", "lift"))
    trend = bool((np.diff(yaw) < 0).all() and all(np.diff(one)[:50].min() > 0 for one in rest))
    yield Claim(
        "a smaller hover angle: more yaw, less pitch, roll and height", DESIGN, "so", "so up to 35°" if trend else "not so",
        _holds(trend), f"Pitch is lost first: {_sign_change(angles)}",
    )  # fmt: skip
    low, high = sweeps.updrafts(point)
    yield Claim(
        "updrafts that the flaps hold", "Robustness", "8 to 11 m/s", f"{low:.2f} to {high:.2f} m/s",
        _holds(low <= 8 and high >= 11),
        "With 8° of every flap left for attitude. Below, even flat flaps carry less than the weight.",
    )  # fmt: skip


def _sign_change(angles: sweeps.HoverAngles) -> str:
    pitch = angles.constants["pitch"]
    changes = np.flatnonzero(pitch[:-1] * pitch[1:] < 0.0)
    if not len(changes):
        return "never."
    return f"its input constant changes sign at {degrees(sweeps.OPENINGS[changes[0]]):.1f}°."


def _scale(point: Point, laws: tuple[sweeps.PowerLaw, ...]) -> Iterator[Claim]:
    for law in laws:
        yield Claim(
            f"{law.quantity} over {law.cause}", SCALING, f"exponent {law.paper:g}", f"{round(law.exponent, 6) + 0.0:.4f}",
            _holds(abs(law.exponent - law.paper) < 1e-6),
        )  # fmt: skip
    number = sweeps.reynolds(point)
    yield Claim(
        "Reynolds number", SCALING, "≈ 2e5", f"{number:.3g}", _near(number, 2e5),
        "With the side of the footprint; 2.2e5 with its diagonal. The formula needs the dynamic viscosity, which the main "
        "text calls kinematic.",
    )  # fmt: skip


def _forces(point: Point, model_error: float) -> Iterator[Claim]:
    yield Claim(
        "plant and the Supplement's plate equations", FORCES, "the same", f"differ by at most {model_error:.0e} N, N m",
        _holds(model_error < 1e-9),
    )  # fmt: skip
    hover = np.full((1, 4), point.opening)
    force = wrenches(point.geometry, hover, 1.0)[0]
    aside = float(np.abs(np.delete(force, 2)).max() / force[2])
    ours, holds = f"{aside:.0e} of the lift", _holds(aside < 1e-9)
    yield Claim("at hover neither lateral force nor torque", FORCES, "zero", ours, holds)
    f = point.linear.constants
    yield Claim(
        "lateral forces cancel under u1 and u2", FORCES, "zero", f"y/u1 {f.y_u1:.2f}, x/u2 {f.x_u2:.2f} m/s²",
        _holds(abs(f.y_u1) < 0.01 and abs(f.x_u2) < 0.01),
        "Nor by the Supplement's own sign tables, which leave 4 F'; the Table has -4.8 and -0.8.",
    )  # fmt: skip
    for name, (paper, error) in PAPER_TABLE.items():
        ours = getattr(f, name)
        inside = abs(ours - paper) <= error
        yield Claim(
            name.replace("_", " per "), CONSTANTS, f"{paper:g} ± {error:g}", f"{ours:.4g}", _holds(inside),
            "" if inside else WHY.get(name, ""),
        )  # fmt: skip


def robot_lines(point: Point) -> list[tuple[str, str]]:
    """Return a description of the robot, in words and figures."""
    weight, linear = weigh(point.geometry), point.linear
    ix, iy, iz = (1e3 * moment for moment in weight.inertia)
    low, high = sweeps.updrafts(point)
    return [
        ("mass, centre of mass below the flaps", f"{weight.mass:.3f} kg, {100 * weight.axis_height:.1f} cm"),
        ("inertia about x, y, z", f"{ix:.3f}, {iy:.3f}, {iz:.3f} g m²"),
        ("kink, footprint, base", f"{degrees(point.geometry.kink_angle):.1f}°, {100 * point.geometry.footprint:.1f} cm, "
                                  f"{100 * point.geometry.base_side:.1f} cm"),
        ("hover", f"{degrees(point.opening):.1f}° at {point.speed:.2f} m/s, C_D = {point.coefficient:.3f}"),
        ("updrafts with 8° left for attitude", f"{low:.2f} to {high:.2f} m/s"),
        *((f"poles, {axis.name}", text_of(linear.poles(axis))) for axis in AXES),
    ]  # fmt: skip
