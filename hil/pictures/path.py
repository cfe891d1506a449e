"""The paths of the body and of its goal as SVG, without a drawing library: in space, from above, from the side.

Lengths in cm, in W from the first goal. A view projects such points into its plane: (2, 3), across and up.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.pictures import scene
from hil.pictures.curves import BLUE, RED
from hil.pictures.panels import Still, spans

Points = NDArray[np.float64]

POINTS = 5000  # drawn at most of a path
WIDTH, HEIGHT = 920, 290  # of the picture; the units of what follows
REACH = 100  # from the middle of a view to its edge
STEPS_CM = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # between two ticks
TITLE, TITLE_IN_SPACE = 1.27, 2.1  # distance of an axis's title from the middle, as a share of the reach
TICKS = 2.5  # at most on either side of zero
AZIMUTH, ELEVATION = np.radians(-60.0), np.radians(30.0)  # of the eye in space
SPACE = 0.62 * np.array([
    (-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0),
    (-np.sin(ELEVATION) * np.cos(AZIMUTH), -np.sin(ELEVATION) * np.sin(AZIMUTH), np.cos(ELEVATION)),
])  # fmt: skip
ABOVE = np.array([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
SIDE = np.array([(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])


@dataclass(frozen=True, slots=True)
class _Wall:
    """A plane with a grid: two axes, and the place of the plane along the third one, as a share of the reach.

    The first axis is labelled beside its grid lines, at `labels` of the reach along the second one; 0: not at all.
    """

    axis: int
    other: int
    place: float
    labels: float


@dataclass(frozen=True, slots=True)
class FlownPath:
    """What a flight did against what it had to do; a goal that never moved gets a cross and a box around it."""

    flown: Points  # (N, 3)
    goal: Points  # (N, 3)
    troubled: NDArray[np.bool_]  # (N,): a fault was in force
    box: float  # half an edge

    @property
    def holds(self) -> bool:
        """Whether the goal never moved."""
        return not bool(np.ptp(self.goal, axis=0).any()) if len(self.goal) else True


def path_of(course: FlownPath) -> Still:
    """Draw the path of the body, red while a fault is in force, and the dashed one of its goal."""
    step = len(course.flown) // POINTS + 1
    marks = (*scene.box_lines(course.box),) if course.holds else ()
    everything = np.concatenate([course.flown, course.goal, *marks])
    reach = 1.1 * max(course.box, float(np.abs(everything).max(initial=0.0)))
    behind = (_Wall(0, 2, 1.0, 0.0), _Wall(1, 2, -1.0, 0.0), _Wall(2, 1, -1.0, 0.0))
    views = (
        (150, SPACE, (_Wall(0, 1, -1.0, -1.25), _Wall(1, 0, -1.0, 1.25), _Wall(2, 0, 1.0, 1.25), *behind)),
        (455, ABOVE, (_Wall(0, 1, 0.0, -1.15), _Wall(1, 0, 0.0, -1.2))),
        (745, SIDE, (_Wall(0, 2, 0.0, -1.15), _Wall(2, 0, 0.0, -1.2))),
    )
    parts = []
    for middle, turned, walls in views:
        view = turned * REACH / reach * ((1.0,), (-1.0,))
        inside = [mark for wall in walls for mark in _grid(view, wall, reach)]
        inside += [_line(view, line, "black", 0.9) for line in marks]
        if not course.holds:
            inside.append(_line(view, course.goal[::step], "black", 1.1, dashes="4 3"))
        inside.append(_line(view, course.flown[::step], BLUE, 0.9))
        inside += [_line(view, course.flown[begin:end], RED, 1.4) for begin, end in spans(course.troubled)]
        inside += _ends(view, course)
        parts.append(f'<g transform="translate({middle} 145)">{"".join(inside)}</g>')
    svg = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" fill="none" font-size="11" '
        f'font-family="sans-serif"><rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>{"".join(parts)}</svg>'
    )
    return Still(svg.encode(), "svg+xml")


def _ends(view: Points, course: FlownPath) -> Iterator[str]:
    """Yield the marks of the first goal, a cross, and of the path's begin, a ring, and end, a dot."""
    yield '<path d="M-6 0h12M0-6v12" stroke="black" stroke-width="1.5"/>'
    for place, look in ((0, f'stroke="{BLUE}" fill="white"'), (-1, f'fill="{BLUE}" stroke="white"')):
        for point in course.flown[place:][:1]:
            x, y = view @ point
            yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" stroke-width="1.3" {look}/>'


def _grid(view: Points, wall: _Wall, reach: float) -> Iterator[str]:
    """Yield the grid lines of a wall with the numbers beside them, and the label of its axis."""
    step = next((step for step in STEPS_CM if reach / step <= TICKS), STEPS_CM[-1])
    for tick in np.arange(-(reach // step), reach // step + 1) * step:
        ends = np.full((2, 3), wall.place * reach)
        ends[:, wall.axis], ends[:, wall.other] = tick, (-reach, reach)
        yield _line(view, ends, "#cccccc", 0.7)
        if wall.labels:
            yield _text(view, wall, reach, (tick, wall.labels * reach), f"{tick:g}")
    if wall.labels:
        beyond = TITLE_IN_SPACE if wall.place else TITLE
        yield _text(view, wall, reach, (beyond * reach, wall.labels * reach), f"{'xyz'[wall.axis]} [cm]")


def _text(view: Points, wall: _Wall, reach: float, place: tuple[float, float], text: str) -> str:
    point = np.full(3, wall.place * reach)
    point[[wall.axis, wall.other]] = place
    x, y = view @ point
    return f'<text x="{x:.1f}" y="{y + 4:.1f}" fill="#333333" text-anchor="middle">{text}</text>'


def _line(view: Points, line: Points, colour: str, width: float, dashes: str = "none") -> str:
    places = " ".join(f"{x:.1f},{y:.1f}" for x, y in (line @ view.T).tolist())
    return (
        f'<polyline points="{places}" stroke="{colour}" stroke-width="{width}" stroke-dasharray="{dashes}"/>'
    )
