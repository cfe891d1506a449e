"""Identification: flights whose logs `floaty identify` uses to estimate constants.

The excitation is a parameter of the board; the operator switches it on over the link once the robot hovers. Settings
select its strength and band, like `--set excitation.u1=0.08 --set excitation.high=6`. The amplitudes here keep the
default robot inside its 20 cm box. The paper's method needs two flights with different gains and without excitation; the
gains on roll are those of its Methods, -0.2 and -0.15.
"""

from collections.abc import Mapping
from functools import partial

from firmware_py.config import SIGNALS
from firmware_py.wire.parameters import SetByName, encode_set_by_name
from firmware_py.wire.scalars import Scalar
from hil.laboratory.experiment import Experiment
from hil.laboratory.flight import Flight

BEGIN_US = 2_000_000  # the robot is at rest after its release
REALISATIONS = 6  # of 22 s: 2 s to settle, and a period
DURATION_S = 2.0 + 22.0 * REALISATIONS + 1.0
LIMITS = {"lost": 0.0}
ALONE = {"u1": 0.05, "u2": 0.08, "u3": 0.06, "u4": 0.10}  # [rad] rms; larger ones are not linear
TOGETHER = {"u1": 0.04, "u2": 0.06, "u3": 0.05, "u4": 0.08}


def excite(flight: Flight) -> None:
    """Plan the operator's command that switches the excitation on."""
    flight.events.at(flight.release_us + BEGIN_US, partial(_switch_on, flight))


def _switch_on(flight: Flight, now_us: int) -> None:
    signal = flight.config.excitation.signal
    request = SetByName("excite.signal", Scalar.U8, SIGNALS.index(signal))
    flight.line.command(now_us, encode_set_by_name(request))
    flight.note("lab", f"excitation on: {signal}")


def excited(name: str, summary: str, amplitudes: Mapping[str, float], *settings: str) -> Experiment:
    """Return a hover with an excitation of some inputs."""
    return Experiment(
        name=name,
        summary=summary,
        duration_s=DURATION_S,
        limits=LIMITS,
        settings=(*(f"excitation.{one}={rms}" for one, rms in amplitudes.items()), *settings),
        script=excite,
    )


def preliminary(number: int, gain_roll: float, gain_pitch: float) -> Experiment:
    """Return the paper's flight with one of its two preliminary controllers."""
    return Experiment(
        name=f"two-controllers-{number}",
        summary=f"hover with attitude gains {gain_roll:g} and {gain_pitch:g}, disturbed only by the flow (paper's Methods)",
        duration_s=42.0,
        limits=LIMITS,
        settings=(f"controller.gain_roll={gain_roll}", f"controller.gain_pitch={gain_pitch}"),
    )


IDENTIFICATION = (
    excited("identify", "multisines on u1 to u4 at once, without a common line: for all constants", TOGETHER),
    *(excited(f"identify-{one}", f"a multisine on {one} alone", {one: rms}) for one, rms in ALONE.items()),
    excited(
        "identify-chirp", "a chirp on u1; another one: --set excitation.u1=0 --set excitation.u3=0.1", {"u1": 0.08},
        "excitation.signal=chirp",
    ),
    preliminary(1, 0.2, 0.15),
    preliminary(2, 0.15, 0.1),
)  # fmt: skip
