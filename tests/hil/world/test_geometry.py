"""Laws of the geometry: G0 is the specification's, masses by other means, mirror symmetry, and what cannot be is refused."""

import math
from collections.abc import Mapping

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil.config import load_config
from hil.errors import LabError
from hil.world.config import GeometryConfig, PlantConfig, PlantServoConfig, TunnelConfig
from hil.world.floaty.geometry import area_and_centre, surfaces, weigh
from hil.world.floaty.plant import Plant
from hil.world.floaty.shape import flap_plates
from support.geometries import geometries

MIRRORS = {"x": np.diag([-1.0, 1.0, 1.0]), "y": np.diag([1.0, -1.0, 1.0])}
PARTNERS = {"x": (3, 2, 1, 0), "y": (1, 0, 3, 2)}  # the flap that a mirror puts in each flap's place
CALM = TunnelConfig(turbulence="none", profile_radius=5.0, height_slope=0.0)


def plant_of(geometry: GeometryConfig) -> Plant:
    return Plant(geometry, PlantConfig(variant="plate"), CALM, PlantServoConfig(), np.random.default_rng(1))


def test_g0_weighs_what_the_specification_prints() -> None:
    g0 = weigh(GeometryConfig())
    assert (g0.mass, g0.axis_height, g0.inertia) == (0.340, 0.07, (1.30e-3, 1.30e-3, 1.47e-3))
    budget = weigh(GeometryConfig(inertia="masses"))  # docs/explanation/plant.md: the budget of masses
    assert budget.inertia == pytest.approx((1.40e-3, 1.40e-3, 1.15e-3), rel=0.006)


def test_g0_s_plates_are_those_of_the_specification() -> None:
    flat, strip = flap_plates(GeometryConfig())
    assert (flat.area, strip.area) == pytest.approx((0.00935, 0.00228), abs=5e-6)
    assert flat.centre == pytest.approx([0.0639, 0.0523, 0.0], abs=5e-5)
    assert strip.centre == pytest.approx([0.0575, 0.1025, 0.0067], abs=5e-5)


@pytest.mark.parametrize("side", ["x", "y"])
def test_plates_of_the_quadrant_are_those_of_its_surfaces(side: str) -> None:
    geometry = GeometryConfig.model_validate({"kink_side": side, "dihedral": 0.1, "axis_azimuth": 0.6})
    flat, strip = flap_plates(geometry)
    *flats, last = (area_and_centre(surface.corners) for surface in surfaces(geometry))
    area = sum(part[0] for part in flats)
    assert (flat.area, strip.area) == pytest.approx((area, last[0]), rel=1e-12)
    assert flat.centre == pytest.approx(sum(a * c for a, c in flats) / area, rel=1e-12)
    assert strip.centre == pytest.approx(last[1], rel=1e-12)


def test_mass_centre_and_inertia_are_those_of_a_cloud_of_points() -> None:
    masses = (
        {"mass": 0.1, "place": (0.0, 0.0, -0.09), "size": (0.03, 0.05, 0.08)},
        {"mass": 0.01, "place": (0.03, 0.04, -0.01), "size": (0.02, 0.01, 0.02), "mirrored": True},
    )
    geometry = GeometryConfig.model_validate({"masses": masses, "inertia": "masses", "dihedral": 0.15})
    rng = np.random.default_rng(1)
    points, weights = [], []
    for surface in surfaces(geometry):
        a, b, c = surface.unfolded[:3]  # rectangles: a + s (b - a) + t (c - b)
        s, t = rng.random((2, 100_000))
        cloud = a + s[:, None] * (b - a) + t[:, None] * (c - b)
        area = np.linalg.norm(np.cross(b - a, c - b))
        for x in (1.0, -1.0):
            for y in (1.0, -1.0):
                points.append(cloud * (x, y, 1.0))
                weights.append(np.full(len(cloud), area / len(cloud)))
    flap_weights = np.concatenate(weights)
    weights = [flap_weights * 4 * geometry.flap_mass / flap_weights.sum()]
    for place, box, mass in [((0.0, 0.0, -0.09), (0.03, 0.05, 0.08), 0.1)] + [
        ((0.03 * x, 0.04 * y, -0.01), (0.02, 0.01, 0.02), 0.01) for x in (1, -1) for y in (1, -1)
    ]:
        points.append(place + (rng.random((100_000, 3)) - 0.5) * box)
        weights.append(np.full(100_000, mass / 100_000))
    p, w = np.concatenate(points), np.concatenate(weights)
    centre = w @ p / w.sum()
    x, y, z = (p - centre).T
    moments = [w @ (y * y + z * z), w @ (x * x + z * z), w @ (x * x + y * y)]
    weight = weigh(geometry)
    assert weight.mass == pytest.approx(0.24, abs=1e-12)
    assert weight.axis_height == pytest.approx(-centre[2], abs=5e-5)
    assert weight.inertia == pytest.approx(moments, rel=2e-3)


