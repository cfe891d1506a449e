"""Messages that are sent only on request: at an interval with SET_MESSAGE_INTERVAL, once with REQUEST_MESSAGE."""

from collections.abc import Callable, Sequence

from firmware_py.geometry import Vector, conjugate, rotate
from firmware_py.links.mavlink_streams import Stream
from firmware_py.links.mavlink_world import World
from firmware_py.supervisor import Supervisor
from firmware_py.wire import mavlink
from firmware_py.wire.mavlink_frames import Message

VERSION = (26, 11, 0)
REVISION = bytes.fromhex("0f10a717")  # the parameters firmware.revision0
SERIAL_NUMBER = 0x00F10A71  # the parameter cpu.id0

Messages = Sequence[Message]
ReadImu = Callable[[], tuple[Vector, Vector]]  # rates [rad/s, B] and acceleration [g, B]


class RequestedMessages:
    """Makes messages from the present values."""

    def __init__(self, supervisor: Supervisor, world: World, read_imu: ReadImu, home: Vector) -> None:
        self._supervisor = supervisor
        self._world = world
        self._read_imu = read_imu
        self._home = home

    def streams(self) -> tuple[Stream, ...]:
        """Return them as streams that are off after boot."""
        return tuple(
            Stream(number, None, make)
            for number, make in (
                (mavlink.MSG_GLOBAL_POSITION_INT, self._global_position),
                (mavlink.MSG_HIGHRES_IMU, self._imu),
                (mavlink.MSG_AUTOPILOT_VERSION, self._version),
                (mavlink.MSG_HOME_POSITION, self._home_position),
                (mavlink.MSG_EXTENDED_SYS_STATE, self._extended_state),
                (mavlink.MSG_PROTOCOL_VERSION, lambda tick: (mavlink.protocol_version(),)),
                (mavlink.MSG_ODOMETRY, self._odometry),
            )
        )

    def _global_position(self, tick: int) -> Messages:
        yaw = self._world.angles()[2]
        return (mavlink.global_position(tick, *self._world.motion(), yaw, self._home[2]),)

    def _imu(self, tick: int) -> Messages:
        return (mavlink.imu(tick * 1000, *self._read_imu()),)

    def _version(self, tick: int) -> Messages:
        return (mavlink.autopilot_version(VERSION, REVISION, SERIAL_NUMBER),)

    def _home_position(self, tick: int) -> Messages:
        return (mavlink.home_position(tick * 1000, self._home),)

    def _extended_state(self, tick: int) -> Messages:
        return (mavlink.extended_state(self._supervisor.state),)

    def _odometry(self, tick: int) -> Messages:
        world = self._world
        (p_WB, v_W), q_WB = world.motion(), world.q_WB()
        v_B = rotate(conjugate(q_WB), v_W)
        return (mavlink.odometry(tick * 1000, p_WB, q_WB, v_B, world.rates()),)
