"""The geometry of the scene: surfaces of triangles, turned parts, boxes and nets as lines. Lengths in m, angles in rad.

Nothing here depends on the viewer.
"""

import numpy as np
import pyarrow as pa

from hil.laboratory.metrics import column
from hil.world.scene import Part, Points


def normals_of(part: Part) -> Points:
    """Return the unit normal at each corner of a part's triangles (N, 3, 3), of a plate upwards."""
    a, b, c = np.moveaxis(part.triangles, 1, 0)
    normals = np.cross(b - a, c - a)
    signs = np.where((normals[:, 2] < 0.0) & (not part.closed), -1.0, 1.0)
    normals *= (signs / np.linalg.norm(normals, axis=1))[:, None]
    return np.repeat(normals[:, None], 3, axis=1)


def centre_of(triangles: Points) -> Points:
    """Return the centre of a surface of triangles (N, 3, 3), (3,)."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    centre: Points = areas @ triangles.mean(axis=1) / areas.sum()
    return centre


def turn_of(part: Part, rows: pa.Table) -> Points:
    """Return by which quaternions a part is turned in B in the rows of a log, (N, 4) w x y z; of a real one by telemetry."""
    for name in (part.angle, part.angle.replace("truth.", "telemetry.")):
        if name and name in rows.column_names:
            return turn_quaternion(np.array(part.axis), column(rows, name))
    return np.broadcast_to((1.0, 0.0, 0.0, 0.0), (rows.num_rows, 4))


def force_origin(part: Part, turns: Points) -> Points:
    """Return where the force on a part acts, its centre, for each turn (N, 4): (N, 3) in B."""
    return np.asarray(np.array(part.place) + rotated(turns, centre_of(part.triangles)))


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
    square = half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
    low, high = (np.column_stack((square, np.full(5, z))) for z in (-half, half))
    return [low, high, *(np.array((low[i], high[i])) for i in range(4))]


def turn_quaternion(axis: Points, angle: Points) -> Points:
    """Return the quaternions w x y z (N, 4) that turn about the unit `axis` (3,) by each `angle` (N,)."""
    return np.column_stack((np.cos(angle / 2), np.sin(angle / 2)[:, None] * axis))


def rotated(q_AB: Points, v_B: Points) -> Points:
    """Return v_A (N, 3): v_B, (N, 3) or (3,), turned by each quaternion w x y z of q_AB (N, 4)."""
    w, u = q_AB[:, :1], q_AB[:, 1:]
    t = 2.0 * np.cross(u, v_B)
    return np.asarray(v_B + w * t + np.cross(u, t))
