"""The high-level commander, byte for byte as cflib's own classes pack: what it answers, and what the estimator then gets."""

import struct
from collections.abc import Callable
from types import SimpleNamespace

import pytest
from cflib.crazyflie.commander import Commander
from cflib.crazyflie.high_level_commander import HighLevelCommander
from cflib.crazyflie.mem.trajectory_memory import CompressedSegment, CompressedStart, Poly4D
from cflib.crazyflie.supervisor import BIT_HL_CONTROL_ACTIVE, BIT_HL_CONTROL_DISABLED, BIT_HL_TRAJ_FINISHED
from numpy.polynomial import Polynomial
from scipy.spatial.transform import Rotation

from firmware_py.signals import COUNTERS
from firmware_py.wire import crtp
from support.crtp_client import LOG, MEM, PARAM, PLATFORM, SUPERVISOR, CrtpClient

HIGH_LEVEL, TRAJECTORIES = 8, 3
EBUSY, ENOEXEC, REFUSED = 16, 8, 1
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

    def upload(self, data: bytes, offset: int = 0) -> None:
        for start in range(0, len(data), 24):
            piece = data[start : start + 24]
            head = struct.pack("<BI", TRAJECTORIES, offset + start)
            assert self.one(MEM, 2, head + piece)[5] == 0


@pytest.fixture
def absolute() -> Flyer:
    return Flyer(True)


@pytest.fixture
def relative() -> Flyer:
    return Flyer(False)


def test_with_absolute_poses_the_robot_waits_for_its_take_off(absolute: Flyer) -> None:
    assert absolute.state == "WAITING"
    assert absolute.estimate() == pytest.approx([0, 0, 0], abs=1e-6)  # wherever it is
    assert absolute.log(absolute.logs, "stateEstimate.x", "kalman.stateZ") == pytest.approx([0.3, 1.4])
    assert absolute.order(absolute.commander.takeoff, 1.0, 2.0, yaw=None) == 0
    absolute.wait(0.02)
    assert absolute.state == "FLYING"
    assert absolute.console.count("supervisor: flying") == 1


def test_take_off_go_to_and_land_move_the_goal_and_the_estimator_gets_the_error(absolute: Flyer) -> None:
    assert absolute.order(absolute.commander.takeoff, 1.0, 2.0) == 0
    absolute.wait(2.2)
    assert absolute.goal() == pytest.approx([0.3, -0.2, 1.0])
    assert absolute.estimate() == pytest.approx([0, 0, 0.4], abs=0.01)
    assert absolute.order(absolute.commander.go_to, 0.1, 0.1, 1.5, 0.5, 1.0) == 0
    absolute.wait(1.2)
    assert absolute.goal() == pytest.approx([0.1, 0.1, 1.5])
    assert absolute.log(absolute.logs, "controller.yaw") == pytest.approx([28.65], abs=0.01)
    c, s = 0.87758, 0.47943  # of the goal's yaw
    assert absolute.estimate() == pytest.approx([c * 0.2 - s * 0.3, -c * 0.3 - s * 0.2, -0.1], abs=0.01)
    assert absolute.log(
        absolute.logs, "stateEstimate.x", "stateEstimate.y", "stateEstimate.z"
    ) == pytest.approx(HERE, abs=0.01)
    assert absolute.order(absolute.commander.land, 0.4, 1.0, yaw=None) == 0
    absolute.wait(0.9)
    assert absolute.state == "FLYING"
    absolute.wait(0.2)
    assert absolute.state == "WAITING"


def test_corrections_are_flown_unchanged_until_the_commander_moves_the_goal(relative: Flyer) -> None:
    assert relative.state == "FLYING"
    relative.place = (0.02, 0.0, 0.01)
    relative.wait(0.5)
    assert relative.estimate() == pytest.approx([0.02, 0.0, 0.01], abs=2e-3)
    assert relative.order(relative.commander.takeoff, 0.3, 1.0) == 0
    relative.wait(1.3)
    assert relative.goal() == pytest.approx([0.0, 0.0, 0.3])
    assert relative.estimate() == pytest.approx([0.02, 0.0, -0.29], abs=0.01)
    assert relative.order(relative.commander.land, 0.0, 1.0) == 0
    relative.wait(1.5)
    assert relative.state == "FLYING"
    assert relative.estimate() == pytest.approx([0.02, 0.0, 0.01], abs=5e-3)


