"""Pictures of a design: the robot itself, its stability, its hover angle, its reach, and its scaling laws."""

from itertools import product
from math import degrees

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from hil.pictures import curves, scene
from hil.pictures.drawing import WIDTH
from hil.research.design.authority import QUANTITIES, Attainable
from hil.research.design.linear import Point
from hil.research.design.sweeps import FACTORS, HEIGHTS, KINKS, OPENINGS, HoverAngles, PowerLaw, Stability
from hil.world.config import NetConfig
from hil.world.floaty.drawing import look_of
from hil.world.floaty.geometry import weigh
from hil.world.floaty.shape import SIGNS

COLOURS = dict(zip(QUANTITIES, (*curves.AXIS_COLOURS, curves.ORANGE), strict=True))
PAPER_BAND_DEG = (20.0, 25.0)
Points = NDArray[np.float64]


def shape(point: Point) -> Figure:
    """Draw the robot at its hover: from above, along x and along y."""
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    height = weigh(point.geometry).axis_height
    parts = []
    for part in look_of(point.geometry, NetConfig()).parts:
        opening = SIGNS[int(part.label) - 1] * point.opening if part.label else 0.0
        q = scene.turn_quaternion(np.array(part.axis), np.array([opening]))
        turned = scene.rotated(q, part.triangles.reshape(-1, 3)) + np.array(part.place)
        parts.append((turned.reshape(-1, 3, 3), part.colour if part.label else curves.GREY))
    views = (("from above", 1, 0), ("along x: roll", 1, 2), ("along y: pitch", 0, 2))
    for axes, (title, across, up) in zip(figure.subplots(1, 3), views, strict=True):
        for triangles, colour in parts:
            for triangle in triangles:
                plan = 100 * triangle[:, [across, up]]
                axes.add_patch(Polygon(plan, facecolor=colour, alpha=0.35, edgecolor=colour, linewidth=0.4))
        if up == 2:
            axes.plot([0, 0], [0, 100 * height], color=curves.GREY)
            axes.plot(0, 0, "o", color="black", markersize=4)
        half = 60 * point.geometry.footprint
        axes.set_xlim((half, -half) if across == 1 else (-half, half))  # y is to the left of x
        axes.set_ylim((-half, half) if up == 0 else (-0.35 * half, 1.3 * half))
        axes.set_aspect("equal")
        axes.set(
            title=title, xlabel=("y" if across else "x") + " [cm]", ylabel=("z" if up else "x") + " [cm]"
        )
    return figure


def stability(point: Point, sweep: Stability) -> Figure:
    """Draw f_αα over kink and centre of mass, and beside it f_αα and the roll poles over the kink."""
    figure = Figure(figsize=(WIDTH, 3.3), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.25, 1, 1))
    kinks, own = np.degrees(KINKS), degrees(point.geometry.kink_angle)
    size = float(np.abs(sweep.stiffness).max())
    surface = left.contourf(
        kinks, 100 * HEIGHTS, sweep.stiffness, np.linspace(-size, size, 21), cmap="RdBu_r"
    )
    left.contour(kinks, 100 * HEIGHTS, sweep.stiffness, [0.0], colors="black", linewidths=1.5)
    left.plot(own, 100 * weigh(point.geometry).axis_height, "*", color="black", markersize=10)
    left.plot(0.0, 0.0, "o", color="black", clip_on=False)
    left.set(xlabel="kink [deg]", ylabel="centre of mass below the flaps [cm]")
    figure.colorbar(surface, ax=left, label="f_αα [1/s²]: red: falls over")
    middle.plot(kinks, sweep.along, color=curves.BLUE)
    middle.axhline(0.0, color=curves.GREY)
    middle.axvline(own, color="#ff5733", linestyle="--")
    if np.isfinite(sweep.crossing):
        middle.plot(degrees(sweep.crossing), 0.0, "o", color=curves.RED)
        text = f"{degrees(sweep.crossing):.1f}°"
        middle.annotate(text, (degrees(sweep.crossing), 0.0), (4, 6), textcoords="offset points")
    middle.set(xlabel="kink [deg]", ylabel="f_αα [1/s²]")
    parts = ((sweep.poles.real, curves.BLUE, "real"), (sweep.poles.imag, curves.ORANGE, "imaginary"))
    for index, (part, colour, name) in product(range(3), parts):
        right.plot(kinks, part[:, index], ".", color=colour, label="" if index else name)
    right.axhline(0.0, color=curves.GREY)
    right.axvline(own, color="#ff5733", linestyle="--")
    right.set(xlabel="kink [deg]", ylabel="roll poles [1/s]")
    right.legend()
    return figure


