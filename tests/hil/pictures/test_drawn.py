"""What is drawn: every line, bar, mark, number and name of a picture, from values that are all different."""

import json
import re
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.colors import to_hex, to_rgba
from scipy.spatial.transform import Rotation

from hil.config import load_config
from hil.laboratory.experiments.power import VEHICLES
from hil.pictures import charts, drawing, gallery, swarm
from hil.pictures.curves import BLUE, GREEN, GREY, ORANGE, PINK, RED, SKY, YELLOW, task_colour
from hil.pictures.drawing import figure_of, name_marks
from hil.pictures.panels import Bar, Instant, Interval, Marks, Panel, Plot, Series, Still
from hil.pictures.path import FlownPath, _grid, _Wall, path_of
from hil.world.floaty.geometry import weigh
from support.html_page import lines_of


def test_a_plot_is_drawn_as_its_values_say_and_its_marks_on_every_axes() -> None:
    t, values = np.array([-1.0, 0.5, 2.0]), np.array([[1.0, 2.0, 4.0], [0.5, 3.0, 0.25]])
    solid = Series("a", RED, t, values[0], width=1.7)
    panels = (Panel("z [cm]", (solid, Series("", BLUE, t, values[1], dashed=True)), 2.0, (-3.0, 4.0), -5.0,
        6.0), Panel("load [%]", tuple(Series(n, c, t, v) for n, c, v in zip("pq", (GREEN, ORANGE), values,
        strict=True)), 1.0, least=0.25, stacked=True), Panel("states", height=0.5,
        bars=(Bar("robot", "held", GREY, -1.0, 0.0), Bar("board", "wait", SKY, 0.5, 1.5),
        Bar("robot", "free", BLUE, 0.0, 2.0), Bar("board", "held", PINK, 1.5, 1.75))))  # fmt: skip
    marks = Marks((Interval("held", -1.0, -0.1), Interval("fault", 0.2, 0.45, "f" * 28),
        Interval("failsafe", 0.5, 0.6), Interval("limit", 0.7, 0.95, "flap 1")),
        (Instant("operator", 0.9, "o" * 29), Instant("lost", 1.9, "fell")))  # fmt: skip
    figure = figure_of(Plot(panels, (-0.5, 1.5)), marks)
    name_marks(figure, marks)
    lines, stacked, states = figure.axes
    assert figure.get_size_inches() == pytest.approx((9.2, 3.5))
    assert [one.get_ylabel() for one in figure.axes] == ["z [cm]", "load [%]", "states"]
    assert (states.get_xlabel(), lines.get_xlabel()) == ("time from the release [s]", "")
    assert [one.get_xlim() for one in figure.axes] == [(-0.5, 1.5)] * 3
    assert (lines.get_ylim(), stacked.get_ylim()[0]) == ((-5.0, 6.0), 0.25)
    drawn = [(to_hex(one.get_color()), one.get_linestyle(), one.get_linewidth()) for one in lines.lines]
    assert drawn[:2] == [(RED, "-", 1.7), (BLUE, "--", 0.9)]
    assert [one.get_xydata().tolist() for one in lines.lines[:2]] == [np.c_[t, v].tolist() for v in values]
    assert [(one.get_ydata()[0], one.get_linestyle()) for one in lines.lines[2:4]] == [(-3.0, "--"),
        (4.0, "--")]  # fmt: skip
    for shape, colour, low, high in zip(
        stacked.collections, (GREEN, ORANGE), (0 * t, values[0]), (values[0], values.sum(axis=0)), strict=True
    ):
        assert to_hex(shape.get_facecolor()[0]) == colour
        corners = {tuple(one) for one in shape.get_paths()[0].vertices.tolist()}
        assert corners == {*zip(t, low, strict=True), *zip(t, high, strict=True)}
    legends = [[text.get_text() for text in one.get_legend().get_texts()] for one in figure.axes]
    assert legends == [["a"], ["p", "q"], ["held", "wait", "free"]]
    bars = [bar for group in states.containers for bar in group]
    assert [(one.get_x(), one.get_width(), one.get_y() + 0.5 * one.get_height(), to_hex(one.get_facecolor()))
            for one in bars] == [
        (-1.0, 1.0, 0.0, GREY), (0.5, 1.0, 1.0, SKY), (0.0, 2.0, 0.0, BLUE), (1.5, 0.25, 1.0, PINK)]  # fmt: skip
    assert ([*states.get_yticks()], [one.get_text() for one in states.get_yticklabels()]) == ([0, 1],
        ["robot", "board"])  # fmt: skip
    colours = {"held": GREY, "fault": RED, "failsafe": PINK, "limit": YELLOW, "operator": BLUE,
        "lost": "black"}  # fmt: skip
    for axes in figure.axes:
        spans = [one for one in axes.patches if one not in bars]
        for one, mark in zip(spans, marks.intervals, strict=True):
            assert (one.get_x(), one.get_width()) == pytest.approx((mark.begin_s, mark.end_s - mark.begin_s))
            assert (one.get_y(), one.get_height()) == (0.0, 0.04 if mark.kind == "limit" else 1.0)
            assert one.get_facecolor()[:3] == to_rgba(colours[mark.kind])[:3]
            assert (one.get_alpha() > 0.5) == (mark.kind == "limit")
        for line, instant in zip(axes.lines[-2:], marks.instants, strict=True):
            assert (line.get_xdata()[0], line.get_color()) == (instant.t_s, colours[instant.kind])
            assert line.get_linestyle() == (":" if instant.kind == "operator" else "-")
    texts = [(one.get_position()[0], one.get_text(), one.get_color()) for one in lines.texts]
    assert texts == [(0.2, "f" * 28, RED), (0.9, "o" * 27 + "…", BLUE), (1.9, "fell", "black")]
    assert not stacked.texts
    assert not states.texts
    key = figure.legends[0]
    names = ["held", "fault", "failsafe", "command at its limit", "operator", "lost"]
    assert [text.get_text() for text in key.get_texts()] == names
    shown = [*key.get_patches(), *key.get_lines()]
    assert [to_rgba(one.get_facecolor())[:3] for one in shown[:4]] == [
        to_rgba(colours[k])[:3] for k in [*colours][:4]
    ]
    assert [(one.get_color(), one.get_linestyle()) for one in shown[4:]] == [(BLUE, ":"), ("black", "-")]


