"""MAVLink's artificial failures as faults: the kinds of faults for each unit and failure, and the answers.

A failure lasts until its unit is set to OK, and replaces the previous one, so that a repeated command acts once. Instance
0 means all instances of a unit; a body's actuators count from 1, every other unit has one instance.
"""

import math
from fnmatch import fnmatchcase
from functools import partial

from firmware_py.wire.mavlink_numbers import CommandResult, Failing, Unit
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import Fault, Switchboard, why_not
from hil.laboratory.robot import Robot

ANSWER_US = 100_000  # a line is cut after the answer has been sent, and ...
DEAF_S = 3.0  # ... restored by itself: no command could set it to OK
CUT = "serial.cut"

# The kinds of faults for each failure; * means the actuators of the robot's body, {} the number of one.
KindsByFailing = dict[Failing, tuple[str, ...]]
# The IMU is one part: its gyro cannot fail alone.
_IMU: KindsByFailing = {
    Failing.OFF: ("imu.silent",),
    Failing.STUCK: ("imu.freeze",),
    Failing.GARBAGE: ("imu.noise",),
}
_ACTUATOR: KindsByFailing = {
    Failing.OFF: ("*.stop.{}",),
    Failing.STUCK: ("*.stuck.{}",),
    Failing.WRONG: ("*.trim.{}",),
    Failing.SLOW: ("*.slow.{}",),
}
TABLE: dict[Unit, KindsByFailing] = {
    Unit.GYRO: {**_IMU, Failing.WRONG: ("imu.bias.p", "imu.bias.q", "imu.bias.r")},
    Unit.ACCELEROMETER: _IMU,
    Unit.POSES: {
        Failing.OFF: ("mocap.dropout",),
        Failing.STUCK: ("mocap.freeze",),
        Failing.GARBAGE: ("mocap.outlier",),
        Failing.WRONG: ("mocap.swap",),
        Failing.DELAYED: ("mocap.latency",),
        Failing.INTERMITTENT: ("mocap.dropout",),
    },
    Unit.BATTERY: {Failing.OFF: ("battery.sag",)},
    Unit.MOTOR: _ACTUATOR,  # a Floaty has no other motors than its servos
    Unit.SERVO: _ACTUATOR,
    Unit.SIGNAL: {Failing.OFF: (CUT,), Failing.GARBAGE: ("serial.bit_errors",)},
}
SIZES = {(Unit.POSES, Failing.INTERMITTENT): 0.5}  # every other frame


class Failures:
    """Injects faults into a robot; `inject` is called by its board."""

    def __init__(self, robot: Robot, switchboard: Switchboard) -> None:
        self._robot = robot
        self._switchboard = switchboard

    def inject(self, now_us: int, unit: int, failing: int, instance: int) -> CommandResult:
        """Plan the fault of these numbers for the current instant."""
        if unit not in TABLE or failing not in (Failing.OK, *TABLE[Unit(unit)]):
            return CommandResult.UNSUPPORTED
        kinds = TABLE[Unit(unit)]
        count = len(self._robot.body.outputs) if kinds is _ACTUATOR else 1
        if not 0 <= instance <= count:
            return CommandResult.DENIED
        instances = (instance,) if instance else tuple(range(1, count + 1))
        size = SIZES.get((Unit(unit), Failing(failing)))
        begin = [_fault(name, size) for name in self._names(kinds.get(Failing(failing), ()), instances)]
        none = failing != Failing.OK and not begin
        if none or any(why_not(KINDS[fault.kind], self._robot.links, self._robot.config) for fault in begin):
            return CommandResult.UNSUPPORTED
        end = {name for names in kinds.values() for name in self._names(names, instances)}
        delay_us = ANSWER_US if any(fault.kind == CUT for fault in begin) else 0
        self._robot.events.at(now_us + delay_us, partial(self._switch, end, begin))
        return CommandResult.ACCEPTED

    def _names(self, patterns: tuple[str, ...], instances: tuple[int, ...]) -> list[str]:
        own = [name for name, kind in KINDS.items() if kind.acts_on(self._robot.config.robot.body)]
        wanted = [pattern.format(instance) for pattern in patterns for instance in instances]
        return sorted({name for name in own for pattern in wanted if fnmatchcase(name, pattern)})

    def _switch(self, end: set[str], begin: list[Fault], now_us: int) -> None:
        """End the faults of these kinds and begin others."""
        for fault in self._switchboard.active.copy():
            if fault.kind in end:
                self._switchboard.end(fault, now_us)
        for fault in begin:
            self._switchboard.act(fault, now_us)


def _fault(name: str, size: float | None) -> Fault:
    duration_s = DEAF_S if name == CUT else math.inf
    return Fault(name, 0.0, duration_s, KINDS[name].size if size is None else size)
