"""The experiments' own pictures by the names under which experiments ask for them."""

from __future__ import annotations

from hil.experiments import EXPERIMENTS
from hil.pictures import trials
from hil.pictures.overload import OVERLOAD
from hil.pictures.picture import Picture
from hil.pictures.power import COMPARISON, DISCHARGE
from hil.pictures.take_off import TAKE_OFF_LANDING

GALLERY: dict[str, Picture] = {
    "yaw-step": trials.YAW_STEP,
    "yaw-sine": trials.YAW_SINE,
    "height-sine": trials.HEIGHT_SINE,
    "y-square": trials.Y_SQUARE,
    "side-wind": trials.SIDE_WIND,
    "disturbances": trials.DISTURBED,
    "airspeed": trials.AIRSPEED,
    "overload": OVERLOAD,
    "take-off": TAKE_OFF_LANDING,
    "specific-power": COMPARISON,
    "discharge": DISCHARGE,
}


def pictures_of(experiment: str) -> tuple[Picture, ...]:
    """Return the pictures of an experiment's own, none for one that is not known here."""
    known = EXPERIMENTS.get(experiment)
    return tuple(GALLERY[name] for name in known.pictures) if known else ()
