"""The high-level commander, byte for byte as cflib's own classes pack: what it answers, and what the estimator then gets."""

from collections.abc import Callable
from types import SimpleNamespace

import pytest
from cflib.crazyflie.commander import Commander
from cflib.crazyflie.high_level_commander import HighLevelCommander
from scipy.spatial.transform import Rotation

from firmware_py.core.structs import GOAL_OF_CORRECTIONS
from firmware_py.core.subset import i32
from firmware_py.signals import COUNTERS
from firmware_py.wire import crtp
from support.crtp_client import LOG, PARAM, CrtpClient

HIGH_LEVEL = 8
ENOEXEC = 8
HERE = (0.3, -0.2, 1.4)


class Flyer(CrtpClient):
    """A board that gets a pose every 20 ms, and cflib's commanders."""

    def __init__(self, absolute: bool) -> None:
        super().__init__()
        self.place, self.yaw = HERE if absolute else (0.0, 0.0, 0.0), 0.0
        self.posing = True
        self.params, self.logs = self.toc(PARAM), self.toc(LOG)
        self._packets: list[bytes] = []
        radio = SimpleNamespace(
            send_packet=lambda packet: self._packets.append(bytes((packet.header, *packet.data))),
            platform=SimpleNamespace(get_protocol_version=lambda: 12),
        )
        self.commander, self.low_level = HighLevelCommander(radio), Commander(radio)
        self.write(self.params, "extPose.absolute", absolute)
        for size in ("radius", "below", "above"):  # wide: the box has tests of its own
            self.write(self.params, f"box.{size}", 5.0)
        self.events.at(self.now_us + 1000, self._pose)
        self.run(max(self.now_us, 700_000) + 300_000)
        self.sent.clear()

    def _pose(self, now_us: int) -> None:
        x, y, z, w = Rotation.from_euler("z", self.yaw).as_quat().tolist()
        if self.posing:
            self.firmware.radio_received(crtp.encode_ext_pose(self.place, (w, x, y, z), 20_000))
        self.events.at(now_us + 20_000, self._pose)

    def order(self, command: Callable[..., None], *arguments: object, **options: object) -> int:
        """The status that a command of cflib's is answered with."""
        command(*arguments, **options)
        packet = crtp.decode(self._packets.pop())
        reply = self.one(HIGH_LEVEL, 0, packet.data)
        assert reply[:3] == packet.data[:3].ljust(3, b"\0")
        return reply[3]

    def post(self, command: Callable[..., None], *arguments: object) -> None:
        """Send what is not answered."""
        command(*arguments)
        self.firmware.radio_received(self._packets.pop())
        self.run(self.now_us + 5000)

    def goal(self) -> list[float]:
        return self.log(self.logs, "ctrltarget.x", "ctrltarget.y", "ctrltarget.z")

    def estimate(self) -> list[float]:
        """What the flight core knows: the error."""
        return self.firmware.signals.estimate[:3].tolist()

    def wait(self, duration_s: float) -> None:
        self.run(self.now_us + round(duration_s * 1e6))

    @property
    def state(self) -> str:
        return self.firmware.signals.supervisor.state.name


@pytest.fixture
def absolute() -> Flyer:
    return Flyer(True)


@pytest.fixture
def relative() -> Flyer:
    return Flyer(False)


def test_what_cannot_be_flown_is_named_once_on_the_console(absolute: Flyer) -> None:
    commander, low = absolute.commander, absolute.low_level
    for _ in range(3):
        assert absolute.order(commander.start_trajectory, 5) == 0
        assert absolute.order(commander.go_to, float("nan"), 0, 0, 0, 1.0) == ENOEXEC
        assert absolute.one(HIGH_LEVEL, 0, b"\x63")[3] == ENOEXEC
        absolute.post(low.send_velocity_world_setpoint, 0.0, 0.0, 1.0, 0.0)
        absolute.wait(0.02)
    absolute.post(low.send_notify_setpoint_stop)
    assert [line for line in absolute.console if line.startswith("commander:")] == [
        "commander: trajectory 5 is not defined",
        "commander: high-level command go_to (0, False, False, nan, 0.0, 0.0, 0.0, 1.0): must be finite",
        "commander: high-level command 63: unknown",
        "commander: set-point not followed: only positions are",
    ]


