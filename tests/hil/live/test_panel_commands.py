"""What is pressed in the panel at a flight in lockstep acts and is an event; a panel that is only open changes nothing."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from firmware_py.table import OF_PROFILE
from ground_station.trajectory import Goal
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.faults import spans_of
from hil.laboratory.files.recorder import load_events, load_log
from hil.laboratory.files.result import read_result
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.metrics import column
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.live.panel_commands import PanelCommands
from hil.pictures.curves import since_release, with_marks
from hil.pictures.panels import marks_of_flight
from hil.pictures.report import fault_rows
from hil.pictures.timeline import close_ups, story_of


class Script:
    """A panel whose lines come at rows of the log, and one after the other while the flight is paused."""

    def __init__(self, at: dict[int, list[str]], paused: tuple[str, ...] = ()) -> None:
        self._at, self._paused, self._looks = at, list(paused), 0
        self.answers: list[str] = []
        self.known: dict[str, float] = {}
        self.shown = 0
        self.gone = False

    def lines(self) -> list[str]:
        self._looks += 1
        return self._at.get(self._looks, [])

    def wait(self) -> list[str]:
        self.gone = not self._paused
        return [] if self.gone else [self._paused.pop(0)]

    def answer(self, t_us: int, text: str) -> None:
        self.answers.append(text)

    def rows(self, batch: pa.RecordBatch) -> None:
        self.shown += batch.num_rows

    def know(self, values: Sequence[tuple[str, float]]) -> None:
        self.known |= dict(values)

    def note(self, t_us: int, source: str, text: str) -> None:
        pass


def flown(folder: Path, view: Script | None, lockstep: bool = True) -> str:
    panels: list[PanelCommands] = []

    def progress(now_us: int, flight: Flight) -> None:
        if view is not None and not panels:
            panels.append(PanelCommands(view, flight, lockstep))

    return fly(Request.of(EXPERIMENTS["hover"], duration_s=1.0), folder, progress, view).hash


@pytest.mark.long
def test_a_panel_that_is_only_open_does_not_change_the_flight(tmp_path: Path) -> None:
    assert flown(tmp_path / "seen", Script({})) == flown(tmp_path / "alone", None)


@pytest.mark.long
def test_goal_fault_and_note_act_and_are_events(tmp_path: Path) -> None:
    view = Script({
        120: ["goal 0.05 0 1.15 10", "mark here", "mocap.dropout:0.2"],
        150: ["goal 9 9 9", "goal 1 2", "push.y=99", "puhs.y", "step 5"],
    })  # fmt: skip
    flown(tmp_path / "run", view)
    log = load_log(tmp_path / "run")
    goal, times = column(log, "goal.x"), since_release(log)
    assert set(np.round(goal, 6)) == {0.0, 0.05}
    moved_s = times[np.flatnonzero(goal)[0]]
    assert 0.1 < moved_s < 0.4
    assert np.degrees(column(log, "goal.yaw"))[-1] == pytest.approx(10)
    texts = [(event["source"], event["text"]) for event in load_events(tmp_path / "run")]
    assert [text for source, text in texts if source == "operator"] == [
        "goal 0.05 0 1.15 10", "mark here", "mocap.dropout:0.2",
    ]  # fmt: skip
    assert any("mocap.dropout" in text for source, text in texts if source == "lab")
    log = with_marks(log, load_events(tmp_path / "run"))
    (interval,) = [one for one in marks_of_flight(log).intervals if one.kind == "fault"]
    assert interval.text == "mocap.dropout:0.2=1"
    assert (interval.begin_s, interval.end_s) == pytest.approx((moved_s, moved_s + 0.2), abs=0.02)
    told = [moment.text for moment in story_of(log, read_result(tmp_path / "run"))]
    assert [text for text in told if "fault" in text] == [
        "fault mocap.dropout:0.2=1 begins", "fault mocap.dropout:0.2=1 ends",
    ]  # fmt: skip
    (close,) = close_ups(log, marks_of_flight(log))
    assert close.figure.title == "mocap.dropout:0.2=1"
    (row,) = fault_rows(spans_of(log.schema.metadata))
    assert float(row.end_s) - float(row.begin_s) == pytest.approx(0.2)
    assert len(view.answers) == 5
    assert view.answers[0] == "goal 9 9 9: more than 1 m from home, 0 0 1.15"
    assert view.answers[1].startswith("goal 1 2: expected goal X Y Z")
    assert "99: " in view.answers[2]
    assert view.answers[4] == "step 5: expected 10..60000 ms"


def test_each_line_acts_up_to_its_bounds_and_no_further(monkeypatch: pytest.MonkeyPatch) -> None:
    """One after the other, for the board has to answer before the next parameter is set; all answers come to one ear."""
    good = {
        1: ["goal 1 -1 2.15 10", "goal -0.5 0 1", "push.x:inf=0.1", "imu.noise:inf=2"],
        8: ["set controller.gain_y -20"], 16: ["set controller.gain_y 20"], 24: ["set predictor.horizon 1"],
        32: ["set predictor.horizon 12"], 40: ["step 10", "step 60000", "set supervisor.pose_timeout_us 300000"],
    }  # fmt: skip
    bad = [
        "goal 1.01 0 1.15", "goal 0 -1.01 1.15", "goal 0 0 0.14", "goal 0 0 inf", "goal 0 0 1.15 nan",
        "goal 0 0 1.15 inf", "step 9.9", "step 60001",
        "set controller.gain_y -20.1", "set controller.gain_y 20.1", "set predictor.horizon 0",
        "set predictor.horizon 13",
    ]  # fmt: skip
    view = Script({**good, 3: bad})
    flight = lockstep_flight(
        Request.of(EXPERIMENTS["hover"], duration_s=0.6, overrides=["flight.release_us=10000"])
    )
    listened: list[object] = []
    listen = type(flight.line).listen
    monkeypatch.setattr(
        type(flight.line), "listen", lambda line, ear: listened.append(ear) or listen(line, ear)
    )
    PanelCommands(view, flight)
    flight.lab.run_to(100_000)
    goal = flight.line.trajectory.at(100_000)
    assert (goal.p_WG, goal.yaw) == ((-0.5, 0.0, 1.0), pytest.approx(np.radians(10.0))), (
        "a goal without yaw keeps it"
    )
    assert [str(fault) for fault in flight.switchboard.active] == ["push.x:inf=0.1", "imu.noise=2"]
    view._at[view._looks + 1] = ["clear"]
    flight.lab.run_to(600_000)
    assert flight.switchboard.active == []
    assert len(listened) == 1
    words = [" ".join(line.split()[:2]) for line in bad]
    assert [answer.startswith(word) for answer, word in zip(view.answers, words, strict=True)] == [
        True
    ] * len(bad)
    assert (view.known["extCtrl.y_P"], view.known[OF_PROFILE["predictor.horizon"].name]) == (-20.0, 12.0)
    assert view.known["supervisor.poseTimeout"] == 300, "the board counts milliseconds"
    flight.close()


def test_a_goal_without_yaw_keeps_that_of_its_instant() -> None:
    flight = lockstep_flight(Request.of(EXPERIMENTS["hover"], duration_s=0.1))
    turning: Any = SimpleNamespace(at=lambda t_us: Goal((0.0, 0.0, 1.15), 1e-6 * t_us))
    flight.line.steer(turning)
    PanelCommands(Script({5: ["goal 0 0.5 1"]}), flight)
    flight.lab.run_to(100_000)
    assert flight.line.trajectory.at(0) == Goal((0.0, 0.5, 1.0), pytest.approx(0.05, abs=0.011))
    flight.close()


@pytest.mark.long
def test_a_parameter_is_set_over_the_radio_and_noted_when_the_board_has_it(tmp_path: Path) -> None:
    view = Script({
        120: ["set controller.gain_y -1.5", "set controller.gain_x -1.5", "set controller.gain_y -1.5"],
        140: ["set controller.gain_y 1e9", "set controller.gian_y 1", "set controller.gain_y", "set predictor.horizon 1.5"],
        160: ["set supervisor.pose_timeout_us 300000"],
    })  # fmt: skip
    flown(tmp_path / "run", view)
    events = [event for event in load_events(tmp_path / "run") if event["source"] == "operator"]
    assert [event["text"] for event in events] == [
        "set controller.gain_y -1.5", "set supervisor.pose_timeout_us 300000",
    ]  # fmt: skip
    assert 1_200_000 < events[0]["t_us"] < 1_300_000
    assert view.known["extCtrl.y_P"] == 1.5, "the board's gain has the other sign"
    assert view.known["supervisor.poseTimeout"] == 300
    assert view.answers == [
        *(
            f"set controller.gain_{axis} -1.5: the board has not answered 'set controller.gain_y -1.5' yet"
            for axis in "xy"
        ),
        "set controller.gain_y 1e9: expected -20..20",
        "set controller.gian_y: no such parameter; did you mean controller.gain_y?",
        "set : expected set NAME VALUE",
        "set predictor.horizon 1.5: expected 1..12, whole numbers",
    ]


def test_a_paused_flight_steps_and_ends_as_an_unpaused_one(tmp_path: Path) -> None:
    view = Script({100: ["pause"]}, ("step 100", "step", "mark still", "go"))
    assert flown(tmp_path / "paused", view) == flown(tmp_path / "alone", None)
    events = [event for event in load_events(tmp_path / "paused") if event["source"] == "operator"]
    times = {event["text"]: event["t_us"] for event in events}
    assert times["step"] - times["step 100"] == 100_000
    assert times["go"] == times["mark still"] == times["step"] + 10_000
    assert view.shown == load_log(tmp_path / "paused").num_rows
    assert not view.gone, "a step pauses once"


@pytest.mark.long
def test_a_flight_whose_station_is_another_program_does_not_pause(tmp_path: Path) -> None:
    view = Script({100: ["pause", "step 50"]})
    flown(tmp_path / "run", view, lockstep=False)
    assert [answer.partition(":")[0] for answer in view.answers] == ["pause", "step"]
    assert "which cannot pause" in view.answers[0]


@pytest.mark.long
def test_a_panel_that_is_closed_lets_a_paused_flight_go_on(tmp_path: Path) -> None:
    flown(tmp_path / "run", Script({100: ["pause"]}))
    assert load_log(tmp_path / "run").num_rows > 190


@pytest.mark.long
def test_stop_interrupts_the_flight(tmp_path: Path) -> None:
    flown(tmp_path / "run", Script({100: ["stop"]}))
    texts = [event["text"] for event in load_events(tmp_path / "run")]
    assert "interrupted by the user" in texts
