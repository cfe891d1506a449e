"""The paper's test of its drag model: forces and torques on the robot mounted in the tunnel, over the flaps' angles.

The model is the paper's simplified one ("Force analysis"): base and flaps as isolated flat plates in a uniform flow, pushed
along their normals. A force sensor measures the plant, clamped level at the hover point of the tunnel, with its profile
and its gusts, for 10 s at each angle: means and standard deviations. The plant's plates are isolated too, so the paper's
effect at extreme angles, flaps in each other's wake, does not occur here.

Torques are about the centre of mass. Two sweeps as in the paper's figure drag_model_evaluation: (a) flaps 2 and 3 turned by
the same angle in opposite directions, (b) flaps 1 and 3 in the same direction.
"""

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.config import LabConfig
from hil.laboratory.robot import Streams
from hil.pictures import curves
from hil.pictures.drawing import WIDTH
from hil.pictures.pages import saved, write_page
from hil.research.design.authority import pressure_at, wrenches
from hil.world.body import ACTUATORS
from hil.world.fixed_order import normal
from hil.world.floaty.plant import Plant
from hil.world.floaty.shape import SIGNS
from hil.world.structs import STEP_US

Wrench = NDArray[np.float64]  # (6,): force [N] and torque [N m] in B

ANGLES_DEG = tuple(range(-60, 65, 5))
SECONDS = 10  # per angle; paper
SAMPLES = 1_000_000 // STEP_US * SECONDS  # paper: 35000; here on the grid of the truth
# [N, N m] resolution of an ATI mini40; assumed white.
SENSOR_NOISE = (0.01, 0.01, 0.02, 0.00025, 0.00025, 0.00025)
QUANTITIES = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")
LABELS = ("$F_x$ [N]", "$F_y$ [N]", "$F_z$ [N]", "$T_x$ [N m]", "$T_y$ [N m]", "$T_z$ [N m]")
OPERATIONAL_DEG = 50  # flap angles of flight, in the steps of the test


@dataclass(frozen=True, slots=True)
class Sweep:
    """One sequence of flap angles: the signs of the turned flaps, by index; the others stay at the hover angle."""

    name: str
    title: str
    signs: Mapping[int, float]

    def turn_flaps(self, flaps: NDArray[np.float64], angle: float) -> None:
        """Set the turned ones of the angles (4,) [rad]."""
        for flap, sign in self.signs.items():
            flaps[flap] = sign * angle


SWEEPS = (
    Sweep("adjacent", "(a) flaps 2 and 3, opposite directions", {1: -1.0, 2: 1.0}),
    Sweep("opposite", "(b) flaps 1 and 3, same direction", {0: 1.0, 2: 1.0}),
)
ROBOTS = {"flat": "flat flaps, as in the paper's test", "kinked": "kinked flaps, as flown"}
ROWS = len(ROBOTS) * len(SWEEPS) * len(ANGLES_DEG)


@dataclass(frozen=True, slots=True)
class MountedRow:
    """Model and measurement at one angle."""

    robot: str  # flat or kinked flaps
    sweep: str
    angle_deg: int
    model: Wrench
    mean: Wrench
    deviation: Wrench


def measure(config: LabConfig, seed: int) -> Iterator[MountedRow]:
    """Yield the ROWS rows, robot by robot and sweep by sweep."""
    streams = Streams.of_seed(seed)
    body = config.plant.model_copy(update={"variant": "plate", "constant_factors": {}})
    for robot, kink in zip(ROBOTS, (0.0, config.geometry.kink_angle), strict=True):
        geometry = config.geometry.model_copy(update={"kink_angle": kink})
        pressure = pressure_at(geometry, body.hover_angle)
        plant = Plant(geometry, body, config.tunnel, config.actuators, streams.gusts)
        plant.hold()
        for servo in ACTUATORS:
            plant.settings[f"servo.pace.{servo}"].write(0.0)  # the flaps stay at the set angles
        for index, (sweep, angle_deg) in enumerate(product(SWEEPS, ANGLES_DEG)):
            flaps = SIGNS * body.hover_angle
            sweep.turn_flaps(flaps, math.radians(angle_deg))
            noise = normal(streams.imu, (SAMPLES, 6)) * SENSOR_NOISE
            samples = _measure(plant, flaps, index * SAMPLES * STEP_US) + noise
            mean, deviation = samples.mean(axis=0), samples.std(axis=0)
            (model,) = wrenches(geometry, (SIGNS * flaps)[None], pressure)
            yield MountedRow(robot, sweep.name, angle_deg, model, mean, deviation)


