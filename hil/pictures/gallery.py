"""The experiments' own pictures, by the names that experiments use."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from hil.errors import LabError, blame
from hil.laboratory.experiment import Experiment
from hil.laboratory.metrics import free_flight
from hil.pictures import trials
from hil.pictures.picture import Picture, painted
from hil.pictures.power import COMPARISON, DISCHARGE

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure

GALLERY: dict[str, Picture] = {
    "yaw-step": trials.YAW_STEP,
    "yaw-sine": trials.YAW_SINE,
    "height-sine": trials.HEIGHT_SINE,
    "y-square": trials.Y_SQUARE,
    "side-wind": trials.SIDE_WIND,
    "disturbances": trials.DISTURBED,
    "airspeed": trials.AIRSPEED,
    "overload": trials.OVERLOAD,
    "take-off": trials.TAKE_OFF_LANDING,
    "specific-power": COMPARISON,
    "discharge": DISCHARGE,
}


def pictures_of(experiment: Experiment) -> tuple[Picture, ...]:
    """Return an experiment's own pictures. Raises `LabError` for an unknown name."""
    if unknown := [name for name in experiment.pictures if name not in GALLERY]:
        raise LabError(
            f"experiment {experiment.name}: picture {unknown[0]!r}: there are {', '.join(GALLERY)}"
        )
    shared = tuple(GALLERY[name] for name in experiment.pictures)
    if experiment.draw is None:
        return shared
    title = experiment.name.replace("-", " ").capitalize()
    return (*shared, Picture(title, experiment.summary, partial(painted, partial(_draw, experiment))))


def _draw(experiment: Experiment, log: pa.Table) -> Figure:
    """Call an experiment's own `draw`. Raises `LabError` for its errors."""
    assert experiment.draw is not None
    try:
        figure: Figure = experiment.draw(free_flight(log))
    except Exception as error:
        raise LabError(f"experiment {experiment.name}: draw: {blame(error)}") from error
    if not hasattr(figure, "savefig"):
        raise LabError(
            f"experiment {experiment.name}: draw returned {figure!r}: expected a matplotlib Figure"
        )
    return figure