TO_SPACE = Rotation.from_euler("zy", [60, 30], degrees=True).as_matrix()[
    1:
]  # right and up for an eye at -60, 30 degrees
VIEWS = {"150": 0.62 * TO_SPACE, "455": np.eye(3)[:2], "745": np.eye(3)[[0, 2]]}
FLOWN = np.array([(0.0, 0.0, 0.0), (8.0, 4.0, -2.0), (5.0, 5.0, 6.0), (-9.0, 3.0, 1.0)])


@pytest.mark.parametrize(("reach", "lines"), [(25.0, 5), (25.1, 3)])
def test_a_grid_has_at_most_two_lines_and_a_half_beside_its_middle(reach: float, lines: int) -> None:
    assert len([*_grid(np.eye(3)[:2], _Wall(0, 1, 0.0, 0.0), reach)]) == lines


def test_of_a_long_path_every_so_many_places_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    t = np.arange(10.0)
    course = FlownPath(np.c_[t, -t, 2 * t], np.c_[t, t, t], np.zeros(10, np.bool_), 10.0)
    for most, places in ((10, 5), (9, 5), (4, 4), (3, 3), (11, 10)):
        monkeypatch.setattr("hil.pictures.path.POINTS", most)
        lines = re.findall(rb'points="([^"]*)"[^>]*stroke="(?:#0072B2|black)"', path_of(course).content, re.I)
        assert {len(line.split()) for line in lines} == {places}, most


