"""MAV_CMD_INJECT_FAILURE at a served board: what each unit and type does, and what is answered to all others."""

import math

import pytest

from firmware_py.wire.memories import CONFIG_SIZE, RadioSettings, encode_config
from hil.config import load_config
from hil.emulator.events import EventQueue
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import Switchboard, parse
from hil.laboratory.robot import Ports, Robot, Site, Streams, nobody_listens
from hil.servers.failures import Failures
from support.mavlink_lab import MavlinkLab

INJECT = 420
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
OK, OFF, STUCK, GARBAGE, WRONG, SLOW, DELAYED, INTERMITTENT = range(8)  # FAILURE_TYPE
GYRO, ACCEL, VIO, BATTERY, MOTOR, SERVO, SIGNAL = 0, 1, 6, 100, 101, 102, 105  # FAILURE_UNIT
EXPECTED: dict[tuple[int, int], list[str]] = {
    **{(unit, OFF): ["imu.silent"] for unit in (GYRO, ACCEL)},
    **{(unit, STUCK): ["imu.freeze"] for unit in (GYRO, ACCEL)},
    **{(unit, GARBAGE): ["imu.noise"] for unit in (GYRO, ACCEL)},
    (GYRO, WRONG): ["imu.bias.p", "imu.bias.q", "imu.bias.r"],
    (VIO, OFF): ["mocap.dropout"],
    (VIO, STUCK): ["mocap.freeze"],
    (VIO, GARBAGE): ["mocap.outlier"],
    (VIO, WRONG): ["mocap.swap"],
    (VIO, DELAYED): ["mocap.latency"],
    (VIO, INTERMITTENT): ["mocap.dropout"],
    (BATTERY, OFF): ["battery.sag"],
    **{
        (unit, failing): [f"servo.{name}.{flap}" for flap in (1, 2, 3, 4)]
        for unit in (MOTOR, SERVO)
        for failing, name in ((STUCK, "stuck"), (WRONG, "trim"), (SLOW, "slow"))
    },
    (SIGNAL, GARBAGE): ["serial.bit_errors"],
}


@pytest.fixture(scope="module")
def held() -> MavlinkLab:
    return MavlinkLab()


@pytest.fixture
def lab(held: MavlinkLab) -> MavlinkLab:
    """The robot in its holder, with nothing wrong."""
    assert held.faults == {}
    return held


@pytest.mark.long
@pytest.mark.parametrize(("unit", "failing"), EXPECTED)
def test_a_unit_fails_as_commanded_until_ok(lab: MavlinkLab, unit: int, failing: int) -> None:
    assert lab.command(INJECT, unit, failing) == ACCEPTED
    lab.run(3.5)
    size = {(VIO, INTERMITTENT): 0.5}.get((unit, failing))
    assert lab.faults == {kind: size or KINDS[kind].size for kind in EXPECTED[unit, failing]}
    assert lab.command(INJECT, unit, OK) == ACCEPTED
    assert lab.faults == {}


@pytest.mark.long
@pytest.mark.parametrize("unit", [*range(10), 99, *range(100, 107), -1, 0.5, math.nan])
def test_unknown_failures_are_unsupported(lab: MavlinkLab, unit: float) -> None:
    for failing in (OFF, STUCK, GARBAGE, WRONG, SLOW, DELAYED, INTERMITTENT, 8, -1, math.nan):
        if (unit, failing) not in EXPECTED and (unit, failing) != (SIGNAL, OFF):
            assert lab.command(INJECT, unit, failing) == UNSUPPORTED
    assert lab.faults == {}


def test_one_flap_of_four_fails(lab: MavlinkLab) -> None:
    assert lab.command(INJECT, SERVO, STUCK, 2) == ACCEPTED
    assert lab.command(INJECT, SERVO, SLOW, 4) == ACCEPTED
    assert lab.faults == {"servo.stuck.2": 0.0, "servo.slow.4": 0.5}
    assert lab.command(INJECT, SERVO, OK, 2) == ACCEPTED
    assert lab.faults == {"servo.slow.4": 0.5}
    assert lab.command(INJECT, SERVO, OK, math.nan) == ACCEPTED  # unused: all of them
    assert lab.faults == {}


@pytest.mark.parametrize(
    ("unit", "instance"), [(SERVO, 5), (SERVO, -1), (SERVO, 1.5), (GYRO, 2), (BATTERY, math.inf)]
)
def test_an_instance_that_is_not_there_is_denied(lab: MavlinkLab, unit: int, instance: float) -> None:
    failing = OFF if unit == BATTERY else STUCK
    assert lab.command(INJECT, unit, failing, instance) == DENIED
    assert lab.faults == {}