@pytest.mark.long
def test_a_reason_that_comes_again_after_a_followed_set_point_is_named_again(absolute: Flyer) -> None:
    line = "commander: set-point not followed: only positions are"
    for times in (1, 2):
        absolute.post(absolute.low_level.send_velocity_world_setpoint, 0.0, 0.0, 1.0, 0.0)
        absolute.wait(0.02)
        assert absolute.console.count(line) == times
        for _ in range(21):  # longer than lines of one kind are withheld
            absolute.post(absolute.low_level.send_position_setpoint, *HERE, 0.0)
            absolute.wait(0.48)


def test_why_set_points_are_not_followed_is_said_once_until_one_is_followed(
    absolute: Flyer, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = list[str]()
    monkeypatch.setattr(absolute.firmware.pilot, "_refuse", lambda kind, text: said.append(text))
    for place in (90.0, 90.0, HERE[0], 90.0, 90.0):
        absolute.post(absolute.low_level.send_position_setpoint, place, *HERE[1:], 0.0)
        absolute.wait(0.02)
    box = "it leaves the box, see box.radius, box.below and box.above"
    assert said == [f"commander: set-point not followed: {box}"] * 2


def test_to_ask_whether_a_place_is_admitted_changes_nothing_that_flies(absolute: Flyer) -> None:
    data = absolute.firmware._core.data.fields
    data.goal[:], data.goal_velocity[:], data.goal_kind = (1, 2, 3, 4), (5, 6, 7), i32(GOAL_OF_CORRECTIONS)
    before = {name: absolute.firmware.inputs[name].tolist() for name in absolute.firmware.inputs.dtype.names}
    for goal in (None, (0.1, 0.2, 0.3)):
        absolute.firmware.pilot.admits_place((9.0, 9.0, 9.0), goal, absolute=True)
    after = {name: absolute.firmware.inputs[name].tolist() for name in before}
    assert {name for name in before if before[name] != after[name]} == {"setpoint"}


@pytest.mark.long
@pytest.mark.parametrize(
    ("places", "admitted"),
    [((0.0, 0.0), True), ((0.0, 7.0, 0.0), False), ((0.0, 7.0), False), ((8.0, 7.0, 0.0), True), ((8.0, 0.0, 7.0), False),
     ((8.0, 9.0, 0.0), False), ((8.0, 7.0), False)],
)  # fmt: skip
def test_a_path_is_admitted_that_ends_in_the_box_and_is_never_further_outside_than_where_it_begins(
    absolute: Flyer, monkeypatch: pytest.MonkeyPatch, places: tuple[float, ...], admitted: bool
) -> None:
    pilot, refused = absolute.firmware.pilot, list[str]()
    monkeypatch.setattr(pilot, "_refuse", lambda kind, text: refused.append(text))
    assert pilot.admits([(HERE[0] + x, *HERE[1:]) for x in places]) is admitted
    assert bool(refused) is not admitted


def test_a_stream_that_stops_without_the_notice_is_reported_before_the_board_locks(absolute: Flyer) -> None:
    absolute.post(absolute.low_level.send_position_setpoint, *HERE, 0.0)
    absolute.wait(0.7)
    assert absolute.console[-1] == (
        "commander: set-points stopped without their notice; 1.5 s more lock the board"
    )


def test_only_the_notice_0_hands_the_lead_back_and_other_channels_have_none(absolute: Flyer) -> None:
    absolute.post(absolute.low_level.send_position_setpoint, *HERE, 0.0)
    assert absolute.order(absolute.commander.takeoff, 2.0, 0.2) == 0
    for port, channel, data in ((7, 1, b"\1" + bytes(4)), (7, 2, bytes(5)), (3, 1, bytes(14)), (3, 3, b"")):
        absolute.send(port, channel, data)
        absolute.wait(0.05)
    assert (absolute.goal(), absolute.firmware.link.malformed) == (pytest.approx(HERE), 0)
    absolute.post(absolute.low_level.send_notify_setpoint_stop)
    absolute.wait(0.2)
    assert absolute.goal()[2] == pytest.approx(2.0)


@pytest.mark.long
def test_take_off_go_to_and_land_move_the_goal_and_the_estimator_gets_the_error(absolute: Flyer) -> None:
    assert absolute.order(absolute.commander.takeoff, 1.0, 2.0) == 0
    absolute.wait(2.2)
    assert absolute.goal() == pytest.approx([0.3, -0.2, 1.0], abs=1e-5)
    assert absolute.estimate() == pytest.approx([0, 0, 0.4], abs=0.01)
    assert absolute.order(absolute.commander.go_to, 0.1, 0.1, 1.5, 0.5, 1.0) == 0
    absolute.wait(0.5)
    velocity = [f"stateEstimate.v{axis}" for axis in "xyz"]
    assert absolute.log(absolute.logs, *velocity) == pytest.approx([0, 0, 0], abs=0.3), (
        "it stands; its goal moves"
    )
    absolute.wait(0.7)
    assert absolute.goal() == pytest.approx([0.1, 0.1, 1.5])
    assert absolute.log(absolute.logs, "controller.yaw") == pytest.approx([28.65], abs=0.01)
    c, s = 0.87758, 0.47943  # of the goal's yaw
    assert absolute.estimate() == pytest.approx([c * 0.2 - s * 0.3, -c * 0.3 - s * 0.2, -0.1], abs=0.01)
    assert absolute.log(
        absolute.logs, "stateEstimate.x", "stateEstimate.y", "stateEstimate.z"
    ) == pytest.approx(HERE, abs=0.01)
    assert absolute.order(absolute.commander.land, 0.4, 1.0, yaw=None) == 0
    absolute.wait(1.1)
    assert absolute.goal() == pytest.approx([0.1, 0.1, 0.4])
    assert absolute.state == "FLYING"  # it stays where it has landed


@pytest.fixture
def boxed(absolute: Flyer) -> Flyer:
    """A board at home in the middle of its box."""
    absolute.place = (0.0, 0.0, 1.15)
    for size, value in (("radius", 0.15), ("below", 0.65), ("above", 0.5)):
        absolute.write(absolute.params, f"box.{size}", value)
    absolute.wait(0.1)
    return absolute


def test_robot_that_was_pushed_out_of_the_box_may_return(boxed: Flyer) -> None:
    boxed.place = (0.3, 0.0, 1.15)
    boxed.wait(0.1)
    assert boxed.order(boxed.commander.go_to, 0.1, 0.0, 1.15, 0.0, 1.0) == 0
    boxed.commander.stop()
    assert boxed.order(boxed.commander.go_to, 0.31, 0.0, 1.15, 0.0, 1.0) == ENOEXEC


@pytest.mark.long
@pytest.mark.parametrize("place", [(0.0, 0.0, 1.1), (0.95, 0.0, 0.0), (0.7, 0.7, 0.0), (0.0, 0.0, -2.1)])
def test_an_impossible_correction_only_reports(relative: Flyer, place: tuple[float, float, float]) -> None:
    before = relative.estimate()
    relative.place = place
    relative.wait(0.3)
    assert relative.estimate() == pytest.approx(before, abs=1e-3)
    lines = [line for line in relative.console if "extPose.absolute" in line]
    assert lines == [
        "pose refused: {} {} {} cm is no correction; for absolute poses set extPose.absolute 1".format(
            *(round(100 * x) for x in place)
        )
    ]
    assert relative.firmware.signals.counters[COUNTERS.index("invalid")] >= 14


def send_full_state(flyer: Flyer, x: float, y: float, z: float, yaw_deg: float) -> None:
    q = (
        Rotation.from_euler("ZYX", (yaw_deg, 25, 20), degrees=True).as_quat().tolist()
    )  # its tilt is not flown
    nothing = (0.0, 0.0, 0.0)
    flyer.post(flyer.low_level.send_full_state_setpoint, (x, y, z), nothing, nothing, q, 0.0, 0.0, 0.0)


def send_position(flyer: Flyer, x: float, y: float, z: float, yaw_deg: float) -> None:
    flyer.post(flyer.low_level.send_position_setpoint, x, y, z, yaw_deg)


@pytest.mark.parametrize("send", [send_position, send_full_state])
def test_position_set_points_move_the_goal_in_steps(absolute: Flyer, send) -> None:
    x, y, z = HERE
    for _ in range(20):
        send(absolute, x + 0.05, y, z - 0.02, 30.0)
        absolute.wait(0.02)
    assert absolute.state == "FLYING"
    assert absolute.goal() == pytest.approx([x + 0.05, y, z - 0.02], abs=1e-6)
    assert absolute.estimate() == pytest.approx(
        Rotation.from_euler("z", -30, degrees=True).apply((-0.05, 0.0, 0.02)), abs=0.005
    )
    assert not [line for line in absolute.console if "set-points" in line]
