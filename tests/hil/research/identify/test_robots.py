"""What `floaty tune` takes from identification: robots that a model's intervals allow, and what the flow does."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

from hil.config import load_config
from hil.errors import LabError
from hil.research.design.axes import AXES, DELAY, PITCH, ROLL, Axis, dynamics, robot_of
from hil.research.design.loop import FREQUENCIES
from hil.research.identify import pages, two_controllers
from hil.research.identify.flow import flow_of
from hil.research.identify.identify import UNKNOWN, WEAK, Identification, IdentifiedConstant
from hil.research.identify.joint import Estimate
from hil.research.identify.record import Record
from hil.research.identify.response import LAG
from hil.research.identify.robots import UNKNOWN_SHARE, KnownModel, beside, robots_of, write_profile
from hil.research.identify.two_controllers import ClosedLoop

CONFIG = load_config()
MS = 1e-3


def written(folder: Path, **changes: object) -> str:
    """A profile with a file beside it, in which a and b of yaw hang together."""
    profile = folder / "mine.toml"
    profile.write_text('base = "floaty"\n')
    known = KnownModel(
        values=CONFIG.model.model_dump(),
        half_widths={"yaw_u3": 11.0, "yaw_rate": 0.8, "lag": 0.004, "delay": 0.002},
        covariance=np.diag([30.0, 0.16, 4e-6, 1e-6]).tolist(),
        delay=0.0145,
    ).model_dump()
    known["covariance"][0][1] = known["covariance"][1][0] = -2.0
    beside(str(profile)).write_text(json.dumps(known | changes))
    return str(profile)


def test_robots_are_drawn_from_the_covariance_beside_the_profile(tmp_path: Path) -> None:
    robots = robots_of(written(tmp_path), CONFIG, 512)
    drawn = np.array([(one["yaw_u3"], one["yaw_rate"]) for one in robots.drawn])
    assert np.cov(drawn.T) == pytest.approx(np.array([[30.0, -2.0], [-2.0, 0.16]]), rel=0.1)
    assert drawn.mean(axis=0) == pytest.approx([110.0, -7.7], abs=0.2)
    lags = np.array([1 / one["flap_rate"] for one in robots.drawn])
    assert lags.mean() == pytest.approx(0.05, rel=0.01)
    assert lags.std() == pytest.approx(0.002, rel=0.1)
    assert robots.nominal[DELAY] == pytest.approx(0.0045)
    assert {one["roll_u1"] for one in robots.drawn} == {230.0}, "of which nothing is said"
    uncertain = robots_of(
        written(tmp_path, covariance=np.diag([30.0, 0.16, 4e-3, 1e-6]).tolist()), CONFIG, 64
    )
    assert max(one["flap_rate"] for one in uncertain.drawn) == pytest.approx(200.0), (
        "no flap lags less than 5 ms"
    )
    early = [one[DELAY] for one in robots_of(written(tmp_path, delay=0.0105), CONFIG, 64).drawn]
    assert min(early) == 0.0 < max(early), "no robot answers before it is told"


def test_without_a_file_every_constant_is_known_to_a_fifth(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    robots = robots_of("floaty", CONFIG, 256)
    spread = np.std([one["pitch_u2"] for one in robots.drawn]) / 1066
    assert 1.96 * spread == pytest.approx(UNKNOWN_SHARE, rel=0.1)
    assert robots_of("floaty", CONFIG, 0).drawn == ()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "floaty.json").write_text("another program's")
    assert robots_of("floaty", CONFIG, 256) == robots


def test_a_profile_has_all_constants_of_an_axis_of_which_one_is_known(tmp_path: Path) -> None:
    every = dict.fromkeys((name for axis in AXES for name in axis.constants), 0.0)
    values = {**every, **CONFIG.model.model_dump(), LAG: 0.04, DELAY: 0.0145} | {
        "roll_u1": 231.0,
        "roll_rate": -3.5,
        "yaw_u3": 9.0,
    }
    constants = tuple(
        IdentifiedConstant(name, "", (0.0, 0.0), 0.0, (0.0, 0.0), (0.0, 0.0), (value, 0.25),
            WEAK if name in ("roll_u1", LAG) else UNKNOWN, "")
        for name, value in values.items()
    )  # fmt: skip
    flown: Any = SimpleNamespace(name="flight", u=np.zeros((9, 4)), config=CONFIG)
    estimate = Estimate(values, dict.fromkeys(values, 0.25), 1.0, (), np.eye(len(values)))
    path = tmp_path / "new.toml"
    assert write_profile(path, "floaty", Identification(constants, (), estimate, (flown,), ())) == ""
    written, text = load_config(str(path)).model, path.read_text(encoding="utf-8")
    assert (written.roll_u1, written.roll_rate, written.flap_rate) == (231.0, -3.5, 25.0)
    assert written.yaw_u3 == CONFIG.model.yaw_u3, "of yaw nothing is known"
    found = dict(re.findall(r"(roll_u1|roll_rate) = \S+ +# (.*)", text))
    assert found == {"roll_u1": "± 0.25, weak", "roll_rate": "± 0.25, not identifiable"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"values": {"roll_u1": 1.0}}, "belongs to another"),
        ({"covariance": [[1.0]]}, "the covariance of 4 constants has 4 rows"),
        ({"covariance": [[1.0] * 3] * 3}, "the covariance of 4 constants has 4 rows"),
        ({"covariance": [[1.0] * 4] * 3}, "the covariance of 4 constants has 4 rows"),
        ({"delay": "soon"}, "delay: Input should be a valid number"),
        ({"more": 1}, "more: Extra inputs"),
    ],
)  # fmt: skip
def test_a_file_that_differs_is_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    with pytest.raises(LabError, match=message):
        robots_of(written(tmp_path, **changes), CONFIG, 8)


def hover(seconds: float) -> tuple[Record, float]:
    """A record of pitch and x in white gusts that the law of `floaty` does not answer, and their spectrum [1/Hz]."""
    rng = np.random.default_rng(5)
    axis, robot = PITCH, robot_of(CONFIG)
    flow, columns = dynamics(axis, robot)
    A, B, *_ = cont2discrete((flow, columns, np.eye(5), np.zeros((5, 3))), MS)
    count = round(seconds / MS)
    u = np.repeat(rng.normal(0, 0.02, count // 100), 100)
    per_hz = 4.0
    torque = rng.normal(0, np.sqrt(per_hz / 2 / MS), count)
    late = np.concatenate([np.zeros(8), u[:-8]])  # delay of the inputs, the gyro's half mean apart
    _, _, x = dlsim((A, B, np.eye(5), np.zeros((5, 3)), MS), np.stack([late, 0 * torque, torque], axis=1))
    rows, poses = np.arange(100, count, 20), np.arange(100, count, 20)
    t = MS * rows
    zero = np.zeros(len(rows))
    averaged = np.convolve(x[:, 3], np.ones(10) / 10)[: len(x)]
    pose = np.stack([x[poses, 0], zero, zero, zero, x[poses, 2], zero], axis=1)
    rates = np.stack([zero, averaged[rows], zero], axis=1)
    inputs = np.stack([zero, 0.5 * (u[rows] + u[rows - 10]), zero, zero], axis=1)
    return Record(
        "hover", t, t, inputs, 0 * inputs, rates, MS * poses + 0.008, pose, 0.0, 0.0, CONFIG, True
    ), per_hz  # fmt: skip


@pytest.mark.long
def test_what_the_model_does_not_explain_is_the_flow() -> None:
    record, per_hz = hover(60.0)
    found = flow_of(record, PITCH, robot_of(CONFIG)).spectrum
    band = (FREQUENCIES > 0.3) & (FREQUENCIES < 8.0)
    assert np.mean(found[band, 1, 1].real) == pytest.approx(per_hz, rel=0.25)
    assert np.mean(found[band & (FREQUENCIES < 1.0), 0, 0].real) < 0.05


def test_two_controllers_give_the_open_loop_by_the_paper_s_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of closed loops whose constants are those of a robot with two gains on the angle; both intervals add up."""
    truth = {ROLL: (230.0, -40.0, -16.0, 1.5), PITCH: (-150.0, -30.0, -20.0, -3.0)}
    config = load_config()

    def record(name: str, excited: bool = False, **gains: float) -> Any:
        controller = config.controller.model_copy(update=gains)
        return SimpleNamespace(
            name=name,
            excitation=np.full((3, 4), float(excited)),
            config=SimpleNamespace(controller=controller),
        )

    def loop(record: Any, axis: Axis) -> ClosedLoop:
        a, *rest = truth[axis]
        names = {ROLL: ("gain_p", "gain_roll", "gain_vy"), PITCH: ("gain_q", "gain_pitch", "gain_vx")}[axis]
        own = [-getattr(record.config.controller, gain) for gain in names]
        none = np.zeros(0)
        starred = np.array([value + a * gain for value, gain in zip(rest, own, strict=True)])
        errors = {"first": (1.0, 3.0, 5.0), "other": (2.0, 4.0, 6.0)}[record.name]
        return ClosedLoop(starred, np.array(errors), none, none, none)

    monkeypatch.setattr(two_controllers, "closed_loop", loop)
    base = record("first", gain_roll=0.2, gain_p=0.3, gain_vy=-0.5)
    others = [record("excited", True, gain_roll=0.9), record("same", gain_roll=0.2),
        record("other", gain_roll=0.15, gain_p=0.1)]  # fmt: skip
    found = two_controllers.two_controllers([base, *others])
    assert [one[0] for one in found.values()] == pytest.approx(truth[ROLL])
    assert list(found) == ["roll_u1", "roll_rate", "roll_roll", "roll_vy"], "of pitch no two gains differ"
    spread = 5.0 / 0.05  # of a: both errors of c*, over the difference of the gains
    halves = [
        spread,
        *(np.hypot(error, spread * gain) for error, gain in ((1.0, 0.3), (3.0, 0.2), (5.0, 0.5))),
    ]
    assert [one[1] for one in found.values()] == pytest.approx([1.96 * one for one in halves])
    both = two_controllers.two_controllers([record("first", gain_pitch=0.1), record("other", gain_pitch=0.2)])
    assert {name: one[0] for name, one in both.items()} == pytest.approx(
        dict(zip(("pitch_u2", "pitch_rate", "pitch_pitch", "pitch_vx"), truth[PITCH], strict=True)))  # fmt: skip
    assert two_controllers.two_controllers([base]) == two_controllers.two_controllers([]) == {}


