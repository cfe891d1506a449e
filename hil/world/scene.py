"""The look of a robot: parts as triangles, frame as lines, markers; stored with a log for the pictures.

Lengths in m, in B or in the frame F of a part, which is parallel to B while its angle is 0. Colours are `#rrggbb`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.elementary import cos, sin
from hil.errors import LabError, refusing

Points = NDArray[np.float64]
Three = tuple[float, float, float]
CENTRE: Three = (0.0, 0.0, 0.0)
UP: Three = (0.0, 0.0, 1.0)
PALE = "#c8ccd0"
TRIANGLES_MAX = 5000  # of a mesh
AROUND, DOWN = 12, 6  # faces of a ball along its equator, and from pole to pole


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A rigid part. With `angle`, a column of the log [rad], it turns about `axis` through `place`.

    `force` is the prefix of the columns with the force on it [N, W]: `force.base` for `force.base_x`.
    """

    name: str
    triangles: Points  # (N, 3, 3) in F
    colour: str = PALE
    place: Three = CENTRE  # of F's origin in B
    axis: Three = UP  # unit vector in F
    angle: str = ""
    force: str = ""
    label: str = ""
    closed: bool = False  # its triangles face outwards; else it is a plate, visible from both sides


@dataclass(frozen=True, slots=True, eq=False)
class Markers:
    """Eight markers, and their obstacles: a flat square in B, and a ball around the centre of mass."""

    places: Points  # (8, 3) in B
    plate_height: float = 0.0
    plate_half: float = 0.0  # of its side; 0: none


@dataclass(frozen=True, slots=True, eq=False)
class VisualModel:
    """How a whole robot is drawn."""

    parts: tuple[Part, ...] = ()
    frame: tuple[Points, ...] = ()  # lines through (N, 3) points: the rods between parts
    outline: tuple[Points, ...] = ()  # of its ghost at the goal
    knot: Three = CENTRE  # where the tether is tied
    markers: tuple[Three, ...] = ()  # places

    def stored(self) -> dict[str, Any]:
        """Return it ready for JSON."""
        parts = [
            {name: getattr(part, name) for name in Part.__slots__} | {"triangles": part.triangles.tolist()}
            for part in self.parts
        ]
        lines = {name: [line.tolist() for line in getattr(self, name)] for name in ("frame", "outline")}
        return {"parts": parts, **lines, "knot": self.knot, "markers": self.markers}

    @classmethod
    def read(cls, stored: Mapping[str, Any]) -> "VisualModel":
        """Return the stored look; an empty one if a log has none."""
        parts = tuple(
            Part(**{**part, "triangles": np.array(part["triangles"]).reshape(-1, 3, 3)})
            for part in stored.get("parts", ())
        )
        frame, outline = (
            tuple(np.array(line).reshape(-1, 3) for line in stored.get(name, ()))
            for name in ("frame", "outline")
        )
        knot, markers = tuple(stored.get("knot", CENTRE)), tuple(map(tuple, stored.get("markers", ())))
        return cls(parts, frame, outline, knot, markers)


def ball(radius: float, centre: Three = CENTRE, colour: str = PALE) -> Part:
    """Return a ball."""

    def point(row: int, turn: int) -> Three:
        down, around = math.pi * row / DOWN, 2.0 * math.pi * turn / AROUND
        return (radius * sin(down) * cos(around), radius * sin(down) * sin(around), radius * cos(down))

    quads = [
        (point(row, turn), point(row + 1, turn), point(row + 1, turn + 1), point(row, turn + 1))
        for row in range(DOWN)
        for turn in range(AROUND)
    ]
    return Part("ball", _halved(quads), colour, centre, closed=True)


def box(size: Three, centre: Three = CENTRE, colour: str = PALE) -> Part:
    """Return a box with edges along x, y and z."""
    x, y, z = (0.5 * edge for edge in size)
    low = [(-x, -y, -z), (x, -y, -z), (x, y, -z), (-x, y, -z)]
    high = [(a, b, z) for a, b, _ in low]
    sides = [(low[i], low[i - 3], high[i - 3], high[i]) for i in range(4)]
    return Part("box", _halved([tuple(low[::-1]), tuple(high), *sides]), colour, centre, closed=True)


