"""The experiments' own pictures, by the names that experiments use."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pyarrow as pa

from hil.errors import LabError, blame
from hil.laboratory.experiment import Experiment
from hil.laboratory.metrics import free_flight
from hil.pictures import trials
from hil.pictures.panels import Picture, Still


def painted(draw: Callable[..., Any], *flights: pa.Table) -> Still:
    """Return the figure that `draw` makes of flights with matplotlib, which is slow to load."""
    from hil.pictures.drawing import png

    return Still(png(draw, *flights), "png")


def chart(name: str, *flights: pa.Table) -> Still:
    """Return a picture of `hil.pictures.charts`."""
    from hil.pictures import charts

    return painted(getattr(charts, name), *flights)


GALLERY: dict[str, Picture] = {
    "yaw-step": Picture(
        "Step in yaw",
        "Yaw and its target, as in the paper's figure of tracking, a; and the loss of height.",
        partial(trials.follow, (trials.YAW, trials.Z), (0.5, 4.0)),
    ),
    "yaw-sine": Picture(
        "Sine in yaw",
        "Yaw and its target, as in the paper's figure of tracking, b.",
        partial(trials.follow, (trials.YAW,), (0.0, 60.0)),
    ),
    "height-sine": Picture(
        "Sine in height",
        "Height and its target, W, as in the paper's figure of tracking, c.",
        partial(trials.follow, (trials.Z,), (0.0, 60.0)),
    ),
    "y-square": Picture(
        "Square in y",
        "y and its target, W, as in the paper's figure of tracking, d.",
        partial(trials.follow, (trials.Y,), (0.0, 60.0)),
    ),
    "side-wind": Picture(
        "Side wind",
        "Position, W, while a fan beside the tunnel blows (red, darker with every step of its speed), as in the paper's "
        "figure of robustness, e; the loss of height from leaning.",
        partial(trials.follow, (trials.X, trials.Y, trials.Z), (0.0, 60.0)),
    ),
    "disturbances": Picture(
        "Disturbances",
        "Position error with each disturbance (red) and its size. Dashed: the 20 cm box.",
        trials.disturbed,
    ),
    "airspeed": Picture(
        "Airspeed",
        "Height, and the mean opening of the flaps (target: the commanded one), over 0.1 s.",
        partial(trials.follow, (trials.Z, trials.OPENING), (0.0, 60.0)),
        needs="control.flap_1",
    ),
    "take-off": Picture(
        "Take-off and landing",
        "Height over the net, vertical speed and the air at the robot.",
        trials.take_off_and_landing,
        needs="flow.z",
    ),
    "overload": Picture(
        "Overload",
        "Missed deadlines per second and largest position error while a task above all others takes a share of every tick. "
        "Dashed: the 20 cm box. A starved task completes no activation, late or not.",
        partial(chart, "overload"),
        needs="cpu.THIEF",
    ),
    "specific-power": Picture(
        "Specific power",
        "Left: power in hover per mass. Right: power over mass; grey: 100 to 250 W/kg, which the paper calls typical. "
        "Stars: in an updraft. Bars on helicopters: the paper's range of hover power, as a share of the rated one. Red: "
        "this flight.",
        partial(chart, "compare"),
        needs="battery.power",
    ),
    "discharge": Picture(
        "Battery",
        "Voltage of one cell under load, with the supervisor's limit; power, mean over 1 s, and over the flight; charge "
        "left.",
        trials.discharge,
        needs="battery.power",
    ),
}


def pictures_of(experiment: Experiment) -> tuple[Picture, ...]:
    """Return an experiment's own pictures, of a stand-in those that need no code. Raises `LabError` for an unknown name."""
    if not experiment.is_known:
        return tuple(GALLERY[name] for name in experiment.pictures if name in GALLERY)
    if unknown := [name for name in experiment.pictures if name not in GALLERY]:
        raise LabError(
            f"experiment {experiment.name}: picture {unknown[0]!r}: there are {', '.join(GALLERY)}"
        )
    shared = tuple(GALLERY[name] for name in experiment.pictures)
    if experiment.draw is None:
        return shared
    title = experiment.name.replace("-", " ").capitalize()
    return (*shared, Picture(title, experiment.summary, partial(painted, partial(_draw, experiment))))


def _draw(experiment: Experiment, log: pa.Table) -> Any:
    """Call an experiment's own `draw`. Raises `LabError` for its errors."""
    assert experiment.draw is not None
    try:
        figure = experiment.draw(free_flight(log))
    except Exception as error:
        raise LabError(f"experiment {experiment.name}: draw: {blame(error)}") from error
    if not hasattr(figure, "savefig"):
        raise LabError(
            f"experiment {experiment.name}: draw returned {figure!r}: expected a matplotlib Figure"
        )
    return figure
