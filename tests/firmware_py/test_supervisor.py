"""The failsafe on board: every cause leads to the hover angles, is announced, and ends only as documented."""

from collections.abc import Callable
from itertools import pairwise

import pytest

from firmware_py.core import structs
from firmware_py.core.sampling import RECOVERY_STEPS, STALE_STEPS, WINDOW
from firmware_py.core.structs import MODE_FLY, MODE_HOVER, MODE_MANUAL
from firmware_py.core.supervisor import (
    BATTERY_LOW_US,
    BOUNDS_RECOVERY_US,
    DOWN_US,
    EPISODE_GAP_US,
    EPISODE_LIMIT_US,
)
from firmware_py.wire.supervisor import Cause, State
from support.crtp_client import LOC, LOG, PARAM, SUPERVISOR, CrtpClient
from support.firmware_bench import HOVER_COUNTS
from support.mavlink_client import MavlinkClient
from support.supervisor_bench import SupervisorBench

MANUALS = (structs.MANUAL_OFF, structs.MANUAL_ANGLES, structs.MANUAL_HOVER)
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
    client.run(client.now_us + 1_040_000)  # the supervisor looks every 40 ms


STOPS = (stop, stop_on_the_supervisors_port, stop_by_parameter, let_watchdog_bite)


def disarm(client: CrtpClient) -> None:
    write(client, "floaty.armed", 0)


@pytest.mark.parametrize("act", [*STOPS, stop_by_floatys_own_parameter, disarm])
def test_a_stop_acts_within_eleven_milliseconds_and_the_crazyflie_s_lasts_until_a_reboot(
    flying: CrtpClient, act: Callable[[CrtpClient], None]
) -> None:
    cause = Cause.DISARMED if act is disarm else Cause.EMERGENCY_STOP
    act(flying)
    assert after(flying, 11_000) == (State.FAILSAFE, cause)
    assert flying.writes[-1][1] == HOVER_COUNTS
    assert flying.console == [f"supervisor: failsafe, {cause.name.lower().replace('_', ' ')}"]
    assert after(flying, 200_000)[1] is cause
    write(flying, "floaty.stop", 0)
    write(flying, "stabilizer.stop", 0)
    flying.one(SUPERVISOR, 1, b"\2")
    flying.one(SUPERVISOR, 1, b"\1\1")
    locked = act in STOPS
    assert after(flying, 11_000)[1] is (cause if locked else Cause.NONE)
    bits = int.from_bytes(flying.one(SUPERVISOR, 0, b"\x0c")[1:3], "little")
    assert bool(bits & 1 << 6) is locked
    each = [flying.one(SUPERVISOR, 0, bytes((number,))) for number in range(1, 12)]
    assert each == [bytes((0x80 | number, bits >> number - 1 & 1)) for number in range(1, 12)]
    flying.reboot()
    flying.poses(flying.now_us + 605_000, flying.now_us + 2_000_000)
    assert after(flying, 1_000_000) == (State.FLYING, Cause.NONE)


