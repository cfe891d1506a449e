"""The experiments: one small file each, with its trajectory and its limits; `EXPERIMENTS` lists them by name."""

import difflib

from hil.errors import LabError
from hil.experiments.experiment import Experiment
from hil.experiments.hover import HOVER
from hil.experiments.overload import OVERLOAD
from hil.experiments.power import ENDURANCE, POWER
from hil.experiments.take_off import TAKE_OFF_LANDING

EXPERIMENTS: dict[str, Experiment] = {
    experiment.name: experiment for experiment in (HOVER, OVERLOAD, POWER, ENDURANCE, TAKE_OFF_LANDING)
}

__all__ = ["EXPERIMENTS", "Experiment", "find_experiment"]


def find_experiment(name: str) -> Experiment:
    """Return an experiment by name; an unknown one raises `LabError` with the nearest."""
    if name in EXPERIMENTS:
        return EXPERIMENTS[name]
    near = difflib.get_close_matches(name, EXPERIMENTS, 1)
    hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(EXPERIMENTS)}"
    raise LabError(f"experiment {name!r}: unknown; {hint}")