def test_a_moving_goal_is_that_of_the_instant_at_which_the_pose_was_true(absolute: Flyer) -> None:
    absolute.order(absolute.commander.go_to, 1.0, 0.0, 0.0, 0.0, 1.0, relative=True, linear=True)
    absolute.wait(0.5)
    pilot = absolute.firmware.pilot
    last = pilot.seen_us
    assert pilot.goal is not None
    assert pilot.goal.position[0] == pytest.approx(pilot.planner.at(last - 20_000).position[0], abs=2e-3)


def test_a_trajectory_of_polynomials_is_flown_from_where_the_goal_is(absolute: Flyer) -> None:
    x = Polynomial([0.0, 0.0, 0.5, 0.0, -0.2])
    pieces = [
        Poly4D(0.5, Poly4D.Poly([*x.coef, 0, 0, 0])),
        Poly4D(1.5, Poly4D.Poly([x(0.5)] + [0] * 7), z=Poly4D.Poly([0, 0.1] + [0] * 6)),
    ]
    absolute.upload(b"".join(piece.pack() for piece in pieces), 132)
    define = absolute.commander.define_trajectory
    assert absolute.order(define, 1, 132, 2) == 0
    absolute.order(absolute.commander.takeoff, 1.0, 0.5)
    absolute.wait(1.0)
    assert absolute.order(absolute.commander.start_trajectory, 1, 2.0, relative_position=True) == 0
    absolute.wait(0.6 - 0.003)
    assert absolute.goal()[0] == pytest.approx(0.3 + x(0.3), abs=5e-3)
    absolute.wait(4.0)
    assert absolute.goal() == pytest.approx([0.3 + x(0.5), -0.2, 1.15], abs=1e-4)


def test_a_compressed_trajectory_is_flown(absolute: Flyer) -> None:
    parts = [
        CompressedStart(0.0, 0.0, 0.0, 0.0),
        CompressedSegment(1.0, [0.1], [0.0, 0.2, 0.2], [], [1.0]),
        CompressedSegment(0.5, [], [], [0.1] * 7, []),
        CompressedSegment(0.0, [], [], [], []),
    ]
    absolute.upload(b"".join(part.pack() for part in parts))
    assert absolute.order(absolute.commander.define_trajectory, 2, 0, 2, 1) == 0
    absolute.order(absolute.commander.takeoff, 1.0, 0.1)
    absolute.wait(0.5)
    assert absolute.order(absolute.commander.start_trajectory, 2, 1.0, True) == 0
    absolute.wait(0.487)
    x, y, z = absolute.goal()
    assert (x, y, z) == pytest.approx((0.35, -0.2 + 0.1, 1.0), abs=3e-3)  # a Bezier curve's middle
    absolute.wait(2.0)
    assert absolute.goal() == pytest.approx([0.4, 0.0, 1.1], abs=1e-3)
    assert absolute.log(absolute.logs, "controller.yaw") == pytest.approx([57.3], abs=0.1)


def test_impossible_commands_are_refused_with_the_stock_status_and_a_line(absolute: Flyer) -> None:
    commander = absolute.commander
    assert absolute.order(commander.start_trajectory, 5) == ENOEXEC
    assert absolute.order(commander.define_trajectory, 10, 0, 1) == ENOEXEC
    absolute.order(commander.define_trajectory, 3, 4000, 1)
    assert absolute.order(commander.start_trajectory, 3) == ENOEXEC
    absolute.order(commander.define_trajectory, 4, 0, 1)  # all zeros: takes no time
    assert absolute.order(commander.start_trajectory, 4) == ENOEXEC
    assert absolute.order(commander.go_to, float("nan"), 0, 0, 0, 1.0) == ENOEXEC
    assert absolute.order(commander.spiral, 1.0, 0.1, 0.1, 0.0, 1.0) == ENOEXEC
    assert absolute.one(HIGH_LEVEL, 0, b"\x63")[3] == ENOEXEC
    lines = [line for line in absolute.console if line.startswith("commander:")]
    assert len(lines) == 4  # one for each kind: a start, a path, a spiral, an unknown command
    assert absolute.state == "WAITING"
    assert absolute.order(commander.takeoff, 1.0, 1.0) == 0
    assert absolute.order(commander.takeoff, 1.2, 1.0) == REFUSED
    assert absolute.order(commander.land, 1.0, 1.0) == 0
    assert absolute.order(commander.land, 1.2, 1.0) == REFUSED