@pytest.mark.long
@pytest.mark.parametrize("geometry", geometries(20))
@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_mirrored_robot_feels_the_mirrored_force_and_torque(geometry: GeometryConfig, axis: str) -> None:
    """A mirror turns flap angles and axial vectors (rates, torques) round, where it leaves forces and velocities."""
    plant, M = plant_of(geometry), MIRRORS[axis]
    q, v, omega = (
        Rotation.from_euler("xyz", [0.2, -0.1, 0.3]),
        np.array([0.4, -0.7, 0.5]),
        np.array([1.0, -2.0, 3.0]),
    )
    flaps = np.array([0.3, -0.5, 0.6, -0.1])
    plant.place((0, 0, 1.15), q.as_quat(scalar_first=True), v, omega, flaps)
    seen = plant.wrench_B.copy()
    mirrored = Rotation.from_matrix(M @ q.as_matrix() @ M)
    plant.place(
        (0, 0, 1.15), mirrored.as_quat(scalar_first=True), M @ v, -M @ omega, -flaps[list(PARTNERS[axis])]
    )
    assert plant.wrench_B[:3] == pytest.approx(M @ seen[:3], abs=1e-12)
    assert plant.wrench_B[3:] == pytest.approx(-M @ seen[3:], abs=1e-12)


@pytest.mark.parametrize("geometry", geometries(20))
def test_at_its_trim_every_geometry_carries_its_weight_and_nothing_else(geometry: GeometryConfig) -> None:
    force, torque = plant_of(geometry).mounted_wrench(np.radians([25, -25, 25, -25]))
    assert force == pytest.approx([0, 0, weigh(geometry).mass * 9.81], abs=1e-12)
    assert torque == pytest.approx([0, 0, 0], abs=1e-12)


BESIDE = "geometry.outline=[[0.04, 0.0], [0.115, 0.0], [0.115, 0.115], [0.04, 0.115]]"  # the base plate
IMPOSSIBLE: Mapping[str, str] = {
    "geometry.base_side=0.3": r"base_side = 0\.3: leaves no flaps inside footprint = 0\.23",
    "geometry.strip_width=0.08": r"strip_width = 0\.08: leaves no flat part of the flap, which is 0\.075 wide",
    "geometry.footprint=0.5; geometry.base_side=0.25; geometry.strip_width=0.125": r"which is 0\.125 wide",
    "geometry.footprint=0.25; geometry.base_side=0.25": r"base_side = 0\.25: leaves no flaps inside footprint = 0\.25",
    **{
        f"{BESIDE}; geometry.strip_width=0.12; geometry.kink_side={side}": f"of the flap, which is {width} wide"
        for side, width in (("x", r"0\.075"), ("y", r"0\.115"))
    },
    "geometry.outline=[[-0.01, 0.05], [0.115, 0.0], [0.115, 0.115]]": r"outline\[0\] = \(-0\.01, 0\.05\): .* overlap",
    "geometry.outline=[[0.05, 0.05], [0.115, -0.01], [0.115, 0.115]]": r"outline\[1\] = \(0\.115, -0\.01\): .* overlap",
    "geometry.outline=[[0.05, 0.05], [0.125, 0.0], [0.115, 0.115]]": r"outline\[1\] = .* outside footprint / 2",
    "geometry.outline=[[0.05, 0.0], [0.115, 0.0], [0.06, 0.03], [0.04, 0.11]]": "not convex",
    "geometry.outline=[[0.05, 0.0], [0.1, 0.0]]": "2 corners: expected three",
    "geometry.outline=[[0.03, 0.0], [0.115, 0.0], [0.115, 0.115], [0.0, 0.115]]": "overlaps the base plate",
    "geometry.masses=[{mass=-0.1}]": r"masses\[0\]\.mass = -0\.1: .*greater than 0",
    "geometry.masses=[{mass=0.2, place=[0.01, 0.0, -0.1]}]": r"x, y = 6\.7, 0\.0 mm: outside the axis of symmetry",
    "geometry.masses=[{mass=0.2, place=[0.0002, 0.0, -0.1]}]": r"x, y = 0\.1, 0\.0 mm: outside the axis of symmetry",
    "geometry.masses=[{mass=0.2, place=[0.0, -0.0002, -0.1]}]": r"x, y = 0\.0, -0\.1 mm: outside the axis of symmetry",
    "geometry.masses=[{mass=0.1, place=[0.001, 0.0, 0.1]}, {mass=0.1, place=[-0.001, 0.0, -0.3]}]": "of inertia 4e-05",
    "geometry.masses=[{mass=0.2, place=[0.0, 0.0, 0.1]}]": "mm below the flap axes: outside 0..500",
    "geometry.masses=[{mass=0.2, place=[0.0, 0.0, -0.2], size=[0.9, 0.9, -0.1]}]": r"greater than or equal to 0",
    "geometry.masses=[{mass=0.1, place=[0.1, 0.1, -0.1]}, {mass=0.1, place=[-0.1, -0.1, -0.1]}]": "product of inertia",
    "geometry.kink_side=z": "kink_side = 'z'",
    "plant.hover_angle=1.2": r"drag coefficient of \d+\.\d: outside 0.1..3",
}  # fmt: skip


@pytest.mark.parametrize("override", IMPOSSIBLE)
def test_an_impossible_robot_is_refused_in_one_line(override: str) -> None:
    with pytest.raises(LabError, match=IMPOSSIBLE[override]) as caught:
        load_config(overrides=override.split("; "))
    assert "\n" not in str(caught.value)


def test_a_trapezoid_beside_the_base_plate_is_accepted() -> None:
    geometry = load_config(overrides=[BESIDE]).geometry
    flat, strip = flap_plates(geometry)
    assert flat.area + strip.area == pytest.approx(0.075 * 0.115)
    assert math.isfinite(weigh(geometry).axis_height)
