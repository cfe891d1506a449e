"""The experiments: one small file per subject, with trajectory, faults and limits; `EXPERIMENTS` lists them by name."""

import difflib

from hil.errors import LabError
from hil.experiments.airspeed import AIRSPEEDS
from hil.experiments.hover import HOVER
from hil.experiments.overload import OVERLOAD
from hil.experiments.position import HEIGHT_SINE, Y_SQUARE
from hil.experiments.power import ENDURANCE, POWER
from hil.experiments.pushes import PUSHED
from hil.experiments.take_off import TAKE_OFF_LANDING
from hil.experiments.wind import OCCLUSION, SIDE_WINDS
from hil.experiments.yaw import YAW_SINES, YAW_STEP, YAW_STEP_0
from hil.laboratory.experiment import Experiment

EXPERIMENTS: dict[str, Experiment] = {
    experiment.name: experiment
    for experiment in (
        HOVER,
        YAW_STEP,
        YAW_STEP_0,
        *YAW_SINES,
        HEIGHT_SINE,
        Y_SQUARE,
        PUSHED,
        *SIDE_WINDS,
        OCCLUSION,
        *AIRSPEEDS,
        POWER,
        ENDURANCE,
        TAKE_OFF_LANDING,
        OVERLOAD,
    )
}

__all__ = ["EXPERIMENTS", "Experiment", "find_experiment"]


def find_experiment(name: str) -> Experiment:
    """Return an experiment by name; an unknown one raises `LabError` with the nearest."""
    if name in EXPERIMENTS:
        return EXPERIMENTS[name]
    near = difflib.get_close_matches(name, EXPERIMENTS, 1)
    hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(EXPERIMENTS)}"
    raise LabError(f"experiment {name!r}: unknown; {hint}")
