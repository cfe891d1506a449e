"""The paper's claims and the pictures of a design, from sweeps whose values are all different."""

from dataclasses import replace
from math import degrees, radians

import numpy as np
import pytest
from matplotlib.colors import to_hex

from hil.config import load_config
from hil.pictures.curves import AXIS_COLOURS, BLUE, GREY, ORANGE, RED, SERIES_COLOURS
from hil.research.design import figures
from hil.research.design.authority import LEVEL_SHARE, Attainable
from hil.research.design.axes import AXES, PITCH, ROLL
from hil.research.design.claims import _near, _stable, claims, robot_lines, text_of
from hil.research.design.linear import Point, point_of
from hil.research.design.sweeps import (
    FACTORS,
    HEIGHTS,
    KINKS,
    OPENINGS,
    HoverAngles,
    PowerLaw,
    Stability,
    flat_high,
    updrafts,
)
from hil.world.floaty.correction import PAPER_TABLE
from hil.world.floaty.geometry import weigh
from support.figures import words_of


@pytest.fixture(scope="module")
def point() -> Point:
    return point_of(load_config())


N = len(OPENINGS)
LAWS = tuple(  # each exactly its power of its cause
    PowerLaw(quantity, cause, FACTORS * n, 3.0 * n * FACTORS**exponent, exponent, paper)
    for n, (quantity, cause, exponent, paper) in enumerate([("speed", "m / l²", 0.5, 0.5), ("lift", "l", 0.1, 0.0),
    ("roll", "l", -1.0, -1.0), ("Re", "m", 0.5, 0.5)], 1)
)  # fmt: skip


def angles(yaw: float = -1.0, pitch: float = 1.0) -> HoverAngles:
    """Constants that change by one per step; criteria with one best, and those within 5 % beside it."""
    steps = np.arange(float(N))
    constants = {"yaw": 90.0 + yaw * steps, "roll": 2.0 + steps, "pitch": pitch * (steps - 10.5),
        "lift": 3.0 + steps}  # fmt: skip
    curves = {}
    for name, best in (("a", 20), ("b", 32)):  # 20 and 26 degrees
        curves[name] = np.full(N, 0.5)
        curves[name][[best - 2, best, best + 1]] = 0.95, 1.0, 0.96
    return HoverAngles(constants, curves)


def test_poles_are_pairs_or_alone() -> None:
    assert text_of([-0.5 + 4j, -0.5 - 4j, -1.005 + 0j]) == "-0.50 ± 4.00i, -1.00 1/s"
    assert text_of([2.0 + 0j]) == "2.00 1/s"


