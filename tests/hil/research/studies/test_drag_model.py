"""The drag model: the paper's equations by other means, the plant's plates, and what is measured in the tunnel."""

import csv
import math
import re
from itertools import islice, product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hil.config import load_config
from hil.research.design.authority import pressure_at, wrenches
from hil.research.studies import drag_model
from hil.research.studies.drag_model import SWEEPS, MountedRow, measure
from hil.world.config import GeometryConfig, PlantConfig, PlantServoConfig, TunnelConfig
from hil.world.floaty.plant import Plant
from support.command import Cli

AZIMUTHS = np.radians((-45.0, 45.0, 135.0, -135.0))  # of the flap axes, outwards
AXES = np.array([0.0, 0.0, 0.07])  # above the centre of mass
RHO, AIRSPEED, WEIGHT = 1.225, 10.0, 0.34 * 9.81
FLAPS = st.lists(st.floats(-1.2, 1.2), min_size=4, max_size=4).map(np.array)


def robot(kink: float) -> tuple[GeometryConfig, PlantConfig]:
    return GeometryConfig(kink_angle=kink), PlantConfig(variant="plate")


def by_the_paper(flaps: NDArray[np.float64], kink: float, drag_coefficient: float) -> NDArray[np.float64]:
    """Force and torque by eq. flaps_drag_force and drag_torque_equation, geometry by docs/explanation/plant.md."""
    plates = [(0.0064, np.array([0.0, 0.0, 1.0]), AXES)]
    fold = 0.115 - 0.0198
    for azimuth, flap in zip(AZIMUTHS, flaps, strict=True):
        quadrant = np.sign([math.cos(azimuth), math.sin(azimuth)])
        axis = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        turned = Rotation.from_rotvec(axis * flap)
        # the strip is folded up along a line parallel to x: about +x on the left, about -x on the right
        folded = Rotation.from_rotvec([kink * quadrant[1], 0.0, 0.0])
        strip = np.array([quadrant[0] * 0.0575, quadrant[1] * fold, 0.0]) + folded.apply(
            [0.0, quadrant[1] * 0.0099, 0.0]
        )
        # centroid of the flat part: the quadrant less the base's corner and the strip
        areas = np.array([0.115**2, -(0.04**2), -0.0198 * 0.115])
        xs, ys = np.array([0.0575, 0.02, 0.0575]), np.array([0.0575, 0.02, 0.115 - 0.0099])
        flat = np.array([quadrant[0] * areas @ xs, quadrant[1] * areas @ ys, 0.0]) / areas.sum()
        up = np.array([0.0, 0.0, 1.0])
        for area, normal, centre in ((areas.sum(), up, flat), (-areas[2], folded.apply(up), strip)):
            plates.append((area, turned.apply(normal), turned.apply(centre) + AXES))
    total = np.zeros(6)
    for area, normal, centre in plates:
        across = np.array([0.0, 0.0, AIRSPEED]) @ normal
        force = 0.5 * RHO * drag_coefficient * area * across * abs(across) * normal
        total += np.concatenate([force, np.cross(centre, force)])
    return total


@pytest.mark.long
@pytest.mark.parametrize("kink", [0.0, math.radians(42.5)])
@settings(max_examples=40, deadline=None)
@given(flaps=FLAPS)
def test_model_and_plant_are_the_papers_equations(kink: float, flaps: NDArray[np.float64]) -> None:
    hover = np.radians((25.0, -25.0, 25.0, -25.0))
    drag_coefficient = WEIGHT / by_the_paper(hover, kink, 1.0)[2]
    expected = by_the_paper(flaps, kink, drag_coefficient)
    geometry, body = robot(kink)
    found = wrenches(
        geometry, np.array([1, -1, 1, -1]) * flaps[None], pressure_at(geometry, body.hover_angle)
    )
    assert np.allclose(found[0], expected, rtol=1e-9, atol=1e-9)
    plant = Plant(*robot(kink), TunnelConfig(), PlantServoConfig(), np.random.default_rng(1))
    assert np.allclose(np.concatenate(plant.mounted_wrench(flaps)), expected, rtol=1e-9, atol=1e-9)