def test_a_closed_loop_s_constants_are_those_of_two_lines_of_which_y_has_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At the first line c* is -w² of the angle, whatever the robot; the second adds d*; b* has nothing left."""
    monkeypatch.setattr(two_controllers, "TAPER", (1.0, 1.0, 1.0))
    t = np.arange(4100) / 100.0
    rng = np.random.default_rng(1)
    (first, second), ratio = 2 * np.pi * np.array([1.0, 3.0]), 2.5
    slopes = 50.0 * np.sin(np.array([first, second]) / 50.0)  # of differences over 40 ms
    pose = 1e-6 * rng.normal(size=(len(t), 6))
    pose[:, 3] += np.cos(first * t) + 0.7 * np.cos(second * t + 0.4)
    pose[:, 1] += 0.7 * ratio / slopes[1] * np.sin(second * t + 0.4)
    record: Any = SimpleNamespace(name="r", pose_t=t + 3.0, pose=pose)
    found = two_controllers.closed_loop(record, ROLL)
    assert found.w == pytest.approx(np.tile(2 * np.pi * 0.25 * np.arange(1, 20), 10))
    c, other = -first * slopes[0], -second * slopes[1]
    assert found.starred == pytest.approx([0.0, c, (other - c) / ratio], rel=0.01, abs=0.1)
    assert found.acceleration.reshape(10, 19)[:, 3] == pytest.approx(
        c * found.angle.reshape(10, 19)[:, 3], rel=0.02
    )
    window = cut(record, 404)
    back = SimpleNamespace(name="r", pose_t=window.pose_t, pose=window.pose[[*range(402, -1, -1), 403]])
    monkeypatch.undo()
    ahead, behind = (two_controllers.closed_loop(one, ROLL).starred for one in (window, back))
    assert behind == pytest.approx(ahead * [-1.0, 1.0, -1.0], rel=1e-6), "time's direction is that of damping"
    every = 200 * rng.normal(size=(400, 6))[np.arange(len(t)) % 400]  # the same in every window
    same = SimpleNamespace(pose_t=t + 3.0, pose=every)
    once, twice = (two_controllers.closed_loop(cut(same, rows), ROLL) for rows in (405, 805))
    free = (2 * 38 - 3) / (38 - 3)  # numbers of 19 complex bins, without the three constants
    assert (once.errors / twice.errors) ** 2 == pytest.approx(np.full(3, free))
    with pytest.raises(LabError, match=r"^r: 4\.0 s of flight; the paper's method takes windows of 4 s$"):
        two_controllers.closed_loop(cut(record, 402), ROLL)
    assert len(two_controllers.closed_loop(cut(record, 405), ROLL).w) == 19


def cut(record: Any, rows: int) -> Any:
    """The record's first rows."""
    return SimpleNamespace(name="r", pose_t=record.pose_t[:rows], pose=record.pose[:rows])


