"""The content of the streams: the running board's values as messages, with the tick as time stamp.

Our own ground station takes the flight array: the telemetry blocks as on board, relative to the goal of the
last pose. For other stations the standard's messages are absolute in W (`PoseInWorld`); those of rate 0 are
sent only on SET_MESSAGE_INTERVAL or REQUEST_MESSAGE.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import sqrt

from firmware_py.config import StreamRates
from firmware_py.core.structs import ATTITUDE, POSITION, RATE, VELOCITY, Control, Estimator
from firmware_py.geometry import (
    Quaternion,
    Vector,
    conjugate,
    from_euler_zyx,
    rotate,
    wrap_angle,
    yaw_quaternion,
)
from firmware_py.links.log import LogVariable
from firmware_py.links.mavlink_poses import PoseService
from firmware_py.links.mavlink_setpoints import SetpointService
from firmware_py.links.mavlink_stack import MavlinkStack
from firmware_py.links.mavlink_streams import Stream, interval_of
from firmware_py.rtos.statistics import ProcessorLoad
from firmware_py.signals import REFUSED
from firmware_py.supervisor import CoreSupervisor
from firmware_py.wire import WireError, mavlink, telemetry
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.mavlink_dialect import Message


@dataclass(frozen=True, slots=True)
class PoseInWorld:
    """The robot's present pose in W; the estimator has only the error from the goal of the last pose."""

    estimator: Estimator
    control: Control
    setpoints: SetpointService

    def angles(self) -> Vector:
        """Return roll, pitch, yaw of B in W."""
        roll, pitch, yaw = self.estimator.now[ATTITUDE : ATTITUDE + 3].tolist()
        return roll, pitch, wrap_angle(yaw + self.setpoints.frame[1])

    def q_WB(self) -> Quaternion:
        """Return the attitude."""
        return from_euler_zyx(*self.angles())

    def rates(self) -> Vector:
        """Return the body rates p, q, r [rad/s]."""
        p, q, r = self.estimator.now[RATE : RATE + 3].tolist()
        return p, q, r

    def motion(self) -> tuple[Vector, Vector]:
        """Return p_WB [m] and v_W [m/s]."""
        p_WG, yaw = self.setpoints.frame
        q_WG = yaw_quaternion(yaw)
        now = self.estimator.now
        x, y, z = rotate(q_WG, tuple(now[POSITION : POSITION + 3].tolist()))
        v_W = rotate(q_WG, tuple(now[VELOCITY : VELOCITY + 3].tolist()))
        return (p_WG[0] + x, p_WG[1] + y, p_WG[2] + z), v_W


UNKNOWN_AGE = -1.0
VERSION = (26, 11, 0)
REVISION = bytes.fromhex("0f10a717")  # the parameters firmware.revision0
SERIAL_NUMBER = 0x00F10A71  # the parameter cpu.id0

LATEST_US = 7_258_118_400_000_000  # 2200-01-01

Messages = Sequence[Message]
ReadImu = Callable[[], tuple[Vector, Vector]]  # rates [rad/s, B] and acceleration [g, B]


