"""The failsafe on board: every cause leads to the hover angles, is announced, and ends only as documented."""

import struct
from collections.abc import Callable
from itertools import pairwise
from types import SimpleNamespace

import pytest

from firmware_py.core.structs import MODE_FLY, MODE_HOVER, MODE_MANUAL
from firmware_py.links.platform import supervisor_bits
from firmware_py.supervisor import Manual, Supervisor
from firmware_py.wire import crtp
from firmware_py.wire.supervisor import Cause, State
from hil.config import load_config
from support.crtp_client import LOC, LOG, PARAM, SUPERVISOR, CrtpClient
from support.firmware_bench import HOVER_COUNTS, LEVEL
from support.mavlink_client import MavlinkClient

OFF_CENTRE = (0.0, 0.04, 0.02)


@pytest.fixture
def flying() -> CrtpClient:
    """A board that flies at 1 s and gets poses until 20 s."""
    client = CrtpClient()
    client.poses(605_000, 20_000_000, OFF_CENTRE)
    client.run(1_000_000)
    assert state(client) == (State.FLYING, Cause.NONE)
    assert client.writes[-1][1] != HOVER_COUNTS
    client.console.clear()
    return client


def state(client: CrtpClient) -> tuple[State, Cause]:
    supervisor = client.firmware.signals.supervisor
    return supervisor.state, supervisor.cause


def after(client: CrtpClient, wait_us: int) -> tuple[State, Cause]:
    client.run(client.now_us + wait_us)
    return state(client)


def stop(client: CrtpClient) -> None:
    client.send(LOC, 1, b"\3")


def stop_on_the_supervisors_port(client: CrtpClient) -> None:
    client.send(SUPERVISOR, 1, b"\3")


def stop_by_parameter(client: CrtpClient) -> None:
    write(client, "stabilizer.stop", 1)


def stop_by_floatys_own_parameter(client: CrtpClient) -> None:
    write(client, "floaty.stop", 1)


def write(client: CrtpClient, name: str, value: int) -> None:
    """Write a parameter of one byte by its name."""
    group, own = name.encode().split(b".")
    client.send(PARAM, 3, b"\0" + group + b"\0" + own + b"\0\x08" + bytes((value,)))


def let_watchdog_bite(client: CrtpClient) -> None:
    client.send(LOC, 1, b"\4")
    client.run(client.now_us + 1_000_000)


STOPS = (stop, stop_on_the_supervisors_port, stop_by_parameter, let_watchdog_bite)


@pytest.mark.parametrize("stop", [*STOPS, stop_by_floatys_own_parameter])
def test_emergency_stop_acts_within_eleven_milliseconds(flying: CrtpClient, stop) -> None:
    stop(flying)
    assert after(flying, 11_000) == (State.FAILSAFE, Cause.EMERGENCY_STOP)
    assert flying.writes[-1][1] == HOVER_COUNTS
    assert flying.console == ["supervisor: failsafe, emergency stop"]
    assert after(flying, 3_000_000)[1] is Cause.EMERGENCY_STOP
    assert flying.one(SUPERVISOR, 1, b"\1\1") == b"\x81\0\1"  # arming is refused


@pytest.mark.parametrize("stop", STOPS)
def test_an_emergency_stop_of_the_crazyflie_lasts_until_a_reboot(flying: CrtpClient, stop) -> None:
    stop(flying)
    flying.run(flying.now_us + 11_000)
    flying.one(SUPERVISOR, 1, b"\2")
    write(flying, "floaty.stop", 0)
    write(flying, "stabilizer.stop", 0)
    flying.one(SUPERVISOR, 1, b"\1\1")
    assert after(flying, 1_000_000) == (State.FAILSAFE, Cause.EMERGENCY_STOP)
    assert flying.one(SUPERVISOR, 0, b"\x0c")[1] & 1 << 6  # locked
    flying.reboot()
    flying.poses(flying.now_us + 605_000, flying.now_us + 2_000_000)
    assert after(flying, 1_000_000) == (State.FLYING, Cause.NONE)


