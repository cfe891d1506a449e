"""What an operator types: dialogues in simulated time with the firmware at the other end of the line."""

from math import inf, pi, radians
from types import SimpleNamespace

import pytest

from firmware_py.wire import crtp
from firmware_py.wire.supervisor import State
from ground_station.controls import ControlsError
from ground_station.links.crtp_controls import CrtpControls
from ground_station.mocap import MocapFrame
from ground_station.operator import COMMANDS, HELP, LINES, WELL_US, Operator
from ground_station.trajectory import FlightPlan, Goal, Hold, Offsets, Step
from support.crtp_client import CrtpClient

HOME = Goal((0.0, 0.0, 1.15), 0.0)
TURN_US = 5_000
LEVEL = (1.0, 0.0, 0.0, 0.0)


def find(name):
    if name != "yaw-step":
        raise ControlsError(f"experiment {name!r}: unknown")
    return lambda home, start_us: Offsets(home, start_us, yaw=Step(1.0))


class Bench(CrtpClient):
    """A station's loop around the firmware: 5 ms per turn; `fly` needs no world, the robot is where it is said to be."""

    def __init__(self):
        super().__init__()
        entries = self.entries()
        self.heard = inf  # packets that still reach the board
        self.controls = CrtpControls(self._up, lambda: entries)
        self.said, self.noted, self.place = [], [], HOME.p_WG
        self.operator = Operator(find, self.said.append, self.noted.append)
        self.plan = FlightPlan(HOME, lambda home, start_us: Hold(home))
        self.state = State.FLYING
        self.sent.clear()

    def _up(self, data):
        if self.heard > 0:
            self.heard -= 1
            self.firmware.radio_received(data)

    def turns(self, duration_us):
        end_us = self.now_us + duration_us
        while self.now_us < end_us:
            self.run(self.now_us + TURN_US)
            for _, data in self.sent:
                self.controls.receive(self.now_us, crtp.decode(data))
            self.sent.clear()
            link = SimpleNamespace(
                ask=self.controls.ask, answer=self.controls.answer, supervisor_state=self.state
            )
            ground = SimpleNamespace(frame=MocapFrame(self.now_us, self.place, LEVEL, True))
            self.operator.process_lines(
                SimpleNamespace(link=link, ground=ground, plan=self.plan), self.now_us
            )

    def type(self, *lines, wait_us=500_000):
        """Type lines and return what is answered."""
        self.said.clear()
        for line in lines:
            self.operator.queue_line(line)
        self.turns(wait_us)
        return list(self.said)

    def value(self, name):
        return next(item for item in self.firmware.parameters if item.name == name).read()

    @property
    def goal(self):
        return self.plan.at(self.now_us)


@pytest.fixture
def bench():
    return Bench()


def test_a_goal_is_flown_to_at_once_and_noted(bench):
    assert bench.type("goal 0.1 -0.2 1.3 90") == ["goal 0.1 -0.2 1.3 m, yaw 90 deg"]
    assert bench.goal == Goal((0.1, -0.2, 1.3), pi / 2)
    bench.type("goal 0 0 1")
    assert bench.goal.p_WG == (0.0, 0.0, 1.0)
    assert bench.goal.yaw == pytest.approx(radians(90))
    assert bench.noted == ["goal 0.1 -0.2 1.3 m, yaw 90 deg", "goal 0 0 1 m, yaw 90 deg"]


def test_a_trajectory_begins_when_it_is_typed_and_not_again_when_the_station_s_own_would(bench):
    bench.turns(1_000_000)
    bench.type("fly yaw-step", wait_us=TURN_US)
    assert bench.goal.yaw == 1.0
    bench.plan.start(bench.now_us)
    assert bench.goal.yaw == 1.0
    assert bench.noted == ["fly yaw-step"]


