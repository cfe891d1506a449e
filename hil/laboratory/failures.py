"""MAVLink's artificial failures as faults: which kind lets which unit fail how, and what is answered.

A failure lasts until its unit is told to be OK, and takes the place of the one before, so that a command which comes twice
acts once. Instance 0 stands for all of a unit; flaps are 1 to 4, of everything else there is one.
"""

from __future__ import annotations

import math
from functools import partial

from firmware_py.wire.mavlink_numbers import Failing, Result, Unit
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import Fault, Switchboard, why_not
from hil.laboratory.robot import Robot

FLAPS = 4
ANSWER_US = 100_000  # a line is cut after the answer has passed, and ...
DEAF_S = 3.0  # ... heals by itself: nobody could tell it to be OK
CUT = "serial.cut"

Ways = dict[
    Failing, tuple[str, ...]
]  # the kinds of faults that each stands for, {} for the number of the flap
# The IMU is one part: its gyro does not fail alone.
_IMU: Ways = {Failing.STUCK: ("imu.freeze",), Failing.GARBAGE: ("imu.noise",)}
_FLAP: Ways = {
    Failing.STUCK: ("servo.stuck.{}",),
    Failing.WRONG: ("servo.trim.{}",),
    Failing.SLOW: ("servo.slow.{}",),
}
TABLE: dict[Unit, Ways] = {
    Unit.GYRO: {**_IMU, Failing.WRONG: ("imu.bias.p", "imu.bias.q", "imu.bias.r")},
    Unit.ACCELEROMETER: _IMU,
    Unit.POSES: {
        Failing.OFF: ("mocap.dropout",),
        Failing.GARBAGE: ("mocap.outlier",),
        Failing.WRONG: ("mocap.swap",),
        Failing.DELAYED: ("mocap.latency",),
        Failing.INTERMITTENT: ("mocap.dropout",),
    },
    Unit.BATTERY: {Failing.OFF: ("battery.sag",)},
    Unit.MOTOR: _FLAP,  # a Floaty has no other motors than its servos
    Unit.SERVO: _FLAP,
    Unit.SIGNAL: {Failing.OFF: (CUT,), Failing.GARBAGE: ("serial.bit_errors",)},
}
SIZES = {(Unit.POSES, Failing.INTERMITTENT): 0.5}  # every other frame


class Failures:
    """Lets the faults of a robot act; `inject` is what its board asks."""

    def __init__(self, robot: Robot, switchboard: Switchboard) -> None:
        self._robot = robot
        self._switchboard = switchboard

    def inject(self, now_us: int, unit: int, failing: int, instance: int) -> Result:
        """Plan what the numbers mean for the present instant."""
        if unit not in TABLE or failing not in (Failing.OK, *TABLE[Unit(unit)]):
            return Result.UNSUPPORTED
        ways = TABLE[Unit(unit)]
        count = FLAPS if ways is _FLAP else 1
        if not 0 <= instance <= count:
            return Result.DENIED
        instances = (instance,) if instance else tuple(range(1, count + 1))
        size = SIZES.get((Unit(unit), Failing(failing)))
        begin = [_fault(name, size) for name in _names(ways.get(Failing(failing), ()), instances)]
        if any(why_not(KINDS[fault.kind], self._robot) for fault in begin):
            return Result.UNSUPPORTED
        end = {name for names in ways.values() for name in _names(names, instances)}
        delay_us = ANSWER_US if any(fault.kind == CUT for fault in begin) else 0
        self._robot.events.at(now_us + delay_us, partial(self._switch, end, begin))
        return Result.ACCEPTED

    def _switch(self, end: set[str], begin: list[Fault], now_us: int) -> None:
        """End the faults of these kinds, and let others begin."""
        for fault in self._switchboard.active.copy():
            if fault.kind in end:
                self._switchboard.end(fault, now_us)
        for fault in begin:
            self._switchboard.act(fault, now_us)


def _names(names: tuple[str, ...], instances: tuple[int, ...]) -> list[str]:
    return sorted({name.format(instance) for name in names for instance in instances})


def _fault(name: str, size: float | None) -> Fault:
    duration_s = DEAF_S if name == CUT else math.inf
    return Fault(name, 0.0, duration_s, KINDS[name].size if size is None else size)