def hover(point: Point, sweep: HoverAngles) -> Figure:
    """Draw the input constants over the hover angle, each by its largest, and three readings of "over all axes"."""
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True)
    angles = np.degrees(OPENINGS)
    for name in QUANTITIES:
        values = sweep.constants[name]
        left.plot(angles, values / np.abs(values).max(), color=COLOURS[name], label=name)
    left.axhline(0.0, color=curves.GREY)
    left.set_ylabel("input constant / its largest")
    left.legend()
    for index, (name, curve) in enumerate(sweep.criteria.items()):
        best = degrees(sweep.best(name)[0])
        right.plot(angles, curve, color=curves.SERIES_COLOURS[index], label=f"{name}: {best:.1f}°")
        right.plot(best, 1.0, "o", color=curves.SERIES_COLOURS[index])
    right.set_ylabel("share of the best")
    right.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0))
    for axes in (left, right):
        axes.axvspan(*PAPER_BAND_DEG, color=curves.GREEN, alpha=0.12)
        axes.axvline(degrees(point.opening), color="#2ecc71", linestyle="--")
        axes.set_xlabel("hover angle [deg]")
    return figure


def reach(point: Point, found: Attainable) -> Figure:
    """Draw the attainable set, quantity against quantity; the inner one has the weight as its lift."""
    figure = Figure(figsize=(WIDTH, 4.6), layout="constrained")
    pairs = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
    for axes, (a, b) in zip(figure.subplots(2, 3).flat, pairs, strict=True):
        _outline(axes, found.all[:, [a, b]], curves.BLUE, "any lift")
        if b != 3:
            _outline(axes, found.level[:, [a, b]], curves.ORANGE, "lift = weight ± 2 %")
        axes.plot(0.0, 1.0 if b == 3 else 0.0, "+", color="black")
        for setter, index in ((axes.set_xlabel, a), (axes.set_ylabel, b)):
            setter("lift [weights]" if index == 3 else f"{QUANTITIES[index]} [rad/s²]")
    figure.axes[0].legend(loc="upper left")
    figure.suptitle(
        f"hover at {degrees(point.opening):.0f}°, flaps {degrees(point.low):.0f} to {degrees(point.high):.0f}°",
        fontsize=9,
    )
    return figure


def _outline(axes: Axes, points: Points, colour: str, label: str) -> None:
    if len(points) > 2:
        corners = points[ConvexHull(points, qhull_options="QJ").vertices]
        axes.fill(*corners.T, facecolor=colour, alpha=0.25, edgecolor=colour, label=label)


def scale(laws: tuple[PowerLaw, ...]) -> Figure:
    """Draw every law on logarithmic axes, relative to the robot itself."""
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    causes = ("l", "m", "m / l²")
    for axes, cause in zip(figure.subplots(1, 3), causes, strict=True):
        for index, law in enumerate(one for one in laws if one.cause == cause):
            order = np.argsort(law.x)
            own = len(FACTORS) // 2
            axes.loglog(
                law.x[order] / law.x[own], law.y[order] / law.y[own], marker="o", markersize=3,
                color=curves.SERIES_COLOURS[index], linestyle=("-", "--", ":")[index % 3],
                label=f"{law.quantity}: {round(law.exponent, 6) + 0.0:+.3f} (paper {law.paper:+g})",
            )  # fmt: skip
        axes.set_xlabel(f"{cause}, relative")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(FixedLocator([0.25, 0.5, 1.0, 2.0, 4.0]))
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_locator(NullLocator())
        axes.set_ylim(0.2, 8.0)
        axes.legend(fontsize=6.5, loc="upper center")
    figure.axes[0].set_ylabel("relative")
    return figure


def pareto(
    names: tuple[str, str], found: Points, front: Points, marks: dict[str, tuple[float, float]]
) -> Figure:
    """Draw an optimisation's shapes (N, 2), the Pareto front (M, 2), and robots by name."""
    figure = Figure(figsize=(0.7 * WIDTH, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(*found.T, ".", color=curves.GREY, markersize=2, alpha=0.5, label="tried")
    axes.plot(*front.T, "-", color=curves.BLUE, label="Pareto front")
    for (name, place), colour in zip(marks.items(), (curves.RED, curves.GREEN, curves.PINK), strict=False):
        axes.plot(*place, "*", color=colour, markersize=11, label=name)
    axes.set(xlabel=names[0], ylabel=names[1])
    axes.legend()
    return figure