class FlightMessages:
    """Makes messages from the present values; `variables` is the log table."""

    def __init__(
        self,
        stack: MavlinkStack,
        supervisor: CoreSupervisor,
        world: PoseInWorld,
        poses: PoseService,
        variables: Sequence[LogVariable],
        read_imu: ReadImu,
    ) -> None:
        self._stack = stack
        self._supervisor = supervisor
        self._world = world
        self._poses = poses
        self._read_imu = read_imu
        self._unix_ahead_us: int | None = None  # of the board's own clock
        read = {variable.name: variable.read for variable in variables}
        self._blocks = [(block, [read[item.name] for item in block.variables]) for block in telemetry.BLOCKS]
        self._load = ProcessorLoad(stack.kernel)
        stack.handle("SYSTEM_TIME", self._see_time)

    def streams(self, rates: StreamRates) -> tuple[Stream, ...]:
        """Return all streams with their intervals after boot."""
        return tuple(
            Stream(name, interval_of(rate_hz), make)
            for name, rate_hz, make in (
                ("HEARTBEAT", rates.heartbeat, self._heartbeat),
                ("ATTITUDE", rates.attitude, self._attitude),
                ("ATTITUDE_QUATERNION", rates.attitude_quaternion, self._attitude_quaternion),
                ("LOCAL_POSITION_NED", rates.local_position, self._local_position),
                ("DEBUG_FLOAT_ARRAY", rates.flight_array, self._flight_array),
                ("SERVO_OUTPUT_RAW", rates.servo_output, self._servo_outputs),
                ("ESTIMATOR_STATUS", rates.estimator_status, self._estimator_status),
                ("SYS_STATUS", rates.sys_status, self._sys_status),
                ("BATTERY_STATUS", rates.battery_status, self._battery),
                ("NAMED_VALUE_FLOAT", rates.named_values, self._named_values),
                ("SYSTEM_TIME", rates.system_time, self._system_time),
                ("CURRENT_MODE", rates.current_mode, self._mode),
                ("POSITION_TARGET_LOCAL_NED", rates.position_target, self._target),
                ("VFR_HUD", rates.vfr_hud, self._hud),
                ("ACTUATOR_OUTPUT_STATUS", rates.actuator_output, self._actuators),
                ("HOME_POSITION", rates.home_position, self._home_position),
                ("ODOMETRY", rates.odometry, self._odometry),
                ("GLOBAL_POSITION_INT", 0, self._global_position),
                ("HIGHRES_IMU", 0, self._imu),
                ("AUTOPILOT_VERSION", 0, self._version),
                ("EXTENDED_SYS_STATE", 0, self._extended_state),
                ("PROTOCOL_VERSION", 0, lambda tick: (services.protocol_version(),)),
            )
        )

    def _heartbeat(self, tick: int) -> Messages:
        supervisor, mode = self._supervisor, self._world.setpoints.mode
        return (services.heartbeat(supervisor.controlling, supervisor.state, mode),)

    def _attitude(self, tick: int) -> Messages:
        return (mavlink.attitude(tick, *self._world.angles(), *self._world.rates()),)

    def _attitude_quaternion(self, tick: int) -> Messages:
        return (mavlink.attitude_quaternion(tick, self._world.q_WB(), *self._world.rates()),)

    def _local_position(self, tick: int) -> Messages:
        return (mavlink.local_position(tick, *self._world.motion()),)

    def _flight_array(self, tick: int) -> Messages:
        values = [value for block, reads in self._blocks for value in block.si_of([read() for read in reads])]
        return (mavlink.flight_array(tick * 1000, values),)

    def _servo_outputs(self, tick: int) -> Messages:
        return (mavlink.servo_outputs(tick * 1000, tuple(self._world.control.count.tolist())),)

    def _estimator_status(self, tick: int) -> Messages:
        healthy = self._supervisor.has_recent_pose
        x, y, z = self._world.estimator.P.diagonal()[POSITION : POSITION + 3].tolist()
        return (mavlink.estimator_status(tick * 1000, healthy, sqrt(max(0.0, x, y)), sqrt(max(0.0, z))),)

    def _sys_status(self, tick: int) -> Messages:
        counters = self._stack.counters
        drop_rate = counters.lost / max(1, counters.frames + counters.lost)
        errors = counters.bad + self._stack.refused + self._stack.overruns
        alive = not self._supervisor.imu_is_stale
        return (mavlink.sys_status(self._supervisor.battery_mv, drop_rate, errors, self._load(), alive),)

    def _battery(self, tick: int) -> Messages:
        return (mavlink.battery(self._supervisor.battery_mv),)

    def _named_values(self, tick: int) -> Messages:
        age_us, estimator = self._poses.age_us, self._world.estimator
        return tuple(
            services.named_value(tick, name, value)
            for name, value in (
                ("age_ms", UNKNOWN_AGE if age_us is None else age_us * 1e-3),
                ("refused", sum(int(getattr(estimator, name)) for name in REFUSED)),
                ("up_lost", self._stack.counters.lost),
                ("tx_dropped", self._stack.dropped),
                ("overruns", self._stack.overruns),
            )
        )

    def _see_time(self, message: Message) -> None:
        """Take the time of day from a station that knows it."""
        if message.time_unix_usec > LATEST_US:
            raise WireError(f"time of day {message.time_unix_usec} us: after the year 2200")
        if message.time_unix_usec:
            self._unix_ahead_us = message.time_unix_usec - self._stack.kernel.now_us

    def _system_time(self, tick: int) -> Messages:
        ahead_us = self._unix_ahead_us
        return (services.system_time(0 if ahead_us is None else tick * 1000 + ahead_us, tick),)

    def _mode(self, tick: int) -> Messages:
        return (services.current_mode(self._world.setpoints.mode),)

    def _target(self, tick: int) -> Messages:
        return (mavlink.position_target(tick, *self._world.setpoints.goal),)

    def _hud(self, tick: int) -> Messages:
        return (mavlink.hud(*self._world.motion(), self._world.angles()[2]),)

    def _actuators(self, tick: int) -> Messages:
        return (mavlink.actuator_outputs(tick * 1000, tuple(self._world.control.count.tolist())),)

    def _global_position(self, tick: int) -> Messages:
        yaw = self._world.angles()[2]
        return (mavlink.global_position(tick, *self._world.motion(), yaw, self._world.setpoints.home[2]),)

    def _imu(self, tick: int) -> Messages:
        return (mavlink.imu(tick * 1000, *self._read_imu()),)

    def _version(self, tick: int) -> Messages:
        return (services.autopilot_version(VERSION, REVISION, SERIAL_NUMBER),)

    def _home_position(self, tick: int) -> Messages:
        return (mavlink.home_position(tick * 1000, self._world.setpoints.home),)

    def _extended_state(self, tick: int) -> Messages:
        return (services.extended_state(self._supervisor.state),)

    def _odometry(self, tick: int) -> Messages:
        world = self._world
        (p_WB, v_W), q_WB = world.motion(), world.q_WB()
        v_B = rotate(conjugate(q_WB), v_W)
        return (mavlink.odometry(tick * 1000, p_WB, q_WB, v_B, world.rates()),)