def test_without_a_pose_take_off_is_refused(absolute: Flyer) -> None:
    absolute.posing = False
    absolute.eeprom[:] = b"\xff" * len(absolute.eeprom)
    absolute.reboot()
    absolute.write(absolute.params, "extPose.absolute", 1)
    absolute.run(800_000)
    assert absolute.order(absolute.commander.takeoff, 1.0, 1.0) == EBUSY
    assert "commander: there has been no pose yet" in absolute.console


def test_a_disarmed_board_takes_no_commands_and_drops_its_path(absolute: Flyer) -> None:
    absolute.order(absolute.commander.takeoff, 1.0, 1.0)
    absolute.one(PLATFORM, 0, b"\x01\x00")  # disarm
    absolute.wait(0.05)
    assert absolute.order(absolute.commander.takeoff, 1.0, 1.0) == EBUSY
    absolute.one(SUPERVISOR, 1, b"\x01\x01")
    absolute.wait(0.05)
    assert absolute.state == "WAITING"
    assert absolute.order(absolute.commander.takeoff, 1.0, 1.0) == 0


@pytest.mark.parametrize("way", ["high level", "set-point"])
def test_stop_ends_the_flight_at_once(absolute: Flyer, way: str) -> None:
    absolute.order(absolute.commander.takeoff, 1.0, 1.0)
    absolute.wait(0.5)
    if way == "high level":
        assert absolute.order(absolute.commander.stop) == 0
    else:
        absolute.post(absolute.low_level.send_stop_setpoint)
    absolute.wait(0.02)
    assert absolute.state == "WAITING"


def test_groups_select_the_receivers(absolute: Flyer) -> None:
    assert absolute.order(absolute.commander.takeoff, 1.0, 1.0, group_mask=2) == 0
    absolute.wait(0.05)
    assert absolute.state == "WAITING"
    absolute.order(absolute.commander.set_group_mask, 6)
    assert absolute.read(absolute.params, "hlCommander.groupmask") == 6
    absolute.order(absolute.commander.takeoff, 1.0, 1.0, group_mask=2)
    absolute.wait(0.05)
    assert absolute.state == "FLYING"


def test_older_commands_and_those_with_a_velocity_fly_the_same_paths(absolute: Flyer) -> None:
    def order(code: int, layout: str, *fields: float) -> int:
        return absolute.one(HIGH_LEVEL, 0, bytes((code,)) + struct.pack("<" + layout, *fields))[3]

    assert order(1, "Bff", 0, 1.2, 0.5) == 0  # take-off
    absolute.wait(0.8)
    assert absolute.goal()[2] == pytest.approx(1.2)
    assert order(4, "BBfffff", 0, 1, 0.1, 0.0, 0.0, 0.0, 0.5) == 0  # go there, relative
    absolute.wait(0.8)
    assert absolute.goal() == pytest.approx([0.4, -0.2, 1.2])
    assert order(10, "Bf?f?f", 0, 0.4, True, 0.0, True, 0.8) == 0  # land, 0.4 m lower, in half a second
    absolute.wait(0.46)
    assert absolute.state == "FLYING"
    absolute.wait(0.1)
    assert absolute.state == "WAITING"
    # Take-off with the default velocity, 0.5 m/s.
    assert order(9, "Bf?f?f", 0, 0.2, True, 0.0, True, 0.0) == 0
    absolute.wait(0.6)
    assert absolute.goal()[2] == pytest.approx(1.6)
    assert order(2, "Bff", 0, 1.0, 0.1) == 0  # land
    absolute.wait(0.2)
    assert absolute.state == "WAITING"


