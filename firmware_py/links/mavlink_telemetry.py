"""What the streams carry: the running board's values as messages, with the tick as time stamp.

Our own ground station takes the flight array: the telemetry blocks as the board knows them, relative to the goal that the
last pose was seen from. For other stations the standard's messages are absolute in W.
"""

from collections.abc import Sequence
from math import sqrt

from firmware_py.config import StreamRates
from firmware_py.core.structs import POSITION, Control
from firmware_py.links.log import LogVariable
from firmware_py.links.mavlink_poses import PoseService
from firmware_py.links.mavlink_stack import MavlinkStack
from firmware_py.links.mavlink_streams import Stream, interval_of
from firmware_py.links.mavlink_world import World
from firmware_py.rtos.statistics import Load
from firmware_py.supervisor import Supervisor
from firmware_py.wire import mavlink, telemetry
from firmware_py.wire.mavlink_frames import Message

UNKNOWN_AGE = -1.0
Messages = Sequence[Message]


class FlightMessages:
    """Makes messages from the present values; `variables` is the log table."""

    def __init__(
        self,
        stack: MavlinkStack,
        supervisor: Supervisor,
        world: World,
        poses: PoseService,
        control: Control,
        variables: Sequence[LogVariable],
    ) -> None:
        self._stack = stack
        self._supervisor = supervisor
        self._world = world
        self._poses = poses
        self._control = control
        read = {variable.name: variable.read for variable in variables}
        self._blocks = [(block, [read[item.name] for item in block.variables]) for block in telemetry.BLOCKS]
        self._load = Load(stack.kernel)

    def streams(self, rates: StreamRates) -> tuple[Stream, ...]:
        """Return all streams with their intervals after boot."""
        return tuple(
            Stream(number, interval_of(rate_hz), make)
            for number, rate_hz, make in (
                (mavlink.MSG_HEARTBEAT, rates.heartbeat, self._heartbeat),
                (mavlink.MSG_ATTITUDE, rates.attitude, self._attitude),
                (mavlink.MSG_ATTITUDE_QUATERNION, rates.attitude_quaternion, self._attitude_quaternion),
                (mavlink.MSG_LOCAL_POSITION_NED, rates.local_position, self._local_position),
                (mavlink.MSG_DEBUG_FLOAT_ARRAY, rates.flight_array, self._flight_array),
                (mavlink.MSG_SERVO_OUTPUT_RAW, rates.servo_output, self._servo_outputs),
                (mavlink.MSG_ESTIMATOR_STATUS, rates.estimator_status, self._estimator_status),
                (mavlink.MSG_SYS_STATUS, rates.sys_status, self._sys_status),
                (mavlink.MSG_BATTERY_STATUS, rates.battery_status, self._battery),
                (mavlink.MSG_NAMED_VALUE_FLOAT, rates.named_values, self._named_values),
            )
        )

    def _heartbeat(self, tick: int) -> Messages:
        supervisor, mode = self._supervisor, self._world.setpoints.mode
        return (mavlink.heartbeat(supervisor.controlling, supervisor.state, mode),)

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
        return (mavlink.servo_outputs(tick * 1000, tuple(self._control.count.tolist())),)

    def _estimator_status(self, tick: int) -> Messages:
        healthy = self._supervisor.has_recent_pose
        x, y, z = self._world.estimator.P.diagonal()[POSITION : POSITION + 3].tolist()
        return (mavlink.estimator_status(tick * 1000, healthy, sqrt(max(0.0, x, y)), sqrt(max(0.0, z))),)

    def _sys_status(self, tick: int) -> Messages:
        counters = self._stack.counters
        drop_rate = counters.lost / max(1, counters.frames + counters.lost)
        errors = self._stack.bad + self._stack.refused + self._stack.overruns
        alive = not self._supervisor.imu_is_stale
        return (mavlink.sys_status(self._supervisor.battery_mv, drop_rate, errors, self._load(), alive),)

    def _battery(self, tick: int) -> Messages:
        return (mavlink.battery(self._supervisor.battery_mv),)

    def _named_values(self, tick: int) -> Messages:
        age_us = self._poses.age_us
        return tuple(
            mavlink.named_value(tick, name, value)
            for name, value in (
                ("age_ms", UNKNOWN_AGE if age_us is None else age_us * 1e-3),
                ("refused", int(self._world.estimator.refused)),
                ("up_lost", self._stack.counters.lost),
                ("tx_dropped", self._stack.dropped),
                ("overruns", self._stack.overruns),
            )
        )