@pytest.mark.parametrize(
    "leave", [lambda c: write(c, "floaty.stop", 0), lambda c: c.one(SUPERVISOR, 1, b"\2")]
)
def test_floatys_own_stop_can_be_left(flying: CrtpClient, leave) -> None:
    stop_by_floatys_own_parameter(flying)
    flying.run(flying.now_us + 11_000)
    assert not flying.one(SUPERVISOR, 0, b"\x0c")[1] & 1 << 6  # not locked
    leave(flying)
    assert after(flying, 20_000) == (State.FLYING, Cause.NONE)


def test_floatys_own_parameter_arms_and_disarms(flying: CrtpClient) -> None:
    write(flying, "floaty.armed", 0)
    assert after(flying, 20_000) == (State.FAILSAFE, Cause.DISARMED)
    write(flying, "floaty.armed", 1)
    assert after(flying, 20_000) == (State.FLYING, Cause.NONE)


@pytest.mark.parametrize(
    ("make", "silence_us", "ask", "sign_of_life"),
    [
        (
            CrtpClient, 1_000_000,
            lambda client: write(client, "extCtrl.manual", Manual.ANGLES),
            lambda client: client.firmware.radio_polled(),  # an empty packet of the radio
        ),
        (
            MavlinkClient, 3_000_000,
            lambda client: client.send("param_set", 1, 1, b"EXT_MANUAL", Manual.ANGLES, 9),
            lambda client: client.send("heartbeat", 6, 8, 0, 0, 0),
        ),
    ],
    ids=["crtp", "mavlink"],
)  # fmt: skip
def test_angles_from_outside_last_as_long_as_a_client_is_there(make, silence_us, ask, sign_of_life) -> None:
    client = make()
    client.run(700_000)
    client.polling = False
    ask(client)
    client.run(700_000 + silence_us - 10_000)
    angles = client.writes[-1][1]
    assert angles != HOVER_COUNTS
    client.run(700_000 + silence_us + 12_000)
    assert client.writes[-1][1] == HOVER_COUNTS
    sign_of_life(client)
    client.run(client.now_us + 20_000)
    assert client.writes[-1][1] == angles


def test_emergency_stop_beats_flaps_from_outside(flying: CrtpClient) -> None:
    flying.send(PARAM, 3, b"\0extCtrl\0manual\0\x08\1")
    flying.run(flying.now_us + 20_000)
    assert flying.writes[-1][1] != HOVER_COUNTS
    stop(flying)
    flying.run(flying.now_us + 20_000)
    assert flying.writes[-1][1] == HOVER_COUNTS


def fell_silent(supervisor: Supervisor) -> None:
    supervisor.last_pose_us = 0


def was_held_at_its_bounds(supervisor: Supervisor) -> None:
    for now_us in range(5_000_000, 6_000_000, 10_000):
        supervisor.bounds.estimator.bounded += 1
        supervisor.mode(now_us)


def ran_down(supervisor: Supervisor) -> None:
    for now_us in range(0, 6_000_000, 100_000):
        supervisor.see_battery(now_us, 3000)


EVENTS = pytest.mark.parametrize(
    ("happen", "cause", "flown_by"),
    [
        (lambda supervisor: None, Cause.NONE, (MODE_FLY, MODE_MANUAL, MODE_HOVER)),
        (fell_silent, Cause.SILENCE, (MODE_HOVER, MODE_MANUAL, MODE_HOVER)),
        (was_held_at_its_bounds, Cause.OUT_OF_BOUNDS, (MODE_HOVER, MODE_MANUAL, MODE_HOVER)),
        (Supervisor.emergency_stop, Cause.EMERGENCY_STOP, (MODE_HOVER, MODE_HOVER, MODE_HOVER)),
        (ran_down, Cause.LOW_BATTERY, (MODE_HOVER, MODE_HOVER, MODE_HOVER)),
        (lambda supervisor: supervisor.arm(False), Cause.DISARMED, (MODE_HOVER, MODE_HOVER, MODE_HOVER)),
        (lambda s: s.logic.see(1, 0), Cause.CONTROLLER_NOT_FINITE, (MODE_HOVER, MODE_HOVER, MODE_HOVER)),
        (lambda s: s.logic.see(1, 1), Cause.ESTIMATOR_NOT_FINITE, (MODE_HOVER, MODE_HOVER, MODE_HOVER)),
    ],
)