def test_unsupported_set_points_are_reported_once(absolute: Flyer) -> None:
    def refusals() -> list[str]:
        return [line for line in absolute.console if "set-points" in line]

    low = absolute.low_level
    for _ in range(20):
        absolute.post(low.send_velocity_world_setpoint, 0.0, 0.0, 1.0, 0.0)
        absolute.post(low.send_setpoint, 0.0, 0.0, 0.0, 20000)
    assert refusals() == [
        f"commander: {kind} set-points are not flown, positions are" for kind in ("velocity", "attitude")
    ]
    absolute.wait(10.0)
    absolute.post(low.send_hover_setpoint, 0.0, 0.0, 0.0, 1.0)
    absolute.post(low.send_velocity_world_setpoint, 0.0, 0.0, 1.0, 0.0)
    assert len(refusals()) == 4
    assert refusals()[-1] == "commander: velocity set-points are not flown, positions are (19 more before)"
    absolute.post(low.send_setpoint, 0.0, 0.0, 0.0, 0)  # cflib's farewell
    absolute.post(low.send_notify_setpoint_stop)
    assert len(refusals()) == 4


@pytest.fixture
def boxed(absolute: Flyer) -> Flyer:
    """A board at home in the middle of its box."""
    absolute.place = (0.0, 0.0, 1.15)
    for size, value in (("radius", 0.15), ("below", 0.65), ("above", 0.5)):
        absolute.write(absolute.params, f"box.{size}", value)
    absolute.wait(0.1)
    return absolute


@pytest.mark.parametrize(
    ("place", "status"),
    [
        ((0.0, -0.149, 1.15), 0), ((0.0, -0.151, 1.15), ENOEXEC),
        ((0.0, 0.0, 0.501), 0), ((0.0, 0.0, 0.499), ENOEXEC), ((0.0, 0.0, 1.651), ENOEXEC),
    ],
)  # fmt: skip
def test_goals_outside_the_box_fail(boxed: Flyer, place: tuple[float, float, float], status: int) -> None:
    assert boxed.order(boxed.commander.go_to, *place, 0.0, 1.0) == status
    boxed.wait(1.5)
    goal = place if status == 0 else (0.0, 0.0, 1.15)  # where it is
    assert boxed.goal() == pytest.approx(goal, abs=1e-3)
    lines = [line for line in boxed.console if "box" in line]
    assert lines == (
        []
        if status == 0
        else ["commander: path refused: it leaves the box, see box.radius, box.below and box.above"]
    )


def test_landing_to_the_ground_is_refused_and_the_goal_stays(boxed: Flyer) -> None:
    boxed.order(boxed.commander.takeoff, 1.2, 1.0)
    boxed.wait(1.2)
    assert boxed.order(boxed.commander.land, 0.0, 2.0) == ENOEXEC
    boxed.wait(2.5)
    assert boxed.goal() == pytest.approx([0.0, 0.0, 1.2], abs=1e-3)


def test_path_that_swings_out_of_the_box_in_between_is_refused(boxed: Flyer) -> None:
    swing = Poly4D.Poly([0.0, 0.4, -0.2] + [0.0] * 5)  # x: 0, 0.2 after 1 s, 0 after 2 s
    still, height = Poly4D.Poly([0.0] * 8), Poly4D.Poly([1.15] + [0.0] * 7)
    boxed.upload(Poly4D(2.0, swing, still, height, still).pack())
    assert boxed.order(boxed.commander.define_trajectory, 1, 0, 1) == 0
    assert boxed.order(boxed.commander.start_trajectory, 1) == ENOEXEC


def test_robot_that_was_pushed_out_of_the_box_may_return(boxed: Flyer) -> None:
    boxed.place = (0.3, 0.0, 1.15)
    boxed.wait(0.1)
    assert boxed.order(boxed.commander.go_to, 0.1, 0.0, 1.15, 0.0, 1.0) == 0
    boxed.commander.stop()
    assert boxed.order(boxed.commander.go_to, 0.31, 0.0, 1.15, 0.0, 1.0) == ENOEXEC


@pytest.mark.parametrize("place", [(0.0, 0.0, 1.1), (0.95, 0.0, 0.0), (0.7, 0.7, 0.0), (0.0, 0.0, -2.1)])
def test_an_impossible_correction_only_reports(relative: Flyer, place: tuple[float, float, float]) -> None:
    before = relative.estimate()
    relative.place = place
    relative.wait(0.3)
    assert relative.estimate() == pytest.approx(before, abs=1e-3)
    lines = [line for line in relative.console if "extPose.absolute" in line]
    assert lines == [
        "pose refused: {:.2f} {:.2f} {:.2f} m is no correction; for absolute poses set extPose.absolute 1".format(
            *place
        )
    ]
    assert relative.firmware.signals.counters[COUNTERS.index("invalid")] >= 14