@pytest.mark.long
@pytest.mark.parametrize(
    ("make", "silence_us", "ask", "sign_of_life"),
    [
        (
            CrtpClient, 1_000_000,
            lambda client: write(client, "extCtrl.manual", structs.MANUAL_ANGLES),
            lambda client: client.firmware.radio_polled(),  # an empty packet of the radio
        ),
        (
            MavlinkClient, 3_000_000,
            lambda client: client.send("param_set", 1, 1, b"EXT_MANUAL", structs.MANUAL_ANGLES, 9),
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


def had_a_frozen_gyro(bench: SupervisorBench) -> None:
    bench.steps(STALE_STEPS + 1)


def fell_silent(bench: SupervisorBench) -> None:
    bench.now_us += int(bench.parameters.pose_timeout_us)


def was_held_at_its_bounds(bench: SupervisorBench) -> None:
    bench.fly(1_000_000, bounded=True)


def ran_down(bench: SupervisorBench) -> None:
    bench.data.battery_mv = 3000
    bench.fly(6_000_000)


def logic_failed(estimator: bool) -> Callable[[SupervisorBench], None]:
    """Own logic has returned NaN or infinity; what the guard does then is tested with own logic."""

    def happen(bench: SupervisorBench) -> None:
        cause = Cause.ESTIMATOR_NOT_FINITE if estimator else Cause.CONTROLLER_NOT_FINITE
        bench.core.supervisor.fields.not_finite = cause
        bench.look()

    return happen


EVENTS = pytest.mark.parametrize(
    ("happen", "cause", "flown_by"),
    [
        (lambda bench: None, Cause.NONE, (MODE_FLY, MODE_MANUAL, MODE_HOVER)),
        (had_a_frozen_gyro, Cause.IMU_STALE, (MODE_HOVER, MODE_HOVER, MODE_HOVER)),
        (fell_silent, Cause.SILENCE, (MODE_HOVER, MODE_MANUAL, MODE_HOVER)),
        (was_held_at_its_bounds, Cause.OUT_OF_BOUNDS, (MODE_HOVER, MODE_MANUAL, MODE_HOVER)),
        (
            lambda bench: bench.view.emergency_stop(),
            Cause.EMERGENCY_STOP,
            (MODE_HOVER, MODE_HOVER, MODE_HOVER),
        ),
        (ran_down, Cause.LOW_BATTERY, (MODE_HOVER, MODE_HOVER, MODE_HOVER)),
        (lambda bench: bench.view.arm(False), Cause.DISARMED, (MODE_HOVER, MODE_HOVER, MODE_HOVER)),
        (logic_failed(False), Cause.CONTROLLER_NOT_FINITE, (MODE_HOVER, MODE_HOVER, MODE_HOVER)),
        (logic_failed(True), Cause.ESTIMATOR_NOT_FINITE, (MODE_HOVER, MODE_HOVER, MODE_HOVER)),
    ],
)


def in_flight(happen: Callable[[SupervisorBench], object], now_us: int = 0) -> SupervisorBench:
    bench = SupervisorBench(now_us)
    bench.calibrate()
    bench.pose()
    happen(bench)
    return bench


@pytest.mark.long
@EVENTS
@pytest.mark.parametrize("manual", MANUALS)
def test_manual_angles_act_unless_the_robot_was_stopped(
    happen: Callable[[SupervisorBench], object], cause: Cause, flown_by: tuple[int, int, int], manual: int
) -> None:
    bench = in_flight(happen)
    bench.data.manual_mode = manual
    assert bench.look() == flown_by[manual]
    assert bench.view.cause is cause
    bench.connected = False
    assert bench.look() == (MODE_HOVER if manual == structs.MANUAL_ANGLES else flown_by[manual])


@pytest.mark.parametrize(("gap_us", "outside"), [(EPISODE_GAP_US, True), (EPISODE_GAP_US + 10_000, False)])
def test_bounded_steps_50_ms_apart_are_one_episode_that_counts_at_200_ms(gap_us: int, outside: bool) -> None:
    bench = in_flight(lambda bench: bench.fly(1_000_000))
    for now_us in range(0, EPISODE_LIMIT_US + gap_us, gap_us):
        bench.fly(10_000, bounded=True)
        expected = Cause.OUT_OF_BOUNDS if outside and now_us >= EPISODE_LIMIT_US else Cause.NONE
        assert bench.view.cause is expected
        bench.fly(gap_us - 10_000)


def test_a_bounded_step_within_the_half_second_begins_it_anew_and_one_after_it_a_new_episode() -> None:
    bench = in_flight(was_held_at_its_bounds)
    for inside_us in (10_000, BOUNDS_RECOVERY_US - 20_000):
        bench.fly(inside_us)
        bench.fly(10_000, bounded=True)
    bench.fly(BOUNDS_RECOVERY_US - 10_000)
    assert bench.view.cause is Cause.OUT_OF_BOUNDS
    for bounded in (False, True):
        bench.fly(10_000, bounded)
        assert bench.view.cause is Cause.NONE


ENDS = {
    Cause.IMU_STALE: {"counts"}, Cause.SILENCE: {"pose", "inside", "volts"}, Cause.OUT_OF_BOUNDS: {"inside"},
    Cause.EMERGENCY_STOP: set(), Cause.LOW_BATTERY: {"recover"}, Cause.DISARMED: {"arm"},
    Cause.CONTROLLER_NOT_FINITE: {"recover"}, Cause.ESTIMATOR_NOT_FINITE: {"recover"},
}  # fmt: skip


@pytest.mark.long
@EVENTS
def test_every_cause_ends_as_documented_each_time_and_by_nothing_else(
    happen: Callable[[SupervisorBench], object], cause: Cause, flown_by: tuple[int, int, int]
) -> None:
    def volts(bench: SupervisorBench) -> None:
        bench.data.battery_mv = bench.parameters.low_battery_mv
        bench.fly(10_000)

    def recover(bench: SupervisorBench) -> None:
        assert bench.view.recover() == (cause is not Cause.LOW_BATTERY)
        bench.data.battery_mv = bench.parameters.low_battery_mv
        assert bench.view.recover()
        bench.data.battery_mv -= cause is Cause.LOW_BATTERY  # its five seconds begin anew

    actions: dict[str, Callable[[SupervisorBench], object]] = {
        "pose": lambda bench: bench.fly(10_000),
        "inside": lambda bench: bench.fly(BOUNDS_RECOVERY_US + 10_000),
        "counts": lambda bench: bench.steps(RECOVERY_STEPS, moving=True),
        "arm": lambda bench: bench.view.arm(True),
        "volts": volts,
        "recover": recover,
    }
    for name, act in actions.items():
        bench = in_flight(lambda bench: None)
        for _ in range(2):
            happen(bench)
            bench.look()
            assert bench.view.cause is cause
            act(bench)
            bench.look()
            assert (bench.view.cause is Cause.NONE) == (name in ENDS.get(cause, actions)), name


def test_an_episode_after_a_silent_one_restarts() -> None:
    bench = in_flight(lambda bench: None)
    for _ in range(3):
        bench.fly(3_800_000)
        assert bench.fly(EPISODE_LIMIT_US, bounded=True) == MODE_FLY


# Instants wrap after 2^32 us, differences are ambiguous after 2^31 us: flights across both, and far from them.
STARTS_US = pytest.mark.parametrize("start_us", [0, 2**31 - 1_000_000, 2**32 - 1_000_000, 3_600_000_000])


@pytest.mark.long
@STARTS_US
@pytest.mark.parametrize("waited_us", [0, 30_000])
def test_silence_begins_when_the_last_pose_is_as_old_as_its_limit(start_us: int, waited_us: int) -> None:
    bench = in_flight(lambda bench: bench.fly(990_000), start_us)
    bench.now_us += 7_000
    bench.pose(waited_us)
    limit_us = int(bench.parameters.pose_timeout_us) - waited_us
    assert (bench.look(limit_us - 1), bench.look(1)) == (MODE_FLY, MODE_HOVER)
    assert bench.view.cause is Cause.SILENCE


@pytest.mark.long
@STARTS_US
@pytest.mark.parametrize(
    ("happen", "cause"),
    [
        (ran_down, Cause.LOW_BATTERY),
        (was_held_at_its_bounds, Cause.OUT_OF_BOUNDS),
        (fell_silent, Cause.SILENCE),
    ],
)
def test_timed_decisions_survive_the_clock_wrap(
    happen: Callable[[SupervisorBench], object], cause: Cause, start_us: int
) -> None:
    bench = in_flight(lambda bench: bench.fly(500_000), start_us)
    happen(bench)
    bench.look()
    assert bench.view.cause is cause


def test_silence_lasts_for_hours() -> None:
    """Longer than differences of a clock of 32 bits reach."""
    bench = in_flight(fell_silent)
    for _ in range(2 * 3600):
        assert bench.look(1_000_000) == MODE_HOVER
        assert bench.found == (State.FAILSAFE, Cause.SILENCE)
    assert bench.fly(10_000) == MODE_FLY


def test_a_board_that_is_disarmed_while_it_calibrates_is_in_failsafe() -> None:
    bench = SupervisorBench()
    bench.view.arm(False)
    bench.look()
    assert bench.found == (State.FAILSAFE, Cause.DISARMED)


def test_a_battery_is_low_after_exactly_five_seconds_below_the_limit_on_end() -> None:
    bench = in_flight(lambda bench: None)
    for last_us in (BATTERY_LOW_US - 1, BATTERY_LOW_US):
        bench.data.battery_mv = bench.parameters.low_battery_mv
        bench.look(1)
        bench.data.battery_mv -= 1
        bench.look(last_us)
        assert (bench.view.cause is Cause.LOW_BATTERY) == (last_us == BATTERY_LOW_US)


def test_nothing_is_in_the_air_before_a_flight_and_five_seconds_after_it_was_stopped() -> None:
    bench = in_flight(lambda bench: None)
    supervisor = bench.core.supervisor.fields
    assert not supervisor.aloft
    bench.fly(100_000)
    for end in (lambda: bench.view.arm(False), bench.view.stop):
        assert supervisor.aloft
        end()
        bench.fly(DOWN_US - 10_000)
        assert supervisor.aloft
        bench.fly(10_000)
        assert not supervisor.aloft
        bench.view.arm(True)
        bench.fly(10_000)


def test_the_flaps_are_under_control_in_every_mode_but_the_hover() -> None:
    bench = SupervisorBench()
    for mode in (MODE_HOVER, MODE_FLY, MODE_MANUAL):
        bench.data.mode = mode
        assert bench.view.controlling is (mode != MODE_HOVER)


def test_angles_by_hand_act_only_while_a_client_could_take_them_back() -> None:
    bench = SupervisorBench()
    bench.data.manual_mode = structs.MANUAL_ANGLES
    for connected in (True, False, True):
        bench.connected = connected
        assert bench.look() == (MODE_MANUAL if connected else MODE_HOVER)


@pytest.mark.parametrize("locks", [False, True])
def test_floaty_s_own_stop_reads_as_one_that_can_be_undone(locks: bool) -> None:
    firmware = CrtpClient().firmware
    read = {one.name: one.read for one in firmware.parameters}
    for stopped in (False, True):
        if stopped:
            supervisor = firmware._supervisor
            (supervisor.emergency_stop if locks else supervisor.stop)()
        shown = tuple(bool(read[f"{group}.stop"]()) for group in ("floaty", "stabilizer"))
        assert shown == (stopped and not locks, stopped and locks)


def test_flaps_that_are_moved_by_hand_are_not_at_rest() -> None:
    bench = SupervisorBench()
    bench.data.manual_mode = structs.MANUAL_ANGLES
    bench.look()
    assert bench.core.supervisor.fields.aloft


@pytest.mark.parametrize("stops", [True, False])
def test_a_robot_that_was_stopped_or_disarmed_stays_where_it_is_when_it_may_fly_again(stops: bool) -> None:
    bench = in_flight(lambda bench: bench.fly(100_000))
    bench.data.goal_kind = structs.GOAL_ABSOLUTE
    bench.view.recover() if stops else bench.view.arm(True)
    assert bench.data.goal_kind == structs.GOAL_ABSOLUTE, "it flies: its goal stays"
    bench.view.stop() if stops else bench.view.arm(False)
    bench.view.recover() if stops else bench.view.arm(True)
    assert bench.data.goal_kind == structs.GOAL_STALE


def test_a_commander_leads_a_flight_with_absolute_poses_and_no_other() -> None:
    bench = in_flight(lambda bench: bench.fly(100_000))
    led = []
    for absolute, end in ((0, bench.view.recover), (1, bench.view.recover), (1, bench.view.stop)):
        bench.data.poses_absolute = absolute
        end()
        bench.look()
        led.append(bench.core.supervisor.fields.led)
    assert led == [0, 1, 0]


def test_a_gyro_is_stale_after_20_steps_and_alive_after_100_with_new_counts() -> None:
    bench = in_flight(lambda bench: bench.steps(50, moving=True))
    found = []
    for steps, moving in ((STALE_STEPS - 1, False), (1, False), (RECOVERY_STEPS - 1, True), (1, True)):
        bench.steps(steps, moving)
        bench.fly(10_000)
        found.append(bench.view.cause is Cause.IMU_STALE)
    assert found == [False, True, True, False]


def test_a_late_sample_on_a_link_is_not_a_stale_gyro() -> None:
    bench = in_flight(lambda bench: None)
    bench.data.gyro_again = 1
    bench.steps(10 * STALE_STEPS)
    assert bench.look() == MODE_FLY


@STARTS_US
def test_control_is_lost_once_after_50_ms_without_a_look_and_until_the_next_one(start_us: int) -> None:
    bench = in_flight(lambda bench: bench.fly(990_000), start_us)
    supervisor = bench.core.supervisor.fields
    for _ in range(2):
        assert [bench.watch_control(after_us) for after_us in (49_999, 50_000, 70_000)] == [0, 1, 0]
        assert (supervisor.state, supervisor.cause) == (State.FAILSAFE, Cause.NO_CONTROL)
        assert bench.fly(10_000) == MODE_FLY


def test_a_controller_that_has_not_begun_is_not_lost() -> None:
    bench = SupervisorBench(look=False)
    assert bench.watch_control(1_000_000) == 0
    assert bench.view.state is State.CALIBRATING


def test_a_restarted_flight_waits_for_gyro_and_pose_and_stays_disarmed() -> None:
    bench = in_flight(lambda bench: bench.fly(100_000))
    bench.view.arm(False)
    bench.data.gyro_bias[:], bench.data.gyro_sum[:], bench.data.gyro_samples = 1.0, 2, 3
    for _ in range(2):  # in the middle of a search, too
        bench.core.run.call("restart")
        bench.look()
        assert (bench.view.calibrated, bench.view.armed) == (False, False)
        assert not any((*bench.data.gyro_bias, *bench.data.gyro_sum, bench.data.gyro_samples))
        found = [bench.core.run.call("take_sample") for _ in range(WINDOW - 1)]
        assert not any(found)
    assert not bench.core.supervisor.fields.aloft
    bench.view.arm(True)
    bench.calibrate()
    bench.look()
    assert bench.view.state is State.WAITING


def test_the_wire_has_the_numbers_of_the_core() -> None:
    for kind in (State, Cause):
        numbers = {one.name: getattr(structs, f"{kind.__name__.upper()}_{one.name}") for one in kind}
        assert numbers == {one.name: one.value for one in kind}


def test_state_and_cause_are_log_variables(flying: CrtpClient) -> None:
    table = flying.toc(LOG)
    names = ("supervisor.state", "supervisor.cause", "sys.canfly", "sys.isFlying", "supervisor.info")
    # With corrections the Crazyflie's supervisor sees no flight.
    assert flying.log(table, *names) == [2, 0, 1, 0, 0b10_0000_1110]
    stop(flying)
    flying.run(flying.now_us + 150_000)
    assert flying.log(table, *names) == [3, 3, 0, 0, 0b10_0100_0100]


def test_flaps_are_written_in_every_supervisor_state(flying: CrtpClient) -> None:
    stop(flying)
    flying.run(flying.now_us + 500_000)
    times = [t for t, _ in flying.writes]
    assert max(later - earlier for earlier, later in pairwise(times[1:])) <= 11_000


def freeze(client: CrtpClient, frozen: bool) -> None:
    client.imu_noise = 0 if frozen else 1


def silence(client: CrtpClient, silent: bool) -> None:
    client.imu_alive = not silent


@pytest.mark.long
@pytest.mark.parametrize("fail", [freeze, silence])
def test_a_gyro_that_delivers_nothing_new_opens_the_loop_until_it_has_worked_for_a_while(
    flying: CrtpClient, fail: Callable[[CrtpClient, bool], None]
) -> None:
    fail(flying, True)
    assert after(flying, 10_000) == (State.FLYING, Cause.NONE)
    assert after(flying, 21_000) == (State.FAILSAFE, Cause.IMU_STALE)
    assert flying.console == ["supervisor: failsafe, imu stale"]
    assert after(flying, 2_000_000) == (State.FAILSAFE, Cause.IMU_STALE)
    assert flying.writes[-1][1] == HOVER_COUNTS
    fail(flying, False)
    assert after(flying, 90_000) == (State.FAILSAFE, Cause.IMU_STALE)
    assert after(flying, 31_000) == (State.FLYING, Cause.NONE)
