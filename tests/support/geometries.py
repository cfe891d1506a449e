"""Random robots of every shape that a profile can describe, always the same ones."""

import numpy as np

from hil.world.config import GeometryConfig


def geometries(count: int) -> list[GeometryConfig]:
    """Robots of 10 to 50 cm, flat and kinked on either side, with and without dihedral, quadrants and trapezoids."""
    rng = np.random.default_rng(18)
    return [_geometry(index, rng) for index in range(count)]


def _geometry(index: int, rng: np.random.Generator) -> GeometryConfig:
    side = rng.uniform(0.05, 0.25)
    base, mass = rng.uniform(0.15, 0.5) * side, rng.uniform(8.0, 40.0) * side * side
    trapezoid = ((base, 0.0), (side, 0.2 * side), (side, side), (rng.uniform(1.0, 2.0) * base, 0.9 * side))
    trunk = {"mass": mass, "place": (0, 0, -rng.uniform(0.1, 0.7) * side), "size": (side, side, base)}
    return GeometryConfig.model_validate({
        "footprint": 2 * side, "base_side": 2 * base, "outline": trapezoid if index % 3 == 2 else (),
        "strip_width": rng.uniform(0.1, 0.4) * side, "kink_angle": rng.uniform(0.0, 1.5), "kink_side": "xy"[index % 2],
        "axis_azimuth": rng.uniform(0.5, 1.1), "dihedral": rng.uniform(-0.2, 0.2) if index % 4 == 1 else 0.0,
        "flow_point": 0.6 * side, "flap_mass": 0.1 * mass, "masses": (trunk,), "inertia": "masses",
    })  # fmt: skip