def test_with_corrections_position_set_points_are_refused(relative: Flyer) -> None:
    relative.post(relative.low_level.send_position_setpoint, 0.0, 0.0, 0.1, 0.0)
    assert relative.console[-1] == (
        "commander: position set-points are not flown, poses are corrections, see extPose.absolute"
    )
    assert relative.goal() == [0.0, 0.0, 0.0]


def send_full_state(flyer: Flyer, x: float, y: float, z: float, yaw_deg: float) -> None:
    q = Rotation.from_euler("z", yaw_deg, degrees=True).as_quat().tolist()
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


def test_a_stream_of_set_points_that_falls_silent_for_two_seconds_locks_the_board(absolute: Flyer) -> None:
    for _ in range(5):
        send_position(absolute, *HERE, 0.0)
        absolute.wait(0.1)
    absolute.wait(1.88)
    assert absolute.state == "FLYING"
    absolute.wait(0.03)
    assert absolute.firmware.signals.supervisor.locked


@pytest.mark.parametrize("end", ["notice", "high level", "stop"])
def test_a_stream_of_set_points_may_end_in_words(absolute: Flyer, end: str) -> None:
    send_position(absolute, *HERE, 0.0)
    absolute.wait(0.1)
    if end == "notice":
        absolute.post(absolute.low_level.send_notify_setpoint_stop)
    elif end == "stop":
        absolute.post(absolute.low_level.send_stop_setpoint)
    else:
        assert absolute.order(absolute.commander.go_to, *HERE, 0.0, 1.0) == 0
    absolute.wait(3.0)
    assert absolute.state == ("WAITING" if end == "stop" else "FLYING")


ACTIVE, FINISHED, OVERRULED = "hl_control_active", "hl_traj_finished", "hl_control_disabled"


def told_of_the_commander(flyer: Flyer) -> set[str]:
    """As cflib's supervisor reads the bits, all at once and one by one."""
    flyer.wait(0.02)
    bits = int.from_bytes(flyer.one(SUPERVISOR, 0, b"\x0c")[1:], "little")
    assert [flyer.one(SUPERVISOR, 0, bytes((n,))) for n in range(1, 12)] == [
        bytes((0x80 | n, bits >> n - 1 & 1)) for n in range(1, 12)
    ]
    assert flyer.log(flyer.logs, "supervisor.info") == [bits]
    names = {
        BIT_HL_CONTROL_ACTIVE: ACTIVE,
        BIT_HL_TRAJ_FINISHED: FINISHED,
        BIT_HL_CONTROL_DISABLED: OVERRULED,
    }
    return {name for bit, name in names.items() if bits >> bit & 1}


def test_the_supervisor_reports_the_commander_s_state(absolute: Flyer) -> None:
    assert told_of_the_commander(absolute) == {FINISHED}
    absolute.order(absolute.commander.takeoff, 1.5, 1.0)
    assert told_of_the_commander(absolute) == {ACTIVE}
    absolute.wait(1.0)
    assert told_of_the_commander(absolute) == {ACTIVE, FINISHED}
    send_position(absolute, *HERE, 0.0)
    assert told_of_the_commander(absolute) == {FINISHED, OVERRULED}
    absolute.post(absolute.low_level.send_notify_setpoint_stop)
    absolute.order(absolute.commander.land, 1.0, 0.2)
    assert told_of_the_commander(absolute) == {ACTIVE}
    absolute.wait(0.3)
    assert told_of_the_commander(absolute) == {FINISHED}


def test_the_kind_of_poses_survives_a_reboot(absolute: Flyer) -> None:
    assert (
        absolute.one(PARAM, 3, b"\x03" + struct.pack("<H", absolute.params["extPose.absolute"][0]))[3:]
        == b"\0"
    )
    absolute.reboot()
    assert absolute.read(absolute.params, "extPose.absolute") == 1