def test_drag_coefficient_of_the_kinked_robot_is_that_of_the_specification() -> None:
    hover = np.radians((25.0, -25.0, 25.0, -25.0))
    assert WEIGHT / by_the_paper(hover, math.radians(42.5), 1.0)[2] == pytest.approx(1.353, rel=1e-3)


@pytest.mark.long
def test_samples_follow_each_other_every_millisecond_after_the_start() -> None:
    class Clamped:
        p_WB, q_WB = np.zeros(3), np.zeros(4)

        def place(self, *pose: object, flaps: list[float]) -> None:
            self.flaps = flaps

        def advance(self, now_us: int) -> None:
            self.wrench_B = np.full(6, float(now_us))

    plant = Clamped()
    samples = drag_model._measure(plant, np.array([1.0, 2.0]), 7_000)  # type: ignore[arg-type]
    assert plant.flaps == [1.0, 2.0]
    assert samples.tolist() == [[7_000.0 + 1000.0 * (1 + n)] * 6 for n in range(len(samples))]


def test_measurements_scatter_with_the_gusts_around_the_model() -> None:
    for row in islice(measure(load_config(), 1), 3):
        assert row.robot == "flat"
        # 10 s of gusts whose slowest part lasts 0.4 s: a mean is good to a fifth of the scatter
        assert (np.abs(row.mean - row.model) < 0.3 * row.deviation + 0.002).all()
        assert 0.05 < row.deviation[2] < 0.4
    still = load_config(overrides=["tunnel.turbulence=none"])
    (row,) = islice(measure(still, 1), 1)
    assert row.deviation == pytest.approx([0.01, 0.01, 0.02, 0.00025, 0.00025, 0.00025], rel=0.05)


def test_the_sweeps_are_the_papers() -> None:
    for sweep, expected in zip(SWEEPS, ((0.4, -0.1, 0.1, -0.4), (0.1, -0.4, 0.1, -0.4)), strict=True):
        flaps = np.array((0.4, -0.4, 0.4, -0.4))
        sweep.turn_flaps(flaps, 0.1)
        assert flaps.tolist() == list(expected)


SIZES = (0.02, 0.01, 0.03, 0.005, 0.001, 0.004)  # [N, N m]


def test_the_page_has_a_picture_and_the_largest_misses_of_each_robot_and_sweep(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Misses grow from sweep to sweep; in flight forces miss most at 0 deg, torques at 50; beyond, ten times more."""
    monkeypatch.setattr("hil.pictures.drawing.png", lambda draw: b"drawn")
    misses = {0: (1, 1, 1, 0.5, 0.5, 0.5), 50: (-0.5, -0.5, -0.5, -1, -1, -1), -1: (10,) * 6, 51: (-10,) * 6}
    rows = [
        MountedRow(robot, sweep.name, angle, np.zeros(6), number * np.multiply(SIZES, share), np.ones(6))
        for number, (robot, sweep) in enumerate(product(("flat", "kinked"), SWEEPS), 1)
        for angle, share in misses.items()
    ]
    monkeypatch.setattr(drag_model, "measure", lambda config, seed: iter(rows))
    assert cli("drag-model", "--out", tmp_path) == 0
    page = (tmp_path / "drag_model.html").read_text(encoding="utf-8")
    largest = [f"{10 * n * miss:.4f}" for n in (1, 2, 3, 4) for miss in SIZES]
    assert re.findall(r"<td>([\d.]+)</td>", page) == largest
    captions = re.findall(r"differ by at most (\S+) N and (\S+) N m", page)
    assert captions == [(f"{0.03 * n:.2f}", f"{0.005 * n:.3f}") for n in (1, 2, 3, 4)]
    header, *lines = csv.reader((tmp_path / "drag_model.csv").read_text().splitlines())
    assert header[:6] == ["robot", "sweep", "angle_deg", "force_x_model", "force_x_mean", "force_x_deviation"]
    assert lines[0][:9] == ["flat", SWEEPS[0].name, "0", "0", "0.02", "1", "0", "0.01", "1"]
    assert (len(lines), {len(line) for line in lines}) == (16, {len(header)})
    names = {f"drag_model_{robot}_{sweep.name}.png" for robot, sweep in product(("flat", "kinked"), SWEEPS)}
    assert {path.name for path in tmp_path.iterdir()} == {"drag_model.csv", "drag_model.html", *names}