@pytest.mark.parametrize("stable", [True, False])
def test_each_claim_has_the_robot_s_value_and_its_verdict(point: Point, stable: bool) -> None:
    """Floaty agrees; with flat flaps and the centre of mass in their plane it falls over, and other sweeps contradict."""
    robot = point if stable else flat_high(point)
    crossing = radians(33.7 if stable else 1.0)
    sweep = Stability(np.zeros((len(HEIGHTS), len(KINKS))), np.zeros(len(KINKS)), np.zeros((len(KINKS), 3)),
        crossing)  # fmt: skip
    swept = angles() if stable else angles(yaw=1.0, pitch=-1.0)
    found = claims(robot, sweep, swept, LAWS, 1e-10 if stable else 1e-9)
    told = {one.title: (one.ours, one.verdict) for one in found}
    f, flat = robot.linear.constants, flat_high(robot).linear
    by = {True: "agrees", False: "differs"}
    low, high = updrafts(robot)
    kink = degrees(robot.geometry.kink_angle - crossing)
    expected = {
        "flat flaps, centre of mass in their plane: f_αα": (f"{flat.constants.roll_roll:+.1f} 1/s²", True),
        "the same: unstable pole": (f"{max(one.real for one in flat.poles(ROLL)):.2f} 1/s", True),
        "flat flaps: pitch is stable by its V": (text_of(flat.poles(PITCH)), True),
        "kink and low centre of mass: f_αα": (f"{f.roll_roll:+.1f} 1/s²", stable),
        "the same: roll poles": (text_of(robot.linear.poles(ROLL)), stable),
        "kink angle: optimised for stability with a margin": (f"stable from {degrees(crossing):.1f}° on: {kink:+.1f}°",
        stable),
        "pitch stays stable by its V": (text_of(robot.linear.poles(PITCH)), True),
        "rates are damped in roll and pitch": (f"{f.roll_rate:.2f}, {f.pitch_rate:.2f} 1/s", True),
        "best hover angle by a": ("20.0°; within 5 % from 19.0 to 20.5°", True),
        "best hover angle by b": ("26.0°; within 5 % from 25.0 to 26.5°", True),
        "a smaller hover angle: more yaw, less pitch, roll and height": ("so up to 35°" if stable else "not so", stable),
        "updrafts that the flaps hold": (f"{low:.2f} to {high:.2f} m/s", low <= 8 and high >= 11),
        "speed over m / l²": ("0.5000", True), "lift over l": ("0.1000", False), "roll over l": ("-1.0000", True),
        "Re over m": ("0.5000", True),
        "Reynolds number": (f"{1.225 * robot.speed * 0.23 / 1.81e-5:.3g}", False),
        "plant and the Supplement's plate equations": (f"differ by at most {1e-10 if stable else 1e-9:.0e} N, N m", stable),
        "lateral forces cancel under u1 and u2": (f"y/u1 {f.y_u1:.2f}, x/u2 {f.x_u2:.2f} m/s²",
        abs(f.y_u1) < 0.01 and abs(f.x_u2) < 0.01),
    }  # fmt: skip
    for name, (value, error) in PAPER_TABLE.items():
        expected[name.replace("_", " per ")] = (f"{getattr(f, name):.4g}",
            abs(getattr(f, name) - value) <= error)  # fmt: skip
    for title, (ours, holds) in expected.items():
        assert told.pop(title) == (ours, by[holds]), title
    assert {name: verdict for name, (_, verdict) in told.items()} == {
        "dynamics decouple into roll, pitch, yaw and height": "agrees",
        "at hover neither lateral force nor torque": "agrees",
    }  # fmt: skip
    (turning,) = {one.why for one in found if one.title.startswith("a smaller hover angle")}
    assert turning == "Pitch is lost first: its input constant changes sign at 15.0°."
    table = [one for one in found if one.place == "Table of dynamics constants"]
    assert not any(one.why for one in table if one.verdict == "agrees")
    assert not stable or all(one.why for one in table if one.verdict == "differs")
    assert [one.paper for one in found if one.title == "z per vz"] == ["-2 ± 0.1"]


@pytest.mark.parametrize(
    ("roll", "pitch", "verdict"), [(-1, -1, "agrees"), (-1, 1, "differs"), (1, -1, "differs")]
)
def test_rates_are_damped_where_both_are(
    point: Point, monkeypatch: pytest.MonkeyPatch, roll: float, pitch: float, verdict: str
) -> None:
    changed = replace(point.linear.constants, roll_rate=roll, pitch_rate=pitch)
    monkeypatch.setattr(type(point.linear), "constants", property(lambda linear: changed))
    found = _stable(point, Stability(*np.zeros((3, 1)), 0.5))
    assert [one.verdict for one in found if one.title.startswith("rates are damped")] == [verdict]


@pytest.mark.parametrize(("growth", "verdict"), [(-0.01, "agrees"), (0.0, "differs"), (0.01, "differs")])
def test_an_axis_is_stable_where_nothing_grows(
    point: Point, monkeypatch: pytest.MonkeyPatch, growth: float, verdict: str
) -> None:
    monkeypatch.setattr(type(point.linear), "growth", lambda linear, axis: growth)
    sweep = Stability(
        np.zeros((len(HEIGHTS), len(KINKS))), np.zeros(len(KINKS)), np.zeros((len(KINKS), 3)), 0.5
    )
    told = {one.title: one.verdict for one in claims(point, sweep, angles(), LAWS, 0.0)}
    assert {
        told[title] for title in ("flat flaps: pitch is stable by its V", "pitch stays stable by its V")
    } == {verdict}


@pytest.mark.parametrize(("off", "verdict"), [(0.149, "agrees"), (0.151, "differs"), (-0.151, "differs")])
def test_what_is_about_a_value_is_within_15_percent_of_it(
    point: Point, monkeypatch: pytest.MonkeyPatch, off: float, verdict: str
) -> None:
    assert _near(-16.0 * (1.0 + off), -16.0) == verdict
    monkeypatch.setattr(
        type(point.linear), "poles", lambda linear, axis: [complex(-0.5, 4.0 + 4.0 * off), complex(-1.0)]
    )
    sweep = Stability(
        np.zeros((len(HEIGHTS), len(KINKS))), np.zeros(len(KINKS)), np.zeros((len(KINKS), 3)), 0.5
    )
    told = {one.title: one.verdict for one in claims(point, sweep, angles(), LAWS, 0.0)}
    assert told["the same: roll poles"] == verdict


