"""The paper's identification of roll: its printed numbers, its arithmetic, and its method and others with known truth.

Methods, eq. (roll_dynamics_input_const): c* of two flights with gains on roll of 0.2 and 0.15 gives a and c. The same two
flights are flown here, and one with an excitation of u1 for the methods that need it: four minutes of flight.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hil.campaigns.jobs import Row
from hil.campaigns.run import Runner
from hil.config import DEFAULT_PROFILE
from hil.design.axes import ROLL
from hil.errors import LabError
from hil.identify.identify import Identification, identify, interval_text
from hil.identify.record import load_record
from hil.identify.two_controllers import SIGMAS, closed_loop, input_constant
from hil.laboratory.request import Options

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