@pytest.mark.long
@pytest.mark.parametrize(
    "line",
    [
        "goal", "goal 1 2", "goal a b c", "goal nan 0 1", "goal 0 0 1e9", "goal 0 0 1 2 3", "goal 0 5 1.15", "fly",
        "fly nonsense", "fly a b", "set", "set extCtrl.y_P", "set extCtrl.y_P two", "set extCtrl.y_P inf",
        "set extCtrl.y_P 1e9", "set nonsense 1", "set cpu.flash 3", "get", "get nonsense", "params nonsense", "save now",
        "reset", "reset x", "arm 1", "stop it", "mark", "marks", "gaol 0 0 1", "'", "\x00",
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_changes_nothing(bench, line):
    values = [item.read() for item in bench.firmware.parameters]
    (told,) = bench.type(line)
    assert told.count("\n") == 0
    assert bench.noted == []
    assert bench.goal == HOME
    assert [item.read() for item in bench.firmware.parameters] == values
    assert not bench.firmware.signals.supervisor.stopped
    assert bench.type("get extCtrl.y_P") != []  # it goes on


@pytest.mark.long
@pytest.mark.parametrize(
    ("line", "near"),
    [
        ("gaol 0 0 1", "goal"),
        ("get extCtrl.y_Q", "extCtrl."),
        ("set controller.gain_q2 1", "controller.gain_q"),
    ],
)
def test_near_misses_are_suggested(bench, line, near):
    (told,) = bench.type(line)
    assert f"did you mean {near}" in told


def test_parameters_have_the_board_s_names_or_a_profile_s(bench):
    before = bench.value("extCtrl.y_P")
    (told,) = bench.type("set controller.gain_y -1.5")
    assert told == f"set controller.gain_y -1.5, was {-before:g} (extCtrl.y_P 1.5)"
    assert bench.value("extCtrl.y_P") == 1.5
    assert bench.type("get controller.gain_y", "get extCtrl.y_P") == [
        "controller.gain_y -1.5 (extCtrl.y_P 1.5)", "extCtrl.y_P 1.5",
    ]  # fmt: skip
    assert bench.type("set extCtrl.y_P 1.25") == ["set extCtrl.y_P 1.25, was 1.5"]
    assert bench.noted == [told, "set extCtrl.y_P 1.25, was 1.5"]  # reading changes nothing


def test_params_lists_a_group_and_completes_from_then_on(bench):
    told = bench.type("params motorshifts", wait_us=2_000_000)
    assert [line.split()[0] for line in told] == [f"motorShifts.m{number}" for number in (1, 2, 3, 4)]
    assert len(bench.type("params", wait_us=2_000_000)) == len(bench.firmware.parameters)
    assert "extCtrl.y_P" in bench.operator.known


@pytest.mark.long
def test_reset_goes_back_to_what_last_flew_well(bench):
    first = bench.value("extCtrl.y_P")
    bench.type("set extCtrl.y_P 1.5", "set extCtrl.x_P 1.25")
    bench.turns(WELL_US + 100_000)
    bench.type("set extCtrl.y_P 0.5")
    bench.place = (0.5, 0.0, 1.15)
    bench.turns(WELL_US + 100_000)
    assert bench.type("reset") == ["reset extCtrl.y_P 1.5"]
    assert bench.value("extCtrl.y_P") == 1.5 != first
    assert bench.value("extCtrl.x_P") == 1.25
    assert bench.noted[-1] == "reset extCtrl.y_P 1.5"
    assert "nothing to reset" in bench.type("reset")[0]


def test_before_anything_flew_well_reset_goes_back_to_what_the_board_had(bench):
    first = bench.value("extCtrl.y_P")
    bench.state = State.FAILSAFE
    bench.type("set extCtrl.y_P 1.5", "set extCtrl.y_P 1.75")
    bench.turns(WELL_US + 100_000)
    bench.type("reset")
    assert bench.value("extCtrl.y_P") == first


@pytest.mark.long
def test_values_that_a_reset_is_about_to_change_have_not_flown_well(bench):
    """The robot flies well for long enough while the reset waits for its answer; what it then meets is refused."""
    first = bench.value("extCtrl.y_P"), bench.value("extCtrl.x_P")
    bench.state = State.FAILSAFE
    bench.type("set extCtrl.y_P 1.5", "set extCtrl.x_P 1.25")
    bench.state = State.FLYING
    bench.turns(WELL_US - 100_000)
    bench.heard = 0
    bench.type("reset", wait_us=TURN_US)
    bench.turns(200_000)
    bench.heard = inf
    bench.turns(4_000_000)  # no answer: given up
    bench.state = State.FAILSAFE
    bench.type("reset")
    assert (bench.value("extCtrl.y_P"), bench.value("extCtrl.x_P")) == first


@pytest.mark.long
def test_after_a_reset_that_broke_off_what_is_left_has_to_fly_well_for_as_long_again(bench):
    first = bench.value("extCtrl.y_P"), bench.value("extCtrl.x_P")
    bench.state = State.FAILSAFE
    bench.type("set extCtrl.y_P 1.5", "set extCtrl.x_P 1.25")
    bench.state = State.FLYING
    bench.turns(WELL_US - 400_000)
    bench.heard = 1  # the second value does not reach the board
    bench.type("reset", wait_us=2_500_000)
    assert bench.said[-1] == "reset: no answer within 2 s"
    bench.heard, bench.state = inf, State.FAILSAFE
    bench.type("reset")
    assert (bench.value("extCtrl.y_P"), bench.value("extCtrl.x_P")) == first


@pytest.mark.long
@pytest.mark.parametrize(("off_m", "well"), [(0.099, True), (0.101, False)])
def test_a_value_has_flown_well_after_five_seconds_within_ten_centimetres(bench, off_m, well):
    bench.place = (off_m, 0.0, 1.15)
    bench.type("set extCtrl.y_P 1.5")
    bench.turns(WELL_US - 600_000)
    assert bench.operator._good["extCtrl.y_P"] != 1.5
    bench.turns(200_000)
    assert (bench.operator._good["extCtrl.y_P"] == 1.5) == well


@pytest.mark.long
def test_stop_waits_for_nothing_and_lasts_until_a_reboot(bench):
    bench.type(
        "params", *["mark x"] * 3, " stop ", wait_us=300_000
    )  # the firmware locks in its steps of 40 ms
    assert bench.firmware.signals.supervisor.stopped
    assert bench.noted == ["stop", "stopped"]
    bench.type("arm", "params", wait_us=100_000)
    bench.type("stop", wait_us=50_000)  # the list is still on its way
    assert bench.firmware.signals.supervisor.stopped
    assert "it has to reboot first" in bench.type("arm")[-1]
    bench.reboot()
    bench.turns(4_000_000)  # the gyro's zero is found
    assert bench.type("arm") == ["armed"]
    assert not bench.firmware.signals.supervisor.stopped


def test_an_unacknowledged_stop_is_noted_and_reported(bench):
    bench.heard = 0
    assert bench.type("stop", wait_us=4_000_000) == ["stop: no answer within 2 s"]
    assert bench.noted == ["stop"]


def test_lines_are_done_in_their_order(bench):
    told = bench.type("set extCtrl.y_P 1.5", "get extCtrl.y_P", "mark now it's on", "set extCtrl.y_P 1.25")
    assert [line.split(",")[0] for line in told] == [
        "set extCtrl.y_P 1.5", "extCtrl.y_P 1.5", "mark now it's on", "set extCtrl.y_P 1.25",
    ]  # fmt: skip
    assert bench.noted[1] == "mark now it's on"


@pytest.mark.long
def test_too_many_lines_are_refused_and_reported(bench):
    for number in range(LINES + 5):
        bench.operator.queue_line(f"mark {number}")
    assert len(bench.said) == 5
    bench.turns(LINES * TURN_US)
    assert bench.noted == [f"mark {number}" for number in range(LINES)]


@pytest.mark.long
def test_help_has_every_command(bench):
    assert bench.type("help") == HELP.splitlines()
    assert set(COMMANDS) == {
        "goal", "fly", "set", "get", "params", "save", "reset", "arm", "stop", "mark", "help",
    }  # fmt: skip


@pytest.mark.long
def test_a_parameter_listener_gets_all_values_and_every_change(bench):
    known = {}
    bench.operator = Operator(find, bench.said.append, bench.noted.append, known.update)
    assert bench.type(wait_us=8_000_000) == []
    assert known["extCtrl.y_P"] == pytest.approx(bench.value("extCtrl.y_P"))
    assert len(known) > 100
    bench.type("set controller.gain_y -2.5")
    assert known["extCtrl.y_P"] == 2.5
    assert len(bench.noted) == 1