@pytest.mark.parametrize("moves", [False, True])
def test_a_path_is_drawn_to_scale_from_three_sides_on_numbered_grids_behind_it(moves: bool) -> None:
    goal = np.array([(0.0, 0.0, 0.0), (0.0, 12.0, 3.0), (1.0, 2.0, 3.0), (1.0, 2.0, -3.0)]) * moves
    still = path_of(FlownPath(FLOWN, goal, np.array([False, True, True, False]), 10.0))
    reach = 13.2 if moves else 11.0  # a tenth more than the farthest coordinate, or than the box
    ticks = (-10.0, -5.0, 0.0, 5.0, 10.0) if not moves else (-10.0, 0.0, 10.0)
    svg = ElementTree.fromstring(still.content)
    for group in svg.iterfind(".//{*}g"):
        middle = re.fullmatch(r"translate\((\d+) 145\)", group.get("transform", ""))
        assert middle is not None
        view = VIEWS[middle[1]] * 100.0 / reach * ((1.0,), (-1.0,))

        def seen(*points: object, view: np.ndarray = view) -> tuple[float, ...]:
            return tuple((np.reshape(points, (-1, 3)) @ view.T).ravel().round(1).tolist())

        drawn = [(tuple(float(n) for n in re.split("[ ,]", one.get("points", ""))), one.get("stroke"),
                  one.get("stroke-dasharray")) for one in group.iterfind(".//{*}polyline")]  # fmt: skip
        strokes = {stroke: [places for places, other, _ in drawn if other == stroke] for _, stroke,
            _ in drawn}  # fmt: skip
        assert strokes[BLUE] == [pytest.approx(seen(FLOWN), abs=0.11)]
        assert strokes[RED] == [pytest.approx(seen(FLOWN[1:3]), abs=0.11)]
        assert {dash for _, stroke, dash in drawn if stroke == "black"} == ({"4 3"} if moves else {"none"})
        if moves:
            assert strokes["black"] == [pytest.approx(seen(goal), abs=0.11)]
        else:
            corners = np.reshape(np.concatenate(strokes["black"]), (-1, 2))
            cube = {seen(10.0 * np.array(signs)) for signs in np.ndindex(2, 2,
                2) for signs in [2 * np.array(signs) - 1]}  # fmt: skip
            assert {tuple(one) for one in corners.tolist()} == cube
        ends = [(tuple(float(one.get(key, "")) for key in ("cx", "cy")),
            one.get("fill")) for one in group.iterfind(".//{*}circle")]  # fmt: skip
        assert ends == [(seen(FLOWN[0]), "white"), (seen(FLOWN[-1]), BLUE)]
        names, grids = [], set()
        space = middle[1] == "150"
        planes = ([(0, 1, -1.0), (0, 2, 1.0), (1, 2, -1.0)] if space else [(0, 1 if middle[1] == "455" else 2,
            0.0)])  # fmt: skip
        for one, other, place in planes:
            for along, across in ((one, other), (other, one)):
                for tick in ticks:
                    line = np.full((2, 3), place * reach)
                    line[:, along], line[:, across] = tick, (-reach, reach)
                    grids.add(seen(line))
        at = ({0: (1, -1.25), 1: (0, 1.25), 2: (0, 1.25)} if space else {0: (planes[0][1], -1.15),
            planes[0][1]: (0, -1.2)})  # fmt: skip
        for axis, (beside, share) in at.items():
            for tick, text in [
                *((tick, f"{tick:g}") for tick in ticks),
                ((2.1 if space else 1.27) * reach, "xyz"[axis] + " [cm]"),
            ]:
                point = np.full(3, (1.0 if axis == 2 else -1.0) * reach * space)
                point[axis], point[beside] = tick, share * reach
                names.append((text, *seen(point)))
        assert set(strokes["#cccccc"]) == grids
        texts = [(one.text, float(one.get("x", "")), float(one.get("y",
            "")) - 4.0) for one in group.iterfind(".//{*}text")]  # fmt: skip
        assert sorted(text for text, *_ in texts) == sorted(text for text, *_ in names)
        for text, x, y in names:
            assert any(other == text and (u, v) == pytest.approx((x, y), abs=0.16) for other, u,
                v in texts), (text, axis)  # fmt: skip


