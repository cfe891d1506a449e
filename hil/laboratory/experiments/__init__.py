"""The experiments: one small file per subject, with trajectory, faults and limits; `EXPERIMENTS` has them by name."""

from pathlib import Path

from hil.errors import LabError, hint
from hil.laboratory.experiment import Experiment, Source
from hil.laboratory.experiments.airspeed import AIRSPEEDS
from hil.laboratory.experiments.disturbances import OCCLUSION, PUSHED, SIDE_WINDS
from hil.laboratory.experiments.identification import IDENTIFICATION
from hil.laboratory.experiments.overload import OVERLOAD
from hil.laboratory.experiments.own import entries, in_file, in_package
from hil.laboratory.experiments.position import EIGHT, FORMATION, HEIGHT_SINE, HOVER, Y_SQUARE
from hil.laboratory.experiments.power import ENDURANCE, POWER
from hil.laboratory.experiments.take_off import TAKE_OFF_LANDING
from hil.laboratory.experiments.trajectories import SUFFIX, in_csv, in_folder
from hil.laboratory.experiments.yaw import YAW_SINES, YAW_STEP, YAW_STEP_0
from hil.laboratory.files.result import Result
from hil.laboratory.request import Find

EXPERIMENTS: dict[str, Experiment] = {
    experiment.name: experiment
    for experiment in (
        HOVER, YAW_STEP, YAW_STEP_0, *YAW_SINES, HEIGHT_SINE, Y_SQUARE, EIGHT, FORMATION, PUSHED, *SIDE_WINDS, OCCLUSION,
        *AIRSPEEDS, POWER, ENDURANCE, TAKE_OFF_LANDING, OVERLOAD, *IDENTIFICATION,
    )
}  # fmt: skip

__all__ = [
    "EXPERIMENTS", "Experiment", "check_flown", "find_again", "find_experiment", "find_experiments", "find_shipped",
    "finder_of",
]  # fmt: skip


def find_experiment(name: str) -> Experiment:
    """Return an experiment: by name, if it ships or is in an installed package, as FILE.py:NAME, or of a trajectory.

    Raises `LabError` for an unknown one, with the nearest name.
    """
    if name in EXPERIMENTS:
        return EXPERIMENTS[name]
    if ".py" in name:
        return in_file(name)
    if name.endswith(SUFFIX):
        return in_csv(Path(name))
    installed = entries()
    if name in installed:
        return in_package(installed[name])
    near = hint(name, [*EXPERIMENTS, *installed])
    raise LabError(f"experiment {name!r}: unknown; {near}; one of your own is FILE.py:NAME")


def find_experiments(name: str, count: int) -> list[Experiment]:
    """Return the experiment of each of several robots: the same, or those of a folder with a trajectory for each."""
    return in_folder(Path(name), count) if Path(name).is_dir() else [find_experiment(name)] * count


def find_shipped(name: str, source: Source | None) -> Experiment | None:
    """Return the experiment of a run if it ships. None for one of a file or package: to read a run executes neither."""
    return EXPERIMENTS.get(name) if source is None else None


def finder_of(experiment: Experiment) -> Find:
    """Return the function that finds an experiment that the user has named, and those that ship."""
    return lambda name, source: experiment if name == experiment.name else find_shipped(name, source)


def check_flown(experiment: Experiment, result: Result) -> None:
    """Raise `LabError` when a run is a flight of another experiment than the one that the user has named."""
    if result.request.experiment is not experiment:
        name = result.request.experiment.name
        raise LabError(f"experiment {experiment.name}: {result.folder} is a flight of {name}")


def find_again(name: str, source: Source | None) -> Experiment | None:
    """Return the experiment of a flight for another flight, which executes its file; None when unknown or changed."""
    if source is None:
        return EXPERIMENTS.get(name)
    try:
        found = find_experiment(source.reference)
    except LabError:
        return None
    return found if found.source == source else None
