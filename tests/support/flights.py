"""Flights that tests ask for in a line."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import hypot
from pathlib import Path
from typing import Unpack

import numpy as np
import pytest
from numpy.typing import NDArray

from hil.api import Run, column
from hil.config import load_config
from hil.emulator.crazyflie.log_table import ImageVariable
from hil.laboratory.experiments import EXPERIMENTS, Experiment, find_experiment
from hil.laboratory.files.result import Result
from hil.laboratory.lockstep import image_at
from hil.laboratory.request import Options, Request
from hil.laboratory.run import fly
from hil.servers.built_in_station import fly_built_in
from hil.servers.server import Server, Service

FAMILIES = ("yaw-", "height-sine", "y-square", "pushes", "side-wind-", "occlusion", "airspeed-")
PAPER = [name for name in EXPERIMENTS if name.startswith(FAMILIES)]


def flown(folder: Path, experiment: str | Experiment, *overrides: str, **options: Unpack[Options]) -> Result:
    """Fly an experiment with overrides of its profile."""
    chosen = find_experiment(experiment) if isinstance(experiment, str) else experiment
    return fly(Request.of(chosen, overrides=overrides, **options), folder)


def hover(folder: Path, *overrides: str, **options: Unpack[Options]) -> Result:
    return flown(folder, "hover", *overrides, **options)


def explain(result: Result) -> str:
    return f"{result.outcome} {result.cause}: {[str(v) for v in result.verdicts if not v.holds]}, {result.folder}"


@contextmanager
def served_image(elf: str, profile: str) -> Iterator[Server]:
    """Serve an image in lockstep with poses of the cameras; it has run for a second."""
    server = Server(Service(load_config(profile), executor=image_at(elf, None)), lambda text: None)
    try:
        fly_built_in(server.robot, absolute=True)
        server.lab.end_at(1_000_000)
        server.lab.run()
        yield server
    finally:
        server.close()


def check_calibrated(table: Mapping[str, ImageVariable]) -> None:
    """Check that the stock firmware of a robot at rest takes what its accelerometer measures for 1 g."""
    assert hypot(*(table[f"acc.{axis}"].read() for axis in "xyz")) == pytest.approx(1.0, abs=0.003)


def check_hover(run: Run, motor_V: float) -> NDArray[np.bool_]:
    """Check a Crazyflie's hover from floor to floor and its motors' mean voltage [V]; return the rows at rest in the air."""
    assert run.result.outcome == "completed"
    held = [verdict for verdict in run.result.verdicts if verdict.metric in ("max_x", "max_y")]
    assert all(verdict.holds for verdict in held), held
    log = run.log
    assert column(log, "truth.z").max() > 0.9
    assert column(log, "truth.z")[-1] < 0.02
    in_air = (column(log, "truth.z") > 0.9) & (abs(column(log, "truth.vz")) < 0.02)
    share = column(log, "motor.m1", "motor.m2", "motor.m3", "motor.m4")[in_air].mean() / 65535
    assert share * column(log, "battery.voltage")[in_air].mean() == pytest.approx(motor_V, rel=0.03)
    return in_air
