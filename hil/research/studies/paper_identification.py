"""The paper's identification of roll: its printed numbers, its arithmetic, and its method and others with known truth.

Methods, eq. (roll_dynamics_input_const): c* of two flights with gains on roll of 0.2 and 0.15 gives a and c. The same two
flights are flown here, and one with an excitation of u1 for the methods that need it: four minutes of flight.

Agility against size, also from flights: the paper's robot, half and twice as long, each in its own updraft. The masses
grow with the cube of the length, so that the updraft grows with its root (eq. airflow_proportionality). All three fly
excitations of u3 and u1, and `floaty identify` estimates the acceleration per input from telemetry alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from hil.config import DEFAULT_PROFILE, load_config
from hil.errors import LabError
from hil.laboratory.request import Options
from hil.research.campaigns.jobs import Row
from hil.research.campaigns.run import Runner
from hil.research.design.axes import ROLL
from hil.research.design.claims import AGREES, DIFFERS, SCALING, Claim
from hil.research.identify.identify import Identification, identify, interval_text
from hil.research.identify.record import load_record
from hil.research.identify.two_controllers import SIGMAS, closed_loop, input_constant

FLIGHTS = ("two-controllers-1", "two-controllers-2", "identify-u1")
STARRED = (-60.0, -48.5)  # [1/s2] paper, Methods: c* of the two controllers
OWN = (-0.2, -0.15)  # their c
PRINTED = {"roll_u1": "230 ± 66", "roll_roll": "-16 ± 10", "roll_rate": "-40 ± 12"}
TITLES = {
    "roll_u1": "a, roll per u1 [1/s²]",
    "roll_roll": "c, roll per roll [1/s²]",
    "roll_rate": "b, roll per rate [1/s]",
}
WHY = (
    "The paper's c* give a = 230 and c = -14, not -16. Its equations find neither here: the angular acceleration in them is "
    "the derivative of the same spectrum: jωȦ = -ω²A for any robot. So c* is a mean of -ω², and b* is near 0."
)

SIZES = ("design-half", "design-paper", "design-double")
SCALED = {"yaw_u3": "identify-u3", "roll_u1": "identify-u1"}
# [rad] rms, half of what the default robot withstands; the smallest one drifts by 20 cm with it.
AMPLITUDES = {"identify-u3": 0.03, "identify-u1": 0.025}
DURATION_S = 113.0  # five realisations
EXPONENT, NEAR = -1.0, 0.15  # exponent over the length, and the deviation that "goes with" allows
AGAINST = "At the same hover angle; with servos that are as slow at every size."

COLUMNS = ("constant", "paper", "its arithmetic", "truth", "its method here", "instruments", "joint fit")


@dataclass(frozen=True, slots=True)
class PaperConstant:
    """One row: the estimates by method, as text; empty for none."""

    title: str
    paper: str
    arithmetic: str
    truth: str
    paper_method: str
    instruments: str
    joint: str


def fly_identification(out: Path, runner: Runner) -> tuple[PaperConstant, ...]:
    """Fly and identify; empty after Ctrl-C."""
    rows = runner.log("identification", {name: (name, Options(seed=1)) for name in FLIGHTS}, out)
    return constants(identified(rows)) if rows else ()


def identified(rows: Sequence[Row]) -> Identification:
    """Return the identification from flights of one robot. Raises `LabError` for a lost one."""
    for row in rows:
        if row.outcome != "completed":
            raise LabError(f"{row.folder}: {row.error}")
    return identify(
        [load_record(row.folder, row.job.options.get("profile", DEFAULT_PROFILE)) for row in rows]
    )


def constants(found: Identification) -> tuple[PaperConstant, ...]:
    """Return the rows of an identification with the paper's two flights and an excitation of u1."""
    a, c = input_constant(STARRED, OWN)
    computed = {"roll_u1": f"{a:.0f}", "roll_roll": f"{c:.0f}", "roll_rate": ""}
    rows = [
        PaperConstant(
            TITLES[name], PRINTED[name], computed[name], f"{one.truth:.4g}", interval_text(*one.two_controllers, digits=3),
            interval_text(*one.instrumental, digits=3), interval_text(*one.joint, digits=3),
        )
        for name in TITLES
        for one in [found.constant(name)]
    ]  # fmt: skip
    value = {name: found.constant(name) for name in ("roll_u1", "roll_roll")}
    for number, (starred, own, record) in enumerate(zip(STARRED, OWN, found.free, strict=True), 1):
        loop = closed_loop(record, ROLL)
        rows.append(
            PaperConstant(
                f"c*{number}, roll per roll with a gain of {-own:g} [1/s²]", f"{starred:g}", "",
                f"{value['roll_roll'].truth + own * value['roll_u1'].truth:.4g}",
                interval_text(float(loop.starred[1]), SIGMAS * float(loop.errors[1]), 3), "", "",
            )
        )  # fmt: skip
    return tuple(rows)


def fly_scaling(out: Path, runner: Runner) -> list[Claim]:
    """Fly and identify; empty after Ctrl-C. Raises `LabError` for a lost or unidentified robot."""
    flights = {}
    for profile, name in product(SIZES, SCALED.values()):
        excited = (f"excitation.{name[-2:]}={AMPLITUDES[name]}",)
        options = Options(profile=profile, overrides=excited, seed=1, duration_s=DURATION_S)
        flights[f"{profile}-{name}"] = (name, options)
    rows = runner.log("scaling", flights, out)
    if not rows:
        return []
    of_each = len(SCALED)
    found = {
        profile: identified(rows[of_each * number : of_each * (number + 1)])
        for number, profile in enumerate(SIZES)
    }
    length = np.array([load_config(profile).geometry.footprint for profile in SIZES])
    claims = []
    for constant in SCALED:
        values, halves = np.array([found[profile].constant(constant).joint for profile in SIZES]).T
        (exponent, _), covariance = np.polyfit(
            np.log(length), np.log(values), 1, w=values / halves, cov="unscaled"
        )
        listed = ", ".join(f"{value:.0f} ± {half:.0f}" for value, half in zip(values, halves, strict=True))
        claims.append(
            Claim(
                f"{constant.split('_')[0]} acceleration per input over l, flown and identified", SCALING,
                f"exponent {EXPONENT:g}", f"{exponent:.2f} ± {np.sqrt(covariance[0, 0]):.2f} ({listed} 1/s²)",
                AGREES if abs(exponent - EXPONENT) < NEAR else DIFFERS, AGAINST,
            )
        )  # fmt: skip
    return claims
