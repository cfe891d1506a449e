"""`floaty tune`: what it refuses, and a whole round from the author's gains and the plate model."""

import json
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.commands.identify import _edges, _gains, _motion
from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.experiments import find_experiment
from hil.laboratory.request import Options, Request
from hil.laboratory.robot import Streams
from hil.laboratory.run import fly
from hil.research.campaigns.jobs import Job, Row
from hil.research.design.axes import AXES, DELAY, ROLL, gains_in, robot_of
from hil.research.design.loop import FREQUENCIES, Timing, build
from hil.research.design.margins import margins, pose_delay_margin, worst
from hil.research.design.tune import Flow, GainTask, judged, motion
from hil.research.studies import tuning
from hil.research.studies.tuning import Round, TuningFlights, rms
from hil.world.floaty.plant import Plant
from support.command import Cli


def test_the_profile_cad_has_the_plate_model_on_board() -> None:
    config = load_config("floaty", ["plant.variant=plate"])
    plant = Plant(config.geometry, config.plant, config.tunnel, config.actuators, Streams.of_seed(1).gusts)
    cad = load_config("cad")
    assert cad.model.model_dump() == pytest.approx(asdict(plant.linearise()) | {"flap_rate": 20.0}, rel=1e-4)
    assert cad.controller == load_config("as-flown").controller


@pytest.mark.long
def test_an_axis_is_judged_by_old_and_new_gains_for_its_robot_and_by_the_worst_of_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = load_config()
    timing, old = Timing.of(config, 0.04), gains_in(config, ROLL)
    robots, new = [robot_of(config), robot_of(config) | {DELAY: 0.014}], 0.9 * old
    loops = [build(ROLL, robot, config, timing) for robot in robots]
    white = 1e-3 * np.stack([np.eye(2, dtype=complex)] * len(FREQUENCIES))
    task = GainTask(ROLL, Flow(white, 0.0, 0.0), config, timing, 0.0)
    one, each = judged(task, robots, loops, old, new), [margins(loop, new) for loop in loops]
    late = [pose_delay_margin(ROLL, robot, config, timing, new) for robot in robots]
    assert late[1] < late[0]
    assert (one.late, one.least_late) == tuple(late)
    monkeypatch.setattr("hil.research.design.tune.WORSE", 1)
    three = [robots[0], *robots], [loops[0], *loops]
    assert judged(task, *three, old, new).least_late == late[1], "of those with the highest peaks"
    assert (one.old_margins, one.margins, one.least) == (margins(loops[0], old), each[0], worst(each))
    assert (one.old_motion, one.motion) == tuple(motion(loops[0], task, gains) for gains in (old, new))
    assert (one.old.tolist(), one.new.tolist()) == (old.tolist(), new.tolist())
    tuned: Any = SimpleNamespace(axes=(one,), robots=SimpleNamespace(drawn=robots[1:]), before=hovered(0.02))
    flown = hovered(0.03), hovered(0.05, "lost"), hovered(0.04)
    tables = [table(Round(tuned, flown, "given", Path("tuned"))) for table in (_gains, _motion, _edges)]
    gains, moved, shown = ({one.header: [*one.cells] for one in table.columns} for table in tables)
    assert [gains[f"gains, {name}"][0][-20:] for name in ("old", "new")] == [
        ", ".join(f"{gain:.4g}" for gain in own)[-20:] for own in (old, new)
    ]
    predicted = [f"{100 * found.main:.2f} cm" for found in (one.old_motion, one.motion)]
    cells = [predicted[0], "1.20 cm", predicted[1], "1.80 cm", "lost, 2.40 cm"]
    assert [*moved.values()][1:] == [[cell] for cell in cells], "of y"
    assert shown["late poses"] == ["", *(f"{1e3 * one:.0f} ms" for one in late)]
    delays = [found.delay for found in (one.old_margins, one.margins, one.least)]
    assert shown["delay"] == [f"{1e3 * delay:.0f} ms" for delay in delays]


def hovered(rms_m: float, outcome: str = "completed") -> Row:
    metrics = {"rms_x": 0.48 * rms_m, "rms_y": 0.6 * rms_m, "rms_z": 0.64 * rms_m}
    return Row(Job(0, "hover", Options(), {}, Path("run")), outcome, "", True, "", metrics, {})


