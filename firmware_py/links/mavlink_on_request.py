"""Messages for the programs of others, seldom or not at all until they ask with SET_MESSAGE_INTERVAL or REQUEST_MESSAGE."""

from collections.abc import Callable, Sequence

from firmware_py.config import StreamRates
from firmware_py.core.structs import Control
from firmware_py.geometry import Vector, conjugate, rotate
from firmware_py.links.mavlink_stack import MavlinkStack
from firmware_py.links.mavlink_streams import Stream, interval_of
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

    def __init__(
        self,
        stack: MavlinkStack,
        supervisor: Supervisor,
        world: World,
        control: Control,
        read_imu: ReadImu,
        home: Vector,
    ) -> None:
        self._supervisor = supervisor
        self._world = world
        self._control = control
        self._read_imu = read_imu
        self._home = home
        self._unix_ahead_us: int | None = None  # of the board's own clock
        self._kernel = stack.kernel
        stack.handle(mavlink.MSG_SYSTEM_TIME, self._see_time)

    def streams(self, rates: StreamRates) -> tuple[Stream, ...]:
        """Return them as streams with their intervals after boot."""
        return tuple(
            Stream(number, interval_of(rate_hz), make)
            for number, rate_hz, make in (
                (mavlink.MSG_SYSTEM_TIME, rates.system_time, self._system_time),
                (mavlink.MSG_CURRENT_MODE, rates.current_mode, self._mode),
                (mavlink.MSG_POSITION_TARGET_LOCAL_NED, rates.position_target, self._target),
                (mavlink.MSG_VFR_HUD, rates.vfr_hud, self._hud),
                (mavlink.MSG_ACTUATOR_OUTPUT_STATUS, rates.actuator_output, self._actuators),
                (mavlink.MSG_HOME_POSITION, rates.home_position, self._home_position),
                (mavlink.MSG_ODOMETRY, rates.odometry, self._odometry),
                (mavlink.MSG_GLOBAL_POSITION_INT, 0, self._global_position),
                (mavlink.MSG_HIGHRES_IMU, 0, self._imu),
                (mavlink.MSG_AUTOPILOT_VERSION, 0, self._version),
                (mavlink.MSG_EXTENDED_SYS_STATE, 0, self._extended_state),
                (mavlink.MSG_PROTOCOL_VERSION, 0, lambda tick: (mavlink.protocol_version(),)),
            )
        )

    def _see_time(self, message: Message) -> None:
        """Take the time of day from a station that knows it."""
        if message.time_unix_usec:
            self._unix_ahead_us = message.time_unix_usec - self._kernel.now_us

    def _system_time(self, tick: int) -> Messages:
        ahead_us = self._unix_ahead_us
        return (mavlink.system_time(0 if ahead_us is None else tick * 1000 + ahead_us, tick),)

    def _mode(self, tick: int) -> Messages:
        return (mavlink.current_mode(self._world.setpoints.mode),)

    def _target(self, tick: int) -> Messages:
        return (mavlink.position_target(tick, *self._world.setpoints.goal),)

    def _hud(self, tick: int) -> Messages:
        return (mavlink.hud(*self._world.motion(), self._world.angles()[2]),)

    def _actuators(self, tick: int) -> Messages:
        return (mavlink.actuator_outputs(tick * 1000, tuple(self._control.count.tolist())),)

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