def in_flight(happen: Callable[[Supervisor], object]) -> Supervisor:
    supervisor = Supervisor(load_config().supervisor, SimpleNamespace(bounded=0), lambda text: None)
    supervisor.calibrated, supervisor.last_pose_us = True, 6_000_000
    happen(supervisor)
    return supervisor


@EVENTS
@pytest.mark.parametrize("manual", Manual)
def test_angles_from_outside_move_the_flaps_unless_somebody_the_battery_or_own_logic_stopped_the_robot(
    happen: Callable[[Supervisor], object], cause: Cause, flown_by: tuple[int, int, int], manual: Manual
) -> None:
    supervisor = in_flight(happen)
    supervisor.manual = manual
    assert supervisor.mode(6_000_000) == flown_by[manual]
    assert supervisor.cause is cause


CAN_BE_ARMED, CAN_FLY = 1 << 0, 1 << 3


@EVENTS
def test_a_board_that_says_that_it_can_fly_flies_at_the_next_pose(
    happen: Callable[[Supervisor], object], cause: Cause, flown_by: tuple[int, int, int]
) -> None:
    supervisor = in_flight(happen)
    told = supervisor_bits(supervisor)
    supervisor.last_pose_us = 9_000_000  # after any time out of bounds
    supervisor.mode(9_000_000)
    assert bool(told & CAN_FLY) == (supervisor.state is State.FLYING)


@EVENTS
def test_a_disarmed_board_that_says_that_it_can_be_armed_obeys(
    happen: Callable[[Supervisor], object], cause: Cause, flown_by: tuple[int, int, int]
) -> None:
    supervisor = in_flight(happen)
    assert not supervisor_bits(supervisor) & CAN_BE_ARMED or cause is Cause.DISARMED
    supervisor.arm(False)
    assert bool(supervisor_bits(supervisor) & CAN_BE_ARMED) == supervisor.arm(True)


def test_silence_begins_when_the_last_pose_is_as_old_as_its_limit() -> None:
    supervisor = in_flight(lambda supervisor: None)
    end_us = 6_000_000 + supervisor.pose_timeout_us
    assert (supervisor.mode(end_us - 1), supervisor.mode(end_us)) == (MODE_FLY, MODE_HOVER)


def test_a_board_that_is_disarmed_while_it_calibrates_is_in_failsafe() -> None:
    supervisor = in_flight(lambda supervisor: supervisor.arm(False))
    supervisor.calibrated = False
    supervisor.mode(6_000_000)
    assert (supervisor.state, supervisor.cause) == (State.FAILSAFE, Cause.DISARMED)


@pytest.mark.parametrize(("port", "data"), [(LOC, b"\4"), (SUPERVISOR, b"\4")])
def test_watchdog_bites_one_second_after_its_last_meal_and_not_before_the_first(flying, port, data) -> None:
    assert after(flying, 2_000_000)[0] is State.FLYING
    for _ in range(3):
        flying.send(port, 1, data)
        assert after(flying, 900_000)[0] is State.FLYING
    assert after(flying, 95_000)[0] is State.FLYING
    assert after(flying, 16_000) == (State.FAILSAFE, Cause.EMERGENCY_STOP)
    flying.send(port, 1, data)
    assert after(flying, 100_000)[1] is Cause.EMERGENCY_STOP


def test_disarmed_board_does_not_fly_until_it_is_armed(flying: CrtpClient) -> None:
    flying.one(SUPERVISOR, 1, b"\1\0")
    assert after(flying, 11_000) == (State.FAILSAFE, Cause.DISARMED)
    assert flying.writes[-1][1] == HOVER_COUNTS
    flying.one(SUPERVISOR, 1, b"\1\1")
    assert after(flying, 11_000)[0] is State.FLYING


def test_low_battery_needs_five_seconds_and_ends_by_recovery_with_a_good_voltage(flying: CrtpClient) -> None:
    flying.battery_mv = 3100
    flying.run(flying.now_us + 4_000_000)
    flying.battery_mv = 3300  # a sag
    flying.run(flying.now_us + 200_000)
    flying.battery_mv = 3100
    assert after(flying, 4_800_000)[0] is State.FLYING
    assert after(flying, 400_000) == (State.FAILSAFE, Cause.LOW_BATTERY)
    assert flying.writes[-1][1] == HOVER_COUNTS
    assert flying.console == ["supervisor: failsafe, low battery"]
    flying.battery_mv = 3800
    assert after(flying, 1_000_000)[1] is Cause.LOW_BATTERY
    flying.one(SUPERVISOR, 1, b"\2")
    assert after(flying, 11_000)[0] is State.FLYING
    assert after(flying, 1_000_000)[0] is State.FLYING