def test_a_robot_is_described_in_the_units_of_its_words(point: Point) -> None:
    lines, weight = dict(robot_lines(point)), weigh(point.geometry)
    low, high = (replace(point, opening=one).speed for one in (point.low + radians(8),
        point.high - radians(8)))  # fmt: skip
    assert lines == {
        "mass, centre of mass below the flaps": f"{weight.mass:.3f} kg, {weight.axis_height * 100:.1f} cm",
        "inertia about x, y, z": ", ".join(f"{one * 1000:.3f}" for one in weight.inertia) + " g m²",
        "kink, footprint, base": "42.5°, 23.0 cm, 8.0 cm", "hover": f"25.0° at 10.00 m/s, C_D = {point.coefficient:.3f}",
        "updrafts with 8° left for attitude": f"{low:.2f} to {high:.2f} m/s",
        **{f"poles, {axis.name}": text_of(point.linear.poles(axis)) for axis in AXES},
    }  # fmt: skip


def test_pictures_of_a_design_show_their_sweeps_by_name(point: Point) -> None:
    rng = np.random.default_rng(1)
    sweep = Stability(rng.normal(size=(len(HEIGHTS), len(KINKS))), rng.normal(size=len(KINKS)),
        rng.normal(size=(len(KINKS), 3)) + 1j, 0.5)  # fmt: skip
    left, middle, right, _ = (stable := figures.stability(point, sweep)).axes
    kinks, own, height = (np.degrees(KINKS), degrees(point.geometry.kink_angle),
        100 * weigh(point.geometry).axis_height)  # fmt: skip
    assert [tuple(line.get_xydata()[0]) for line in left.lines] == [pytest.approx((own, height)), (0.0, 0.0)]
    assert middle.lines[0].get_xydata() == pytest.approx(np.c_[kinks, sweep.along])
    assert [line.get_xdata()[0] for line in (middle.lines[2], right.lines[-1])] == [own, own]
    assert (middle.lines[3].get_xydata().tolist(), middle.texts[0].get_text()) == ([[degrees(0.5), 0.0]],
        "28.6°")  # fmt: skip
    poles = [part[:, index] for index in range(3) for part in (sweep.poles.real, sweep.poles.imag)]
    assert [line.get_ydata() for line in right.lines[:6]] == [pytest.approx(one) for one in poles]
    assert [to_hex(line.get_color()) for line in right.lines[:6]] == [BLUE, ORANGE] * 3
    assert left.collections[0].get_cmap().name == "RdBu_r", "red falls over"
    swept, (left, right) = angles(), (hover := figures.hover(point, angles())).axes
    band = [
        tuple(axes.patches[0].get_extents().transformed(axes.transData.inverted()).intervalx)
        for axes in (left, right)
    ]
    assert band == [pytest.approx((20.0, 25.0))] * 2
    for (name, values), colour in zip(
        swept.constants.items(), (AXIS_COLOURS[2], *AXIS_COLOURS[:2], ORANGE), strict=True
    ):
        shown = {one.get_label(): one for one in left.lines}[name]
        assert shown.get_xydata() == pytest.approx(np.c_[np.degrees(OPENINGS), values / max(abs(values))])
        assert to_hex(shown.get_color()) == colour
    assert [line.get_xydata().tolist() for line in right.lines[1:4:2]] == [[[pytest.approx(20.0), 1.0]],
        [[pytest.approx(26.0), 1.0]]]  # fmt: skip
    assert right.lines[2].get_ydata() == pytest.approx(swept.criteria["b"])
    cube = np.array(np.meshgrid(*[(-n, n) for n in (1.0, 2.0, 3.0, 4.0)])).reshape(4, -1).T
    reached = figures.reach(point, Attainable(cube, 0.5 * cube))
    for axes, (a, b) in zip(reached.axes, ((1, 2), (1, 3), (2, 3), (1, 4), (2, 4), (3, 4)), strict=True):
        spans = [tuple(np.ptp(one.get_xy(), axis=0)) for one in axes.patches]
        assert spans == [(2 * a, 2 * b), (a, b)][: 1 + (b != 4)]
        assert [to_hex(one.get_facecolor()) for one in axes.patches] == [BLUE, ORANGE][: len(spans)]
        assert axes.lines[0].get_xydata().tolist() == [[0.0, float(b == 4)]]
    assert reached.get_suptitle().startswith("hover at 25°, flaps ")
    scale = figures.scale(LAWS)
    scaled = {axes.get_xlabel(): axes for axes in scale.axes}
    assert [words_of(figure) for figure in (stable, hover, reached, scale)] == [
        [("", "kink [deg]", "centre of mass below the flaps [cm]"), ("", "kink [deg]", "f_αα [1/s²]"),
         ("", "kink [deg]", "roll poles [1/s]", "real", "imaginary"), ("", "", "f_αα [1/s²]: red: falls over")],
        [("", "hover angle [deg]", "input constant / its largest", "roll", "pitch", "yaw", "lift"),
         ("", "hover angle [deg]", "share of the best", "a: 20.0°", "b: 26.0°")],
        [("", "roll [rad/s²]", "pitch [rad/s²]", "any lift", f"lift = weight ± {100 * LEVEL_SHARE:g} %"),
         *(("", across, up) for across, up in (("roll [rad/s²]", "yaw [rad/s²]"), ("pitch [rad/s²]", "yaw [rad/s²]"),
           ("roll [rad/s²]", "lift [weights]"), ("pitch [rad/s²]", "lift [weights]"), ("yaw [rad/s²]", "lift [weights]")))],
        [("", "l, relative", "relative", "lift: +0.100 (paper +0)", "roll: -1.000 (paper -1)"),
         ("", "m, relative", "", "Re: +0.500 (paper +0.5)"), ("", "m / l², relative", "", "speed: +0.500 (paper +0.5)")],
    ]  # fmt: skip
    for cause, wanted in (
        ("l", [LAWS[1], LAWS[2]]),
        ("m", [LAWS[3]]),
    ):
        for line, law in zip(scaled[f"{cause}, relative"].lines, wanted, strict=True):
            assert line.get_xydata() == pytest.approx(np.c_[FACTORS, FACTORS**law.exponent])
    assert [line.get_ydata()[2] for line in scaled["m / l², relative"].lines] == [1.0]
    tried, front = np.array([(1.0, 5.0), (2.0, 4.0), (3.0, 1.0)]), np.array([(1.0, 5.0), (3.0, 1.0)])
    (axes,) = figures.pareto(("across", "up"), tried, front, {"floaty": (2.0, 4.0), "best": (3.0, 1.0)}).axes
    assert [(line.get_label(), to_hex(line.get_color())) for line in axes.lines] == [("tried", GREY),
        ("Pareto front", BLUE), ("floaty", RED), ("best", SERIES_COLOURS[2])]  # fmt: skip
    assert [line.get_xydata().tolist() for line in axes.lines] == [tried.tolist(), front.tolist(),
        [[2.0, 4.0]], [[3.0, 1.0]]]  # fmt: skip
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("across", "up")


def test_a_robot_is_drawn_in_centimetres_with_y_to_the_left_of_x(point: Point) -> None:
    """Its flaps end at half the footprint; the kink and the opening lie above the centre of mass, which is a dot."""
    above, along_x, along_y = figures.shape(point).axes
    corners = np.concatenate([one.get_xy() for one in above.patches])
    assert np.abs(corners).max(axis=0) == pytest.approx([11.5, 11.5], abs=1.0)
    assert above.get_xlim() == pytest.approx((13.8, -13.8))
    assert (above.get_xlabel(), above.get_ylabel(), above.get_title()) == ("y [cm]", "x [cm]", "from above")
    height = 100 * weigh(point.geometry).axis_height
    for axes, name, limits in ((along_x, "y", (13.8, -13.8)), (along_y, "x", (-13.8, 13.8))):
        assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_xlim()) == (f"{name} [cm]", "z [cm]",
            pytest.approx(limits))  # fmt: skip
        assert axes.lines[0].get_xydata() == pytest.approx(np.array([(0, 0), (0, height)]))
        assert axes.lines[1].get_xydata().tolist() == [[0.0, 0.0]]
