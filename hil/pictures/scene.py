"""The shapes in the scene: the robot's plates as triangles, and the points where drag acts.

Lengths in m, angles in rad. A flap is drawn in its own frame F, which has its origin on the body's z axis where the flap
axes meet and is parallel to B when the flap angle is 0; the flap turns about its axis, outwards, by its signed angle.
Nothing here depends on the viewer.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.world.config import GeometryConfig, GroundConfig
from hil.world.geometry import axis_of, surfaces, triangles, weigh
from hil.world.shape import MIRRORS

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Mesh:
    """A surface of triangles."""

    vertices: Points  # (N, 3) [m]
    triangles: NDArray[np.int64]  # (M, 3) indices of vertices

    def normals(self) -> Points:
        """Return the unit normal at each vertex, (N, 3), upwards."""
        a, b, c = np.moveaxis(self.vertices[self.triangles], 1, 0)
        normals = np.empty_like(self.vertices)
        normals[self.triangles] = np.cross(b - a, c - a)[:, None]
        return np.asarray(normals * (np.sign(normals[:, 2]) / np.linalg.norm(normals, axis=1))[:, None])


def _quads(*corners: list[tuple[float, float, float]]) -> Mesh:
    """Return quadrilaterals, each of four corners in turn, as triangles with corners of their own."""
    first = 4 * np.arange(len(corners))
    triangles = np.concatenate([(first, first + 1, first + 2), (first, first + 2, first + 3)], axis=1).T
    return Mesh(np.array(corners).reshape(-1, 3), triangles)


def flap_axes(geometry: GeometryConfig) -> Points:
    """Return the flaps' axes, (4, 3) unit vectors in B."""
    return np.asarray(axis_of(geometry) * MIRRORS)


def base_mesh(geometry: GeometryConfig) -> Mesh:
    """Return the base plate in F."""
    c = geometry.base_side / 2
    return _quads([(-c, -c, 0.0), (c, -c, 0.0), (c, c, 0.0), (-c, c, 0.0)])


def flap_mesh(geometry: GeometryConfig, flap: int) -> Mesh:
    """Return flap 0..3 in F: first the triangles of the flat parts, then those of the kinked strip."""
    corners = np.concatenate([triangles(surface.corners) for surface in surfaces(geometry)]) * MIRRORS[flap]
    return Mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def mesh_centre(mesh: Mesh) -> Points:
    """Return the centre of a surface, (3,)."""
    corners = mesh.vertices[mesh.triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    centre: Points = areas @ corners.mean(axis=1) / areas.sum()
    return centre


def outline(geometry: GeometryConfig) -> list[Points]:
    """Return the lines of the robot's ghost in B: the footprint, the base plate and the rod to the centre of mass."""
    turn = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
    halves, height = (geometry.footprint / 2, geometry.base_side / 2), weigh(geometry).axis_height
    squares = [np.column_stack((turn * half, np.full(5, height))) for half in halves]
    return [*squares, np.array([(0.0, 0.0, 0.0), (0.0, 0.0, height)])]


def stand_lines(geometry: GeometryConfig, ground: GroundConfig) -> list[Points]:
    """Return the stand in B: from each corner of the base plate to a foot, and around the feet."""
    corner, foot, height = geometry.base_side / 2, ground.foot_spread, weigh(geometry).axis_height
    turn = [(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]
    feet = np.array([(foot * x, foot * y, -ground.foot_below) for x, y in turn])
    corners = np.array([(corner * x, corner * y, height) for x, y in turn])
    return [feet, *np.stack((corners[:4], feet[:4]), axis=1)]


def net_lines(radius: float, height: float) -> list[Points]:
    """Return the net in W: lines along x and y, 10 cm apart, within a circle."""
    places = np.arange(-0.1 * (radius // 0.1), radius, 0.1)
    halves = np.sqrt(radius**2 - places**2)
    along_x = [
        np.array([(-half, y, height), (half, y, height)]) for y, half in zip(places, halves, strict=True)
    ]
    return along_x + [line[:, (1, 0, 2)] for line in along_x]


def box_lines(half: float) -> list[Points]:
    """Return the edges of a cube around the origin as five closed or straight lines."""
    low, high = (
        np.array(
            [
                (x, y, z)
                for x, y in ((-half, -half), (half, -half), (half, half), (-half, half), (-half, -half))
            ]
        )
        for z in (-half, half)
    )
    return [low, high, *(np.array((low[i], high[i])) for i in range(4))]


def turn_quaternion(axis: Points, angle: Points) -> Points:
    """Return the quaternions w x y z (N, 4) that turn about the unit `axis` (3,) by each `angle` (N,)."""
    return np.column_stack((np.cos(angle / 2), np.sin(angle / 2)[:, None] * axis))


def rotated(q_AB: Points, v_B: Points) -> Points:
    """Return v_A (N, 3): v_B, (N, 3) or (3,), turned by each quaternion w x y z of q_AB (N, 4)."""
    w, u = q_AB[:, :1], q_AB[:, 1:]
    t = 2.0 * np.cross(u, v_B)
    return np.asarray(v_B + w * t + np.cross(u, t))


def tops(geometry: GeometryConfig, p_WB: Points, q_WB: Points) -> Points:
    """Return where the tether is fixed, the middle of the base plate, (N, 3) in W."""
    return p_WB + rotated(q_WB, np.array([0.0, 0.0, weigh(geometry).axis_height]))


def drag_origins(geometry: GeometryConfig, p_WB: Points, q_WB: Points, flaps: Points) -> Points:
    """Return where the drag of the base plate and of the four flaps acts, (N, 5, 3) in W, for flap angles (N, 4)."""
    top, axes = np.array([0.0, 0.0, weigh(geometry).axis_height]), flap_axes(geometry)
    points = [np.broadcast_to(top, p_WB.shape)]
    for flap in range(4):
        centre = mesh_centre(flap_mesh(geometry, flap))
        points.append(top + rotated(turn_quaternion(axes[flap], flaps[:, flap]), centre))
    return np.stack([p_WB + rotated(q_WB, point) for point in points], axis=1)