def test_recovery_is_refused_while_the_battery_is_low(flying: CrtpClient) -> None:
    flying.battery_mv = 3100
    assert after(flying, 5_300_000)[1] is Cause.LOW_BATTERY
    assert flying.one(SUPERVISOR, 1, b"\2") == b"\x82\0\0"


def test_silence_is_a_parameter(flying: CrtpClient) -> None:
    flying.send(PARAM, 3, b"\0supervisor\0poseTimeout\0\x09" + struct.pack("<H", 100))
    flying.events = type(flying.events)()  # no more poses
    flying.events.at(flying.now_us // 1000 * 1000 + 1000, flying._sample)
    assert after(flying, 80_000)[0] is State.FLYING
    assert after(flying, 40_000) == (State.FAILSAFE, Cause.SILENCE)
    assert flying.console == ["supervisor: failsafe, silence"]


def test_one_outlier_pose_changes_neither_the_state_nor_the_estimate(flying: CrtpClient) -> None:
    counters = flying.firmware.signals.counters
    resets = counters[6]
    flying.run(flying.now_us + 18_000)  # of two poses that were true in one tick the later counts
    for outlier in ((1.0, 0.0, 0.0), (0.0, -1.4, 0.5), (0.3, 0.3, 0.3)):
        flying.send(LOC, 1, crtp.encode_ext_pose(outlier, LEVEL, 40_000)[1:])
        for _ in range(20):
            flying.run(flying.now_us + 10_000)
            assert state(flying)[0] is State.FLYING
            assert flying.firmware.signals.estimate[:3] == pytest.approx(OFF_CENTRE, abs=5e-3)
    assert counters[6] == resets
    assert counters[1] == 3
    assert flying.console == []


def test_an_estimator_at_its_bounds_is_a_failsafe_that_ends_half_a_second_after_it_is_back(
    flying: CrtpClient,
) -> None:
    flying.send(PARAM, 3, b"\0kalman\0maxPos\0\x06" + struct.pack("<f", 0.03))  # the robot is at y = 0.04
    begin_us = flying.now_us
    while state(flying)[0] is State.FLYING:
        flying.run(flying.now_us + 10_000)
    assert 200_000 <= flying.now_us - begin_us <= 250_000
    assert state(flying) == (State.FAILSAFE, Cause.OUT_OF_BOUNDS)
    assert after(flying, 2_000_000)[1] is Cause.OUT_OF_BOUNDS
    assert flying.writes[-1][1] == HOVER_COUNTS
    flying.send(PARAM, 3, b"\0kalman\0maxPos\0\x06" + struct.pack("<f", 1.5))
    begin_us = flying.now_us
    while state(flying)[0] is State.FAILSAFE:
        flying.run(flying.now_us + 10_000)
    assert 490_000 <= flying.now_us - begin_us <= 520_000
    assert flying.console == ["supervisor: failsafe, out of bounds", "supervisor: flying"]


def test_state_and_cause_are_log_variables(flying: CrtpClient) -> None:
    table = flying.toc(LOG)
    assert flying.log(table, "supervisor.state", "supervisor.cause", "sys.canfly", "sys.isFlying") == [
        2,
        0,
        1,
        1,
    ]
    stop(flying)
    flying.run(flying.now_us + 20_000)
    names = ("supervisor.state", "supervisor.cause", "sys.canfly", "sys.isFlying", "supervisor.info")
    assert flying.log(table, *names) == [3, 3, 0, 0, 0b10_0100_0110]


def test_flaps_never_rest_whatever_the_supervisor_says(flying: CrtpClient) -> None:
    stop(flying)
    flying.run(flying.now_us + 500_000)
    times = [t for t, _ in flying.writes]
    assert max(later - earlier for earlier, later in pairwise(times[1:])) <= 11_000
