"""The supervisor's state machine on both sides of each of its limits, with the numbers of supervisor.c."""

import pytest

from firmware_py.crazyflie.commander import Setpoint
from firmware_py.crazyflie.supervisor import Seen, State, Supervisor

UPRIGHT = (0.0, 0.0, 1.0)
READY_AT, TAKE_OFF_AT = 4, 10  # ticks


class Bench:
    """A supervisor whose every look the test asks for."""

    def __init__(self) -> None:
        self.supervisor = Supervisor()

    def look(
        self, tick: int, age_ms: int = 0, turning: bool = True, force_g: tuple[float, float, float] = UPRIGHT
    ) -> State:
        self.supervisor.update(Seen(tick, Setpoint(tick=tick - age_ms), turning, force_g), 0)
        return self.supervisor.state


def ready() -> Bench:
    bench = Bench()
    states = [bench.look(tick, turning=False) for tick in range(1, READY_AT + 1)]
    assert states == [State.CHECKS_NOT_PASSED, State.CHECKS_PASSED, State.ARMING, State.READY]
    return bench


@pytest.fixture
def flying() -> Bench:
    bench = ready()
    assert bench.look(TAKE_OFF_AT) is State.FLYING
    return bench


@pytest.mark.parametrize("levelled_out", [False, True])
@pytest.mark.parametrize(
    ("age_ms", "state"),
    [(500, State.FLYING), (501, State.LEVEL_OUT), (2000, State.LEVEL_OUT), (2001, State.FREE_FALL)],
)
def test_an_old_set_point_levels_the_robot_out_until_a_new_one_and_none_stops_it(
    flying: Bench, levelled_out: bool, age_ms: int, state: State
) -> None:
    if levelled_out:
        assert flying.look(5000, 501) is State.LEVEL_OUT
    assert flying.look(5040, age_ms) is state


def test_a_watchdog_that_is_not_fed_for_a_second_stops_and_locks(flying: Bench) -> None:
    flying.supervisor.feed_watchdog(100)
    flying.supervisor.feed_watchdog(200)
    states = [flying.look(tick) for tick in (1199, 1200, 1240)]
    assert states == [State.FLYING, State.FREE_FALL, State.LOCKED]


def test_two_seconds_after_its_motors_the_robot_has_landed_and_three_later_it_is_reset(flying: Bench) -> None:
    ticks = (TAKE_OFF_AT + 1999, TAKE_OFF_AT + 2000, TAKE_OFF_AT + 5000, TAKE_OFF_AT + 5001)
    states = [flying.look(tick, turning=False) for tick in ticks]
    assert states == [State.FLYING, State.LANDED, State.LANDED, State.RESET]


def test_a_robot_that_has_landed_may_take_off_again(flying: Bench) -> None:
    assert flying.look(TAKE_OFF_AT + 2000, turning=False) is State.LANDED
    assert flying.look(TAKE_OFF_AT + 2040) is State.FLYING


def test_a_second_landing_lasts_as_long_as_the_first(flying: Bench) -> None:
    for take_off in (TAKE_OFF_AT, 5000):
        assert flying.look(take_off) is State.FLYING
        ticks = (take_off + 2000, take_off + 4990)
        assert [flying.look(tick, turning=False) for tick in ticks] == [State.LANDED, State.LANDED]


@pytest.mark.parametrize(("after_ms", "state"), [(30_000, State.READY), (30_001, State.CHECKS_NOT_PASSED)])
def test_a_robot_that_does_not_take_off_is_checked_again_after_half_a_minute(
    after_ms: int, state: State
) -> None:
    assert ready().look(READY_AT + after_ms, turning=False) is state