def _measure(plant: Plant, flaps: NDArray[np.float64], start_us: int) -> NDArray[np.float64]:
    """Return force and torque of the flow on the clamped robot, (SAMPLES, 6), every millisecond after `start_us`."""
    plant.place(plant.p_WB.tolist(), plant.q_WB.tolist(), flaps=flaps.tolist())
    samples = np.empty((SAMPLES, 6))
    for index in range(SAMPLES):
        plant.advance(start_us + (index + 1) * STEP_US)
        samples[index] = plant.wrench_B
    return samples


def write_csv(rows: Sequence[MountedRow], path: Path) -> None:
    """Write one line per angle: model, mean and standard deviation of each force [N] and torque [N m]."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        kinds = ("model", "mean", "deviation")
        writer.writerow(
            ["robot", "sweep", "angle_deg", *(f"{q}_{kind}" for q in QUANTITIES for kind in kinds)]
        )
        for row in rows:
            values = np.stack([row.model, row.mean, row.deviation], axis=1).ravel()
            writer.writerow([row.robot, row.sweep, row.angle_deg, *(f"{value:.6g}" for value in values)])


def _draw(rows: Sequence[MountedRow], hover_deg: float) -> Figure:
    """Draw the rows of one robot and one sweep: forces above, torques below."""
    figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
    angles = [row.angle_deg for row in rows]
    model, mean, deviation = (
        np.array([getattr(row, name) for row in rows]) for name in ("model", "mean", "deviation")
    )
    for index, axes in enumerate(figure.subplots(2, 3, sharex=True).flat):
        low, high = mean[:, index] - deviation[:, index], mean[:, index] + deviation[:, index]
        axes.fill_between(angles, low, high, color=curves.BLUE, alpha=0.2, linewidth=0)
        axes.plot(angles, mean[:, index], "+", color=curves.BLUE, label="measured")
        axes.plot(angles, model[:, index], ".", color="red", markersize=4, label="model")
        axes.axvline(hover_deg, color="black", linestyle="--", linewidth=0.7)
        axes.set_ylabel(LABELS[index])
        if index > 2:
            axes.set_xlabel("flap angle [deg]")
    figure.axes[0].legend()
    return figure


def write(rows: Sequence[MountedRow], hover_deg: float, folder: Path) -> Path:
    """Write the table, a PNG per robot and sweep and the page that holds them; return the page."""
    write_csv(rows, folder / "drag_model.csv")
    figures, worst = [], []
    for (robot, robot_text), sweep in product(ROBOTS.items(), SWEEPS):
        chosen = [row for row in rows if (row.robot, row.sweep) == (robot, sweep.name)]
        misses = np.abs([row.model - row.mean for row in chosen])
        worst.append((f"{sweep.title}; {robot_text}", [f"{value:.4f}" for value in misses.max(axis=0)]))
        flown = misses[[0 <= row.angle_deg <= OPERATIONAL_DEG for row in chosen]].max(axis=0)
        caption = (
            f"{sweep.title}. From 0 to {OPERATIONAL_DEG} degrees model and measurement differ by at most "
            f"{flown[:3].max():.2f} N and {flown[3:].max():.3f} N m."
        )
        name, title = f"drag_model_{robot}_{sweep.name}", f"Drag model, {robot_text}"
        figures.append(saved(folder, name, title, caption, partial(_draw, chosen, hover_deg)))
    page = folder / "drag_model.html"
    return write_page(page, "drag_model.html.j2", figures=figures, worst=worst, quantities=QUANTITIES)
