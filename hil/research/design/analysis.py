"""The computations of `floaty design` for one robot, and its files: pictures, table, page."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from firmware_py.compiling import bound
from hil.laboratory.files.whole_files import write_whole
from hil.pictures.pages import saved, write_page
from hil.research.design import figures
from hil.research.design.authority import QUANTITIES, attainable, authorities, pressure_at, single, wrenches
from hil.research.design.claims import Claim, claims, robot_lines
from hil.research.design.linear import Point, calm_plates
from hil.research.design.sweeps import hover_angles, scaling, stability
from hil.world.floaty.shape import SIGNS
from hil.world.motion import evaluate

CHECKED = 200  # openings at which plant and plate equations are compared


@dataclass(frozen=True, slots=True)
class Analysis:
    point: Point
    robot: list[tuple[str, str]]
    inputs: list[tuple[str, str, str]]  # input, alone, about the hover
    claims: list[Claim]
    pictures: list[tuple[str, str, str, Callable[[], Figure]]]  # name, title, caption


def model_error(point: Point) -> float:
    """Return the largest difference between the flown plant and the Supplement's plates, [N] or [N m], over openings."""
    plates = calm_plates(point.geometry, point.speed, point.opening)
    press = bound(evaluate, *plates)
    places = np.stack(
        [np.linspace(point.low, point.high, CHECKED) * f % point.high for f in (1.0, 1.7, 2.3, 3.1)], axis=1
    )
    expected = wrenches(point.geometry, places, pressure_at(point.geometry, point.opening))
    worst = 0.0
    for openings, wanted in zip(places, expected, strict=True):
        plates.flaps.fields.angle[:] = SIGNS * openings
        press()
        worst = max(worst, float(np.abs(plates.body.fields.wrench_B - wanted).max()))
    return worst


def analyse(point: Point) -> Analysis:
    """Return trim, linear dynamics, authority, sweeps and the paper's claims of a robot, with their pictures."""
    stable, angles, laws = stability(point), hover_angles(point), scaling(point)
    reached = attainable(point)
    alone, about = single(point), authorities(point)
    units = dict(zip(QUANTITIES, ("rad/s²", "rad/s²", "rad/s²", "weights"), strict=True))
    inputs = [
        (
            f"u{index + 1}: {name}",
            f"{alone[name][0]:.3g} to {alone[name][1]:.3g} {units[name]}",
            f"± {about[name]:.3g} {'m/s²' if name == 'lift' else units[name]}",
        )
        for index, name in enumerate(QUANTITIES)
    ]

    pictures = [
        (
            "shape", "The robot at its hover",
            "Centre of mass: black dot. The paper's Fig. control_concept d, e: V along y (pitch); along x (roll) Λ with "
            "flat flaps, _Λ_ with the kink.",
            lambda: figures.shape(point),
        ),
        (
            "stability", "Kink and centre of mass (Fig. robustness f)",
            "Left: f_αα, black line where it is zero, star: this robot, dot: flat flaps with the centre of mass in their "
            "plane. Middle and right: over the kink at this robot's centre of mass. Dashed: its kink. The inertia is kept.",
            lambda: figures.stability(point, stable),
        ),
        (
            "hover_angle", "Hover angle (Fig. robustness g)",
            "Left: input constants, each by its largest. Right: three readings of authority over all axes, with the best "
            "angle. Green: the paper's 20 to 25°; dashed: this robot.",
            lambda: figures.hover(point, angles),
        ),
        (
            "attainable", "Attainable set",
            "All combinations of openings inside the flaps' range; orange: lift equal to the weight. Cross: hover.",
            lambda: figures.reach(point, reached),
        ),
        (
            "scaling", "Size and mass (eqs. airflow_proportionality, Reynold_numbers)",
            "Similar robots at the same hover angle; the legend has the fitted exponent.",
            lambda: figures.scale(laws),
        ),
    ]  # fmt: skip
    found = claims(point, stable, angles, laws, model_error(point))
    return Analysis(point, robot_lines(point), inputs, found, pictures)


def write(analysis: Analysis, folder: Path) -> Path:
    """Write `design.html`, `design.json` and the pictures; return the page."""
    pictures = [saved(folder, *one) for one in analysis.pictures]
    result = {
        "geometry": analysis.point.geometry.model_dump(),
        "constants": asdict(analysis.point.linear.constants),
        "robot": dict(analysis.robot),
        "claims": [asdict(claim) for claim in analysis.claims],
    }
    write_whole(folder / "design.json", json.dumps(result, indent=1) + "\n")
    return write_page(folder / "design.html", "design.html.j2", analysis=analysis, pictures=pictures)