def test_a_page_shows_each_axis_by_a_flight_that_was_not_fitted_where_there_is_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Of two axes the second was excited twice, and only it in the new flight; constants by whether they are identified."""
    asked: list[Any] = []
    for name in ("_responses", "_period", "_one_step"):
        monkeypatch.setattr(
            pages,
            name,
            lambda *what, name=name: asked.append((name, *what[3 if name == "_responses" else 1 :])),
        )
    monkeypatch.setattr(pages, "_identity", lambda records: ("identity", records))
    monkeypatch.setattr(pages, "rows_of", lambda constants: [one.name for one in constants])
    monkeypatch.setattr(pages, "saved", lambda out, name, title, text, draw: (name, title, draw))
    monkeypatch.setattr(pages, "write_page", lambda path, template, **content: (path, content))
    monkeypatch.setattr(pages, "excited_axes", lambda records: [SimpleNamespace(axis=PITCH, record=0)])

    def one(axis: Axis, record: int) -> Any:
        return SimpleNamespace(axis=axis, record=record)

    fitted = [one(ROLL, 1), one(PITCH, 2), one(PITCH, 0)]
    records = tuple(SimpleNamespace(name=f"r{n}") for n in range(3))
    estimate = SimpleNamespace(values="values", late=(0.1, 0.2, 0.3))
    constants = [SimpleNamespace(name=name, verdict=verdict) for name, verdict in
        (("a", "identified"), ("b", "weak"), ("c", "identified"), ("d", "unknown"))]  # fmt: skip
    found: Any = SimpleNamespace(excited=fitted, records=records, free=(SimpleNamespace(name="f"),), constants=constants,
        estimate=estimate)  # fmt: skip
    held: Any = SimpleNamespace(name="new")
    path, content = pages.write_pages(tmp_path, found, held)
    assert (path, content["known"], content["others"], content["names"]) == (
        tmp_path / "identify.html", ["a", "c"], ["b", "d"], "r0, r1, r2, f")  # fmt: skip
    titles = [(name, title) for name, title, _ in content["figures"]]
    why = "why the paper's equations contain no information about the robot"
    assert titles == [
        ("identify_roll", "roll, from u1"),
        ("identify_pitch", "pitch, from u2"),
        ("identify_paper", why),
    ]
    drawn = [draw() for _, _, draw in content["figures"]]
    assert drawn[2] == ("identity", found.free)
    assert [axes.get_title() for figure in drawn[:2] for axes in figure.axes[-1:]] == [
        "the fitted flight; --validate RUN: another", "a flight that was not fitted"]  # fmt: skip
    (_, *first), (_, *period), (_, *step), (_, *second), (_, *later), (_, *last) = asked
    assert (first, second) == ([fitted[:1], estimate], [fitted[1:], estimate])
    assert (period, step) == ([fitted[0], "values"], [records[1], fitted[0], "values", 0.2])
    assert (later[0].axis, last[0], last[3]) == (PITCH, held, 0.1)
    asked.clear()
    _, content = pages.write_pages(tmp_path, found, None)
    content["figures"][1][2]()
    assert asked[2][1:] == (records[2], fitted[1], "values", 0.3)