@pytest.mark.parametrize(
    ("force_g", "last_ms"),
    [
        ((0.0, 0.9, 0.49), 1000),
        ((0.0, 0.9, -0.2), 1000),
        ((0.0, 0.0, -0.21), 100),
        ((0.1, 0.0, 0.0), 1000),  # one part is enough: it does not fall
    ],
)
def test_a_tilted_robot_has_crashed_after_a_second_and_one_upside_down_after_a_tenth(
    flying: Bench, force_g: tuple[float, float, float], last_ms: int
) -> None:
    states = [flying.look(100 + ms, force_g=force_g) for ms in (0, last_ms, last_ms + 1)]
    assert states == [State.FLYING, State.FLYING, State.CRASHED]


@pytest.mark.parametrize("force_g", [(0.0, 0.9, 0.5), (0.09, -0.09, 0.09)], ids=["less tilted", "falling"])
def test_neither_a_tilt_by_sixty_degrees_nor_a_fall_is_a_crash(
    flying: Bench, force_g: tuple[float, float, float]
) -> None:
    assert {flying.look(tick, force_g=force_g) for tick in range(100, 5000, 40)} == {State.FLYING}


def test_a_short_upright_moment_begins_the_second_anew(flying: Bench) -> None:
    tilted = (0.0, 0.9, 0.1)
    for tick, force_g in ((100, tilted), (1000, UPRIGHT), (1040, tilted), (2040, tilted)):
        assert flying.look(tick, force_g=force_g) is State.FLYING
    assert flying.look(2041, force_g=tilted) is State.CRASHED


def test_a_crash_is_forgotten_on_request_once_the_robot_stands(flying: Bench) -> None:
    lying = (0.0, 1.0, 0.0)
    for tick in (100, 1101):
        flying.look(tick, force_g=lying)
    supervisor = flying.supervisor
    assert (supervisor.crashed, supervisor.request_recovery()) == (True, False)
    assert flying.look(1200) is State.CRASHED
    assert (supervisor.request_recovery(), supervisor.crashed) == (True, False)
    assert flying.look(1240) is State.CHECKS_NOT_PASSED


def test_a_robot_that_lies_without_a_crash_has_nothing_to_recover_from() -> None:
    bench = ready()
    for tick in (100, 1200):
        bench.look(tick, turning=False, force_g=(0.0, 1.0, 0.0))
    assert (bench.supervisor.tumbled, bench.supervisor.request_recovery()) == (True, True)


def test_a_robot_that_is_disarmed_in_flight_is_reset_and_arms_itself_again(flying: Bench) -> None:
    assert flying.supervisor.request_arming(False)
    states = [(flying.look(tick), flying.supervisor.armed) for tick in (20, 60, 100, 140)]
    assert states == [
        (State.RESET, False), (State.CHECKS_NOT_PASSED, False), (State.CHECKS_PASSED, True), (State.ARMING, True),
    ]  # fmt: skip


def test_disarming_resets_a_robot_that_has_landed_and_is_no_excuse_for_a_crash(flying: Bench) -> None:
    landed = ready()
    assert [landed.look(tick, turning=tick == TAKE_OFF_AT) for tick in (TAKE_OFF_AT, 2500)][
        -1
    ] is State.LANDED
    for bench, force_g, state in ((landed, UPRIGHT, State.RESET), (flying, (0.0, 1.0, 0.0), State.CRASHED)):
        bench.look(2540, turning=bench is flying, force_g=force_g)
        assert bench.supervisor.request_arming(False)
        assert bench.look(3541, turning=bench is flying, force_g=force_g) is state


def test_the_bits_are_in_the_order_of_the_firmware(flying: Bench) -> None:
    """Can be armed, armed, arms itself, can fly, flies, tumbled, locked, crashed."""
    found = [flying.supervisor.bits]
    flying.supervisor.stop_wanted = True
    for tick in (100, 140):
        flying.look(tick)
    found.append(flying.supervisor.bits)
    crashed = ready()
    for tick in (10, 100, 1101):
        crashed.look(tick, force_g=UPRIGHT if tick == 10 else (0.0, 1.0, 0.0))
    assert [*found, crashed.supervisor.bits] == [0b0001_1110, 0b0100_0100, 0b1010_0100]