def test_a_swarm_has_the_path_end_and_home_of_each_robot_and_the_distance_to_its_nearest_neighbour(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    figures = []
    monkeypatch.setattr(swarm, "png", lambda draw: figures.append(draw()) or b"")
    places = [np.array([(0.0, 0.0, 1.0), (0.3, 0.0, 2.0)]), np.array([(0.0, 0.4, 1.0), (0.3, 0.5, 2.0), (0.0, 0.9, 3.0)]),
              np.array([(1.0, 0.0, 1.0), (0.3, 0.1, 2.0), (0.0, 1.0, 3.0)])]  # fmt: skip
    homes = [np.array([0.1 * n, 0.2 * n, 0.3 * n]) for n in (1, 2, 3)]
    swarm._paths(places, homes)
    (figure,) = figures
    for axes, (across, up), names in zip(figure.axes, ((0, 1), (0, 2)), ("xy", "xz"), strict=True):
        assert [axes.get_xlabel(), axes.get_ylabel()] == [f"{name} [cm]" for name in names]
        for n, (path, end, home) in enumerate(zip(*(axes.lines[k::3] for k in range(3)), strict=True)):
            assert path.get_xydata() == pytest.approx(100 * places[n][:, [across, up]])
            assert (*end.get_xydata()[0], end.get_marker()) == (*100 * places[n][-1, [across, up]], "o")
            assert (*home.get_xydata()[0], home.get_marker()) == (*100 * homes[n][[across, up]], "+")
            assert (path.get_color(), end.get_color(), end.get_label()) == (*[(BLUE, ORANGE, GREEN)[n]] * 2,
                str(n + 1))  # fmt: skip
    assert [axes.get_title() for axes in figure.axes] == ["from above", "from the side"]
    logs = [pa.table({"t": [1_000_000 + 10_000 * row for row in range(len(one))]}).replace_schema_metadata(
        {"release_us": "1010000"}) for one in places]  # fmt: skip
    result = SimpleNamespace(request=SimpleNamespace(config=SimpleNamespace(distance_min=0.35)))
    (panel,) = swarm._distances(result, logs, places).plot["panels"]
    assert (panel["label"], panel["limits"], panel["least"]) == ("distance [cm]", (35.0,), 0.0)
    expected = {"robot 1": (40.0, 10.0, np.nan), "robot 2": (40.0, 40.0, 10.0),
        "robot 3": (100.0, 10.0, 10.0)}  # fmt: skip
    for name, (times, values) in lines_of(panel).items():
        assert times == pytest.approx([-0.01, 0.0, 0.01])
        assert values == pytest.approx(expected[name], rel=1e-6, nan_ok=True), name
    assert [one["colour"] for one in panel["series"]] == [BLUE, ORANGE, GREEN]
    (mirrored,) = swarm._distances(result, logs[::-1], places[::-1]).plot["panels"]
    for number, name in enumerate(expected):
        values = lines_of(mirrored)[f"robot {3 - number}"][1]
        assert values == pytest.approx(expected[name], rel=1e-6, nan_ok=True), "whichever log is the shorter"


def test_an_overload_has_the_misses_per_second_and_the_largest_error_at_each_share() -> None:
    """At 0, 40 and 90 % of every tick for half a second each: 0, 3 and 10 misses; the robot is 1, 2 and 30 cm off."""
    shares, row = np.repeat([0.0, 0.4, 0.9], 50), np.arange(150)
    misses = np.interp(row, [49, 52, 99, 109], [0, 3, 3, 13])
    zeros = np.zeros(150)
    offs = {"x": 0.01 * (1 + row // 50), "y": -0.02 * (row // 50), "z": np.where(row == 120, 0.3, 0.0)}
    rows = pa.table({"t": 10_000.0 * row, "flight.free": zeros + 1, "goal.yaw": zeros,
        "cpu.THIEF": np.cumsum(10_000 * shares), "late.KALMAN": misses,
        "late.STABILIZER": zeros} | {f"truth.{axis}": values for axis,
        values in offs.items()} | {f"goal.{axis}": zeros for axis in "xyz"})  # fmt: skip
    late, error = charts.overload(rows).axes
    drawn = {line.get_label(): line for line in late.lines}
    assert drawn["KALMAN"].get_xydata() == pytest.approx(np.array([(0, 0), (40, 6), (90, 20)]))
    assert [(name, to_hex(line.get_color())) for name, line in drawn.items()] == [(name,
        task_colour(name)) for name in ("KALMAN", "STABILIZER")]  # fmt: skip
    worst = {line.get_label(): line.get_ydata() for line in error.lines[:3]}
    assert worst["x"] == pytest.approx([1.0, 2.0, 3.0])
    assert worst["y"] == pytest.approx([0.0, 2.0, 4.0])
    assert worst["z"] == pytest.approx([0.0, 0.0, 30.0])
    assert error.lines[3].get_ydata() == pytest.approx([10.0, 10.0])
    assert (late.get_yscale(), error.get_yscale()) == ("symlog", "log")
    assert [axes.get_ylabel() for axes in (late, error)] == ["missed deadlines [1/s]", "largest error [cm]"]


def test_a_chart_is_drawn_of_all_flights(monkeypatch: pytest.MonkeyPatch) -> None:
    flights = [pa.table({"t": [0]}), pa.table({"t": [1]})]
    monkeypatch.setattr(drawing, "png", lambda draw, *of: repr((draw, *of)).encode())
    assert gallery.chart("compare", *flights) == Still(repr((charts.compare, *flights)).encode(), "png")


def test_vehicles_have_their_power_per_mass_and_floaty_the_mean_of_its_flights() -> None:
    config = load_config()
    stored = json.dumps(config.model_dump(mode="json"))
    flights = [pa.table({"battery.power": [watts] * 2, "flight.free": [1.0,
        1.0]}).replace_schema_metadata({"config": stored}) for watts in (3.0, 4.0)]  # fmt: skip
    mass = weigh(config.geometry).mass * config.plant.mass_factor
    bars, scatter = charts.compare(*flights).axes
    names, values = ["Floaty"], [3.5 / mass]
    for one in VEHICLES:
        names.append(one.name)
        values.append(sum(one.power_range) / 2 / one.mass)
    assert [text.get_text() for text in bars.get_yticklabels()] == names
    patches = [patch for patch in bars.patches if patch.get_height() > 0.5]
    assert [patch.get_width() for patch in patches] == pytest.approx(values)
    assert to_hex(patches[0].get_facecolor()) == RED
    shown = [text.get_text() for text in bars.texts]
    stars = [True, *(one.updraft for one in VEHICLES)]
    assert shown == [f"{value:.0f}" + " ★" * star for value, star in zip(values, stars, strict=True)]
    (whiskers,) = bars.collections
    ends = {row: half for row, half in enumerate((np.ptp(one.power_range) / 2 / one.mass for one in VEHICLES),
        1) if half}  # fmt: skip
    found = {
        int(y): (high - low) / 2
        for (low, y), (high, _) in (p.vertices for p in whiskers.get_paths())
        if high > low
    }
    assert found == pytest.approx(ends)
    assert bars.yaxis_inverted()
    assert bars.get_xlim() == pytest.approx((0.0, 1.12 * max(values))), "all bars and their numbers"
    points = [
        (line.get_xydata()[0].tolist(), line.get_marker()) for line in scatter.lines if len(line.get_xdata())
    ]
    expected = [([one.mass, sum(one.power_range) / 2], "*" if one.updraft else "o") for one in VEHICLES]
    assert points == [*expected, (pytest.approx([mass, 3.5]), "*")]
    (grey,) = (shape.get_paths()[0].vertices for shape in scatter.collections)
    assert {round(y / x, 6) for x, y in grey.tolist()} == {100.0, 250.0}