def test_another_bodys_motors_fail_instead() -> None:
    events = EventQueue()
    site = Site(load_config("crazyflie"), events, Streams.of_seed(1), lambda *_: None)
    robot = Robot(site, Ports(nobody_listens))
    board = Switchboard(robot)
    failures = Failures(robot, board)
    assert failures.inject(0, MOTOR, SLOW, 0) == UNSUPPORTED
    assert failures.inject(0, MOTOR, OFF, 2) == ACCEPTED
    assert failures.inject(0, MOTOR, OFF, 5) == DENIED
    events.run(0)
    assert [fault.kind for fault in board.active] == ["motor.stop.2"]
    assert robot.body.settings["motor.current.2"].read() == 0.0


def test_a_fault_that_begins_twice_acts_twice_and_ends_twice() -> None:
    events = EventQueue()
    robot = Robot(Site(load_config(), events, Streams.of_seed(1), lambda *_: None), Ports(nobody_listens))
    board, fault = Switchboard(robot), parse("imu.bias.p:1=5", live=True)
    seen = []
    for now_us in range(0, 1_600_001, 200_000):
        events.run(now_us)
        if now_us in (0, 400_000):
            board.act(fault, now_us)
        seen.append((len(board.active), round(math.degrees(robot.imu.rate_bias[0]))))
    assert seen == [(1, 5)] * 2 + [(2, 10)] * 3 + [(1, 5)] * 2 + [(0, 0)] * 2
    robot.imu.set_rate_bias(0.01, 0.0, 0.0)  # what a later fault begins from
    board.act(fault, 1_600_000)
    assert robot.imu.rate_bias[0] == pytest.approx(0.01 + math.radians(5.0))
    board.end(fault, 1_600_000)
    assert robot.imu.rate_bias[0] == pytest.approx(0.01)


def test_a_command_that_comes_twice_acts_once_and_another_takes_its_place(lab: MavlinkLab) -> None:
    for _ in range(2):
        assert lab.command(INJECT, GYRO, WRONG) == ACCEPTED
        assert lab.robot.imu.rate_bias == pytest.approx([math.radians(5.0)] * 3)
    lab.command(INJECT, GYRO, STUCK)
    assert lab.faults == {"imu.freeze": 1.0}
    assert lab.robot.imu.rate_bias == pytest.approx([0.0] * 3)
    lab.command(INJECT, GYRO, OK)


@pytest.mark.long
def test_a_line_is_cut_after_the_answer_and_heals_by_itself(lab: MavlinkLab) -> None:
    assert lab.command(INJECT, SIGNAL, OFF) == ACCEPTED
    lab.run(0.1)
    assert lab.faults == {"serial.cut": 0.0}
    lab.messages.clear()
    assert lab.command(INJECT, SIGNAL, OK) is None
    lab.run(2.8)
    assert lab.messages == []
    lab.run(1.3)
    assert lab.faults == {}
    assert lab.of("HEARTBEAT")


@pytest.mark.long
def test_a_flight_without_poses_ends_in_failsafe_and_goes_on_with_them() -> None:
    lab = MavlinkLab(flying=True)
    lab.run(2.0)
    assert lab.armed()
    assert lab.command(INJECT, VIO, OFF) == ACCEPTED
    assert not lab.armed()
    assert lab.command(INJECT, VIO, OK) == ACCEPTED
    assert lab.armed()


# Reboot


@pytest.mark.long
def test_a_reboot_ends_the_emergency_stop_and_nothing_else_does() -> None:
    lab = MavlinkLab(flying=True)
    lab.run(2.0)
    assert lab.armed()
    lab.robot.board.eeprom[:CONFIG_SIZE] = encode_config(RadioSettings(channel=90))
    assert lab.command(185, 1) == ACCEPTED  # flight termination
    assert not lab.armed()
    assert lab.command(400, 1) == 1
    assert lab.texts() == ["not armed: emergency stop; reboot first"]
    before, booted_us = lab.robot.firmware, lab.robot.booted_us
    assert lab.command(246, 1) == ACCEPTED
    asked_us = lab.now_us
    lab.run(1.5)
    assert lab.robot.firmware is not before
    assert booted_us < asked_us < lab.robot.booted_us < asked_us + 200_000
    assert sum("reset" in line for line in lab.said) == 1
    assert lab.served.nrf51.settings.channel == 90  # as after every boot
    assert lab.command(400, 1) == ACCEPTED
    lab.run(3.0)  # it is lost, for its gyro finds no zero in the air, and put back
    assert lab.armed()