def cylinder(radius: float, length: float, centre: Three = CENTRE, colour: str = PALE) -> Part:
    """Return a cylinder along z."""
    low, high = (_circle(radius, z) for z in (-0.5 * length, 0.5 * length))
    sides = [(low[i - 1], low[i], high[i], high[i - 1]) for i in range(AROUND)]
    ends = [
        ((0.0, 0.0, z), a, b)
        for z, ring in ((-0.5 * length, low[::-1]), (0.5 * length, high))
        for a, b in _pairs(ring)
    ]
    return Part("cylinder", np.concatenate([_halved(sides), np.array(ends)]), colour, centre, closed=True)


def disc(radius: float, centre: Three = CENTRE, colour: str = PALE) -> Part:
    """Return a disc without thickness, flat in x and y."""
    return Part("disc", np.array([(CENTRE, a, b) for a, b in _pairs(_circle(radius, 0.0))]), colour, centre)


def mesh(path: Path | str, scale: float = 1.0, centre: Three = CENTRE, colour: str = PALE) -> Part:
    """Return the triangles of an STL file, binary or text, times `scale`: 0.001 for one in mm.

    Raises `LabError` for another file, or for more triangles than every log should carry.
    """
    with refusing(f"{path}: ", OSError):
        content = Path(path).read_bytes()
    count = int.from_bytes(content[80:84], "little")
    if len(content) == 84 + 50 * count > 84:
        words = np.frombuffer(content, np.uint8)[84:].reshape(count, 50)[:, 12:48]
        triangles = np.ascontiguousarray(words).view("<f4").reshape(-1, 3, 3).astype(np.float64)
    else:
        lines = [line.split()[1:] for line in content.splitlines() if line.split()[:1] == [b"vertex"]]
        with refusing(f"{path}: not an STL file: ", ValueError):
            triangles = np.array(lines, np.float64).reshape(-1, 3, 3)
    if not (len(triangles) and np.isfinite(triangles).all()):
        raise LabError(f"{path}: not an STL file: no triangles of finite numbers in it")
    if len(triangles) > TRIANGLES_MAX:
        text = f"{len(triangles)} triangles; at most {TRIANGLES_MAX}: every log has them, so simplify it"
        raise LabError(f"{path}: {text}")
    return Part(Path(path).stem, scale * triangles, colour, centre, closed=True)


def _circle(radius: float, z: float) -> list[Three]:
    turns = (2.0 * math.pi * turn / AROUND for turn in range(AROUND))
    return [(radius * cos(turn), radius * sin(turn), z) for turn in turns]


def _pairs(ring: list[Three]) -> list[tuple[Three, Three]]:
    return [(ring[i - 1], ring[i]) for i in range(len(ring))]


def _halved(quads: Sequence[tuple[Three, ...]]) -> Points:
    """Return quadrilaterals as triangles, without empty ones."""
    halves = ((a, b, c) for q in quads for a, b, c in ((q[0], q[1], q[2]), (q[0], q[2], q[3])))
    return np.array([half for half in halves if len(set(half)) == 3])


def eight_markers(radius: float) -> Points:
    """Return places for eight markers around a robot, (8, 3); exchanging any two changes the pattern."""
    directions = np.array(
        [
            (1.0, -0.2, 0.1), (0.5, 0.8, 0.3), (-0.7, 0.6, 0.0), (-0.8, -0.5, 0.3),
            (0.2, 0.1, 1.0), (-0.1, 0.4, 0.8), (0.4, -0.6, -0.5), (-0.2, -0.9, 0.4),
        ]
    )  # fmt: skip
    lengths = np.sqrt((directions * directions).sum(axis=1))[:, None]
    return np.asarray(radius * directions / lengths)
