"""The built-in ground station of a served robot: poses on a link hidden from its clients, who have the telemetry."""

from collections.abc import Sequence

from firmware_py.wire.parameters import SetByName, encode_pose_kind, encode_set_by_name
from firmware_py.wire.telemetry import Sample
from ground_station.links.loopback import LoopbackLink
from ground_station.mocap import MocapFrame
from ground_station.station import GroundStation
from ground_station.tracker import tracker_of
from ground_station.trajectory import Goal, Hold
from hil.board.board_firmware import BoardFirmware
from hil.laboratory.robot import Robot

STARTED_US = (
    4_000_000  # after a restart: the stock firmware takes packets once it has tested itself, after 3.1 s
)
WORLD = Goal((0.0, 0.0, 0.0), 0.0)  # relative to this goal a pose is absolute


class HiddenLink:
    """Sends poses if the profile has them, and what a booted board lacks of its settings."""

    def __init__(self, robot: Robot, absolute: bool) -> None:
        self._robot, self._absolute = robot, absolute
        self._poses = LoopbackLink(self._transmit, robot.config.station.link_latency_us, dict)
        self.latency = self._poses.latency
        self._set_up: BoardFirmware | None = None  # the last boot with the profile's parameters

    def send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        if self._robot.config.pilot.poses:
            self._poses.send(now_us, frame, goal)

    def start_telemetry(self, now_us: int) -> None:
        """Send settings instead: the kind of poses or, once per boot, the parameters of the Crazyflie's own firmware."""
        robot, pilot = self._robot, self._robot.config.pilot
        if not pilot.enabled:  # a booted image begins with absolute poses
            self._transmit(now_us, encode_pose_kind(self._absolute))
            return
        starts = robot.booted_us and now_us - robot.booted_us < STARTED_US
        if robot.firmware is self._set_up or robot.firmware.flashed is None or starts:
            return
        self._set_up, table = robot.firmware, robot.firmware.flashed.parameters
        for name, value in pilot.values.items():
            self._transmit(now_us, encode_set_by_name(SetByName(name, table[name].scalar, value)))

    def receive(self, now_us: int, data: bytes) -> Sequence[Sample]:
        """Return nothing."""
        return ()

    def _transmit(self, now_us: int, data: bytes) -> None:
        robot = self._robot
        robot.events.at(now_us + self.latency.us, lambda now_us: robot.packet_received(now_us, data))


def fly_built_in(robot: Robot, absolute: bool = False) -> None:
    """Fly a robot by corrections for home, or by absolute poses, with which its clients set the goal."""
    config = robot.config
    goal = Hold(WORLD if absolute else Goal(config.flight.home, 0.0))
    tracker = tracker_of(config.tracker, config.mocap.period_us)
    ground = GroundStation(HiddenLink(robot, absolute), goal, None, config.station, tracker)
    robot.seen_by(lambda frame, now_us, _: ground.on_frame(frame, now_us))