def test_a_round_designs_each_axis_from_the_hover_s_flow_and_flies_its_gains_and_the_worst(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    config = load_config()
    robots = SimpleNamespace(nominal="nominal", drawn=("a", "b"), about="within")
    age = SimpleNamespace(mean_us=41_000.0, p99_us=52_000.0)
    asked: list[Any] = []

    def judge(task: GainTask, every: Any, loops: Any, old: Any, new: Any) -> Any:
        flow, delay = f"flow of record, {task.axis.name}, nominal", task.delay
        assert (task.flow, task.config, task.timing, delay) == (flow, config, Timing.of(config, 0.041),
            pytest.approx(0.011))  # fmt: skip
        assert every == ["nominal", "a", "b"]
        assert loops == [f"{task.axis.name} of {one}, 0.04" for one in every]
        assert (old.tolist(), new.tolist()) == (gains_in(config, task.axis).tolist(), (2.0 * old).tolist())
        delays = {"roll": (0.03, 0.025), "pitch": (0.02, 0.024), "yaw": (0.05, 0.022), "height": (0.04, 0.05)}
        delay, late = delays[task.axis.name]
        return SimpleNamespace(axis=task.axis, new=new, least=SimpleNamespace(delay=delay), least_late=late)

    def design(task: GainTask, loops: Any, start: Any) -> Any:
        assert start[0] == f"regulator of {task.axis.name}, nominal"
        return 2.0 * start[1]

    for name, answer in {
        "robots_of": lambda profile, known, count: robots if (profile, known, count) == ("mine", config, 2) else None,
        "load_config": lambda profile: config, "read_result": lambda folder: SimpleNamespace(ages=[age, None]),
        "load_record": lambda folder, profile: "record",
        "flow_of": lambda record, axis, robot: f"flow of {record}, {axis.name}, {robot}",
        "build": lambda axis, robot, known, timing: f"{axis.name} of {robot}, {timing.age_s:g}", "design": design,
        "by_regulator": lambda axis, robot: f"regulator of {axis.name}, {robot}", "judged": judge,
        "refuse_late": lambda axes, jitter: asked.append((len(axes), round(jitter, 6))),
        "write_tuned": lambda *what: asked.append(what[:2]), "worst_settings": lambda *what: [("x=1",), ("y=2",)],
    }.items():  # fmt: skip
        monkeypatch.setattr(tuning, name, answer)

    def log(name: str, flights: Any, folder: Path) -> list[Row]:
        asked.append({place: (one["profile"], one["overrides"]) for place, (_, one) in flights.items()})
        return [hovered(0.01 * (1 + n), outcome) for n in range(len(flights))]

    outcome = "completed"
    flights = TuningFlights(5, "c", tmp_path, SimpleNamespace(log=log))  # type: ignore[arg-type]
    one = tuning.fly_round("mine", flights, 2)
    path = tmp_path / "tuned.toml"
    flown = {"after": (str(path), ()), "after-1": (str(path), ("x=1",)), "after-2": (str(path), ("y=2",))}
    assert asked == [{"before": ("mine", ())}, (4, 0.011), (path, "mine"), flown]
    assert (one.given, one.written, len(one.flown), rms(one.flown[2])) == (
        "mine",
        path,
        3,
        pytest.approx(0.03),
    )
    assert one.tuned.least_delay_s == 0.02
    assert (one.tuned.age_s, one.tuned.jitter_s) == (pytest.approx(0.041), pytest.approx(0.011))
    tuned, usual = one.tuned.config.controller.model_dump(), config.controller.model_dump()
    gains = {gain for axis in AXES for gain in axis.gains}
    assert tuned == usual | {name: pytest.approx(2.0 * usual[name]) for name in gains}
    outcome = "lost"
    with pytest.raises(
        LabError, match=r"^mine: its own gains lose the robot \(\): no hover to measure the flow with$"
    ):
        tuning.fly_round("mine", flights, 2)


@pytest.mark.parametrize(
    ("old", "new", "better", "another"),
    [
        (hovered(0.02), hovered(0.018), True, True),
        (hovered(0.02), hovered(0.95 * 0.02), True, True),
        (hovered(0.02), hovered(0.0195), True, False),
        (hovered(0.02), hovered(0.02), True, False),
        (hovered(0.02), hovered(0.021), False, False),
        (hovered(0.02), hovered(0.01, "lost"), False, False),
    ],
)
def test_new_gains_are_judged_against_the_old_ones(old: Row, new: Row, better: bool, another: bool) -> None:
    one = Round(SimpleNamespace(before=old), (new,), "given.toml", Path("tuned.toml"))  # type: ignore[arg-type]
    assert (one.better, one.worth_another) == (better, another)
    assert one.profile == ("tuned.toml" if better else "given.toml")
    assert rms(old) == pytest.approx(0.02)


def test_a_round_begins_with_the_gains_of_the_one_before_and_other_seeds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flown: list[tuple[Path, int, str]] = []
    hovers = iter([(0.04, 0.03), (0.03, 0.0299), (0.03, 0.03)])

    def log(name: str, flights: Any, folder: Path) -> list[Row]:
        flown.extend((folder, options["seed"], options["profile"]) for _, options in flights.values())
        return [hovered(0.02)]

    def fly_round(model: str, own: TuningFlights, count: int) -> Round:
        old, new = map(hovered, next(hovers))
        return Round(SimpleNamespace(before=old), (new,), model, own.folder / "tuned.toml")  # type: ignore[arg-type]

    for name in ("load_record", "identify", "write_profile", "_tunable"):
        monkeypatch.setattr(tuning, name, lambda *_: None)
    monkeypatch.setattr(tuning, "fly_round", fly_round)
    own = TuningFlights(5, "c", Path("out"), SimpleNamespace(log=log))  # type: ignore[arg-type]
    given = [one.given for one in tuning.rounds("floaty", own, 3, 9)]
    assert given == [f"out/round-{number}/model.toml" for number in (1, 2)]
    begun = ((1, 5, "floaty"), (2, 15, "out/round-1/tuned.toml"))
    assert flown == [
        (Path(f"out/round-{n}"), seed + one, base) for n, seed, base in begun for one in range(4)
    ]


def test_the_worst_robots_that_a_plant_can_be_are_flown_the_worst_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A robot is its peak; those with a constant of another sign or over four times the plant's are no plant's."""
    config = load_config(overrides=["plant.constant_factors={roll_u1=0.9}"])
    truth = asdict(tuning.plant_of(config).linearise())
    given = config.plant.constant_factors
    robots = [{name: value * share for name, value in truth.items()} | {"peak": peak, "flap_rate": 20.0 + peak}
        for share, peak in ((1.0, 2.0), (0.5, 5.0), (3.99, 3.0), (4.01, 9.0), (1.5, 4.0), (0.25, 1.0))]  # fmt: skip
    robots += [truth | {"roll_u1": -truth["roll_u1"], "peak": 8.0, "flap_rate": 20.0}]
    monkeypatch.setattr(
        tuning,
        "build",
        lambda axis, robot, *_: SimpleNamespace(open_loop=lambda gains: robot["peak"] * gains),
    )
    monkeypatch.setattr(tuning, "peak_of", lambda found: found)
    axes = [SimpleNamespace(axis=n, new=n, margins=SimpleNamespace(peak=2.0)) for n in (1.0, 3.0)]
    tuned: Any = SimpleNamespace(axes=axes, robots=SimpleNamespace(drawn=robots), age_s=0.04, config=config)
    found = tuning.worst_settings(tuned, config)
    for (factors, lag), (share, peak) in zip(found, ((0.5, 5.0), (1.5, 4.0), (3.99, 3.0)), strict=True):
        assert f"roll_u1={share * given.get('roll_u1', 1.0):.5f}" in factors
        assert lag == f"actuators.tau={1 / (20.0 + peak):.5f}"
        assert load_config(overrides=[factors, lag])
    for other in (load_config(overrides=["plant.variant=plate"]), load_config("crazyflie")):
        assert tuning.worst_settings(tuned, other) == []


def test_a_tuned_profile_has_what_differs_from_its_base(tmp_path: Path) -> None:
    base = load_config()
    new = {"model": {"roll_u1": 200.5}, "servo": {"trim": (1, 2, 3, 4)}, "controller": {"gain_y": -1.75}}
    config = base.model_copy(
        update={part: getattr(base, part).model_copy(update=one) for part, one in new.items()}
    )
    tuning.write_tuned(tmp_path / "t.toml", "floaty", config, "About.")
    assert load_config(str(tmp_path / "t.toml")) == config
    text = (tmp_path / "t.toml").read_text()
    assert "About." in text
    assert text.count(" = ") == 4, "the base and what differs"


@pytest.mark.parametrize(("excited", "flown", "message"), [
    ("lost", "completed", "round 1 ends: identify-u1 lost the robot: fell"),
    ("completed", "lost", "round 1 ends: the new gains lose the robot: fell"), ("completed", "completed", "")])  # fmt: skip
def test_a_lost_robot_ends_the_rounds(
    monkeypatch: pytest.MonkeyPatch, excited: str, flown: str, message: str
) -> None:
    def row(outcome: str, name: str = "identify-u1") -> Any:
        return SimpleNamespace(
            outcome=outcome, error="fell", folder="f", job=SimpleNamespace(experiment=name)
        )

    one = SimpleNamespace(flown=(row(flown),), worth_another=False)
    for name in ("load_record", "identify", "write_profile", "_tunable"):
        monkeypatch.setattr(tuning, name, lambda *_: None)
    monkeypatch.setattr(tuning, "fly_round", lambda *_: one)
    own = TuningFlights(
        5, "c", Path("out"), SimpleNamespace(log=lambda *_: [row("completed", "x"), row(excited)])
    )  # type: ignore[arg-type]
    done: list[Any] = []
    with pytest.raises(LabError, match=f"^{message}$") if message else nullcontext():
        done.extend(tuning.rounds("floaty", own, 3, 9))
    assert done == [one] * (excited == "completed")
    with pytest.raises(KeyboardInterrupt):
        TuningFlights(5, "c", Path("out"), SimpleNamespace(log=lambda *_: [])).hover("a", "floaty")  # type: ignore[arg-type]


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "message"),
    [([], "its own gains lose the robot"), (["--repeat", "2"], "round 1 ends: identify-u1 lost the robot: ")],
)
def test_a_lost_robot_ends_in_one_line(cli: Cli, tmp_path: Path, arguments: list[str], message: str) -> None:
    profile = tmp_path / "bad.toml"
    profile.write_text('base = "cad"\n[controller]\ngain_y = 3.5\n')
    assert cli("tune", "--profile", profile, "--runs", tmp_path / "runs", *arguments) == 2
    assert message in cli.err


@pytest.mark.long
def test_tuning_from_the_authors_gains_hovers_like_the_default_profile(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "mine.toml"
    arguments = (
        "--profile", "cad", "--repeat", "1", "--out", out, "--runs", tmp_path / "runs", "--robots", "10",
    )  # fmt: skip
    assert cli("tune", *arguments) == 0
    shown = cli.out
    assert "least of 11" in shown
    assert "round 1" in shown
    for name, folder in (("floaty", "usual"), (str(out), "tuned")):
        cli("fly", "hover", "--profile", name, "--seed", "7", "--out", tmp_path / folder)
    usual, tuned = (
        json.loads((tmp_path / name / "result.json").read_text())["metrics"] for name in ("usual", "tuned")
    )
    for axis in ("rms_x", "rms_y"):
        assert tuned[axis] < 1.15 * usual[axis], axis


@pytest.mark.long
def test_an_excitation_has_the_same_telemetry_on_every_board_so_gains_are_the_same(tmp_path: Path) -> None:
    logs = set()
    for board in ("python", "c", "cortex-m4"):
        request = Request.of(find_experiment("identify-u3"), board=board, duration_s=6.0)
        fly(request, tmp_path / board)
        logs.add((tmp_path / board / "telemetry.csv").read_bytes())
    assert len(logs) == 1


def test_hovers_share_a_seed_and_excitations_have_each_their_own(tmp_path: Path) -> None:
    asked: list[dict[str, Any]] = []
    runner: Any = SimpleNamespace(log=lambda name, flights, folder: asked.append(flights) or ["row"])
    flights = TuningFlights(7, "python", tmp_path, runner)
    flights.hover("after", "mine", ("a=1",), ("b=2",))
    flights.excitations("mine")
    hovers, excited = (
        [(folder, one["seed"], one["board"]) for folder, (_, one) in flown.items()] for flown in asked
    )
    assert hovers == [("after", 7, "python"), ("after-1", 7, "python"), ("after-2", 7, "python")]
    assert [one["overrides"] for _, one in asked[0].values()] == [(), ("a=1",), ("b=2",)]
    assert excited == [(f"identify-u{n}", 6 + n, "python") for n in (1, 2, 3, 4)]
