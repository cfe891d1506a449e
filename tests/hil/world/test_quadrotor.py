"""Laws of the Crazyflie's body: thrust and torque as measured, Newton and Euler, floor, air, battery, losses."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.fault_kinds import KINDS
from hil.world.config import BatteryConfig, TunnelConfig
from hil.world.quadrotor import MOTOR_FAILURES, STEPS, Quadrotor, QuadrotorConfig, rpm_for, steady_rpm
from hil.world.room import Room

G = 9.81
HIGH = (0.0, 0.0, 2.0)  # the ground effect is below 0.01 % there
LEVEL = (1.0, 0.0, 0.0, 0.0)
CELL = BatteryConfig(cells=1, electronics_power=1.0)
# crazyflie-firmware 2a18fc29, platform_defaults_cf2.h, 2.1+ propellers: thrust [N] over volts, torque over thrust [m].
THRUST_OF_V = np.polynomial.Polynomial(
    (-0.02476537915958403, 0.06523793527519485, -0.026792504967750107, 0.006776789303971145)
)
THRUST2TORQUE = 0.0069928948992470565


def make(p_WB: tuple[float, float, float] | None = HIGH, seed: int = 1, **config: object) -> Quadrotor:
    settings = QuadrotorConfig.model_validate({"motor_spread": 0.0, "ceiling": 3.0} | config)
    return Quadrotor(settings, TunnelConfig(fan_factor=0.0), CELL, np.random.default_rng(seed), p_WB)


def spun_up(duties: tuple[float, float, float, float], volts: float = 4.0, **config: object) -> Quadrotor:
    """Return a robot in the air whose propellers have turned at their duties for a second."""
    body = make(**config)
    body.hold()
    body.draw(0, volts)
    steps = STEPS[str(config.get("motors", "brushed"))]
    body.set_counts(0, [round(steps * duty) for duty in duties])
    body.advance(1_000_000)
    body.release()
    return body


def hover_volts(mass: float = 0.029) -> float:
    roots = (THRUST_OF_V - mass * G / 4).roots()
    return float(next(root.real for root in roots if abs(root.imag) < 1e-9))


def test_falls_freely_without_thrust_and_feels_nothing() -> None:
    body = make()
    assert body.acceleration_W.tolist() == [0.0, 0.0, -G]
    assert body.specific_force_B == pytest.approx([0.0, 0.0, 0.0])
    body.advance(300_000)
    assert body.p_WB[2] == pytest.approx(2.0 - 0.5 * G * 0.3**2, rel=1e-6)


@pytest.mark.parametrize("volts", [1.0, 2.0, 3.0])
def test_thrust_is_bitcrazes_measurement_and_torque_its_share(volts: float) -> None:
    body = spun_up((0.75, 0.75, 0.75, 0.75), volts / 0.75)
    assert body.thrust == pytest.approx(4 * [THRUST_OF_V(volts)], rel=2e-4)
    only = spun_up((0.0, 0.75, 0.0, 0.0), volts / 0.75)
    torque = only.alpha_B[2] * QuadrotorConfig().inertia[2]
    assert torque / only.thrust[1] == pytest.approx(
        THRUST2TORQUE, rel=0.05
    )  # crazyflow's fit beside Bitcraze's


@pytest.mark.parametrize("motors", ["brushed", "brushless"])
def test_a_duty_is_a_share_of_all_counts_and_no_count_is_beyond_them(motors: str) -> None:
    body, steps = make(motors=motors), STEPS[motors]
    body.set_counts(0, [-1, steps // 4, steps, steps + 1])
    assert body.rotors.fields.duty.tolist() == [0.0, steps // 4 / steps, 1.0, 1.0]


def test_hovers_at_the_voltage_at_which_four_thrusts_are_its_weight() -> None:
    body = spun_up((0.625,) * 4, hover_volts() / 0.625)
    assert body.acceleration_W == pytest.approx([0.0, 0.0, 0.0], abs=0.003)
    assert body.specific_force_B == pytest.approx([0.0, 0.0, G], abs=0.003)
    assert hover_volts() == pytest.approx(2.4, abs=0.01)  # 63 % of 3.8 V
    assert body.rpm == pytest.approx(4 * [22200], rel=0.01)


@pytest.mark.parametrize(
    ("stronger", "axis", "sign"),
    [
        ((3, 4), 0, 1.0),  # the left ones: it rolls to the right
        ((2, 3), 1, 1.0),  # the back ones: its nose sinks
        ((1, 3), 2, -1.0),  # those that turn counter-clockwise: it turns clockwise
        ((2, 4), 2, 1.0),
    ],
)
def test_stronger_motors_turn_it_as_the_mixer_does(stronger: tuple[int, int], axis: int, sign: float) -> None:
    duties = tuple(0.65 if motor in stronger else 0.6 for motor in (1, 2, 3, 4))
    alpha = spun_up(duties).alpha_B * np.sign(sign)  # type: ignore[arg-type]
    others = [abs(alpha[other]) for other in range(3) if other != axis]
    assert alpha[axis] > 2.0
    assert max(others) < 1e-9 * alpha[axis] + 1e-9


def test_a_propeller_approaches_its_speed_with_foersters_pole() -> None:
    body = make()
    body.hold()
    body.draw(0, 4.0)
    body.set_counts(0, 4 * [128])
    speeds = []
    for ms in range(2, 202, 2):
        body.advance(1000 * ms)
        speeds.append(body.rpm[0])
    left = steady_rpm(body.rotors.fields, 2.0) - np.array(speeds)
    assert left[1:] / left[:-1] == pytest.approx(0.9695404, abs=1e-4)


def test_it_turns_by_eulers_equations() -> None:
    body = make(rotor_drag=(0.0, 0.0))
    omega = np.array([8.0, 3.0, -20.0])
    body.place(HIGH, LEVEL, omega_B=omega.tolist())
    J = np.array(QuadrotorConfig().inertia)
    found = solve_ivp(lambda _, w: -np.cross(w, J * w) / J, (0, 0.3), omega, rtol=1e-10, atol=1e-12)
    body.advance(300_000)
    assert body.omega_B == pytest.approx(found.y[:, -1], rel=1e-3)


def test_turning_propellers_make_it_a_gyroscope() -> None:
    """Pairs of propellers that turn against each other leave no angular momentum; one pair alone does."""
    config = QuadrotorConfig()
    one = spun_up((0.6, 0.0, 0.6, 0.0))
    spin = 2 * config.rotor_inertia * one.rpm[0] * 2 * math.pi / 60
    at_rest = one.alpha_B.copy()
    one.place(HIGH, LEVEL, omega_B=(5.0, 0.0, 0.0))
    turned = (one.alpha_B - at_rest) * config.inertia
    assert turned[1] == pytest.approx(5.0 * spin, rel=1e-6)
    both = spun_up((0.6, 0.6, 0.6, 0.6))
    both.place(HIGH, LEVEL, omega_B=(5.0, 0.0, 0.0))
    assert both.alpha_B[1] == pytest.approx(0.0, abs=1e-6)


def test_stands_still_on_the_floor_and_feels_its_weight() -> None:
    body = make(None)
    body.advance(5_000_000)
    assert body.p_WB[2] == pytest.approx(QuadrotorConfig().foot_below, abs=0.001)
    assert np.abs(body.omega_B).max() < 1e-6
    assert body.specific_force_B == pytest.approx([0.0, 0.0, G], abs=1e-6)
    assert body.lost is None


def test_floor_raises_the_thrust_by_the_square_of_radius_over_height() -> None:
    config, at = QuadrotorConfig(), 0.1
    high, low = spun_up((0.6,) * 4), spun_up((0.6,) * 4)
    low.place((0.0, 0.0, at - config.rotor_above), LEVEL)
    ratio = low.thrust[0] / high.thrust[0]
    assert ratio == pytest.approx(
        1.0 + config.ground_effect * (config.rotor_radius / (4 * at)) ** 2, rel=2e-4
    )


def test_air_drags_at_turning_rotors_as_foerster_measured() -> None:
    body = spun_up((0.6,) * 4)
    body.place(HIGH, LEVEL, v_WB=(1.0, -2.0, 3.0))
    turning = float(body.rpm.sum()) * 2 * math.pi / 60
    lift = float(body.thrust.sum())
    force = body.specific_force_B * QuadrotorConfig().mass
    expected = turning * np.array([-9.1785e-7, 2 * 9.1785e-7, -3 * 10.311e-7]) + (0, 0, lift)
    assert force == pytest.approx(expected, rel=1e-6)


def test_wind_moves_it_and_is_shown() -> None:
    body = spun_up((0.6,) * 4)
    body.tunnel.set_side_wind(1.0, 2.0, 0.0)
    body.advance(1_001_000)
    assert body.flow_W.tolist() == [1.0, 2.0, 0.0]
    assert body.acceleration_W[1] == pytest.approx(2 * body.acceleration_W[0], rel=1e-2)


def test_battery_gives_what_electronics_and_thrust_take() -> None:
    body = spun_up((0.625,) * 4, hover_volts() / 0.625)
    body.draw(1_000_000, hover_volts() / 0.625)
    body.advance(1_100_000)
    weight = QuadrotorConfig().mass * G
    assert body.draw(1_100_000, 3.8) == pytest.approx(1.0 + 24.1 * weight, rel=0.01)
    assert body.draw(1_100_000, 3.8) == pytest.approx(
        1.0 + 24.1 * weight, rel=0.01
    )  # nothing new: the last one


@pytest.mark.parametrize(
    ("place", "motion", "text"),
    [
        ((0.0, 0.0, 1.0), {}, "hit the floor at 4."),
        ((2.5, 0.0, 1.0), {}, "left the room: 2.50 m"),
        ((1.0, -2.5, 1.0), {}, "left the room: 2.50 m"),
        ((0.0, 0.0, 3.5), {}, "hit the ceiling at 3.50 m"),
        ((0.0, 0.0, 2.0), {"omega_B": (20.0, 0.0, 0.0)}, "tumbled: tilt 1.5"),
    ],
)
def test_a_loss_names_its_cause_and_value(
    place: tuple[float, float, float], motion: dict[str, tuple[float, float, float]], text: str
) -> None:
    body = make()
    body.place(place, LEVEL, **motion)
    body.advance(600_000)
    assert body.lost is not None
    assert body.lost.startswith(text)
    body.put_back((0.0, 0.0, 1.0))
    assert body.lost is None


def test_its_sensors_see_the_floor_the_walls_and_the_ceiling_that_end_its_flight() -> None:
    assert make(room=1.7, ceiling=2.2).room == Room(0.0, 1.7, 2.2)


def test_it_looks_like_four_rotors_whose_numbers_are_the_motors() -> None:
    look = make().look
    assert [part.label for part in look.parts[1:]] == ["1", "2", "3", "4"]
    middles = [part.place for part in look.parts[1:]]
    assert [(x > 0, y > 0) for x, y, _ in middles] == [
        (True, False),
        (False, False),
        (False, True),
        (True, True),
    ]
    assert make().markers.places.shape == (8, 3)


def test_same_bits_however_time_is_divided() -> None:
    states = []
    for step_us in (250, 1_000, 7_000):
        body = make(None, motor_spread=0.05)
        body.draw(0, 4.1)
        body.set_counts(0, (190, 180, 185, 175))
        for now_us in range(step_us, 210_001, step_us):
            body.advance(now_us)
        body.advance(210_000)
        states.append(body.state.tobytes())
    assert len(set(states)) == 1


def test_a_plain_law_through_the_mixer_takes_off_holds_and_stays_level() -> None:
    """The signs of powerDistributionLegacy, 8-bit words and a battery that sags: what an image has to cope with."""
    body = make(None, motor_spread=0.02)
    for now_us in range(0, 4_000_000, 2_000):
        body.advance(now_us)
        if now_us % 10_000 == 0:
            body.draw(now_us, 3.8)
        x, y, z = body.q_WB[1:]
        p, q, r = body.omega_B
        height, climb = body.p_WB[2], body.v_WB[2]
        thrust = 160.0 + 90.0 * (1.0 - height) - 60.0 * climb
        roll, pitch, yaw = -(300.0 * x + 10.0 * p), -(300.0 * y + 10.0 * q), -(200.0 * z + 30.0 * r)
        motors = (
            thrust - roll - pitch - yaw,
            thrust - roll + pitch + yaw,
            thrust + roll + pitch - yaw,
            thrust + roll - pitch + yaw,
        )
        body.set_counts(now_us, [min(max(round(motor), 0), 255) for motor in motors])
    assert body.lost is None
    assert body.p_WB[2] == pytest.approx(1.0, abs=0.05)
    assert abs(body.q_WB[0]) == pytest.approx(1.0, abs=1e-3)
    assert np.abs(body.omega_B).max() < 0.2


def test_a_weak_propeller_gives_its_share_and_no_other_changes() -> None:
    body = spun_up((0.6,) * 4)
    before = body.thrust.copy()
    body.settings["motor.strength.2"].write(0.8 * body.settings["motor.strength.2"].read())
    body.advance(1_001_000)
    assert body.thrust / before == pytest.approx([1.0, 0.8, 1.0, 1.0], rel=1e-6)


def test_a_motor_without_current_runs_out_and_comes_back() -> None:
    body = spun_up((0.6,) * 4)
    body.hold()
    before = body.rpm[2]
    body.settings["motor.current.3"].write(0.0)
    body.advance(1_000_000 + 647_000)
    assert body.rpm[2] == pytest.approx(before * math.exp(-10), rel=1e-6)
    assert body.rpm[1] == pytest.approx(before, rel=1e-6)
    body.settings["motor.current.3"].write(1.0)
    body.advance(3_000_000)
    assert body.rpm[2] == pytest.approx(before, rel=1e-6)


def test_a_stuck_motor_keeps_its_command_until_released() -> None:
    body = spun_up((0.6,) * 4)
    body.hold()
    before = body.rpm[3]
    body.settings["motor.obeys.4"].write(0.0)
    body.set_counts(1_000_000, (0, 0, 0, 0))
    body.advance(2_000_000)
    assert body.rpm[3] == pytest.approx(before, rel=1e-6)
    assert body.rpm[:3] == pytest.approx([0.0] * 3, abs=1.0)
    body.settings["motor.obeys.4"].write(1.0)
    body.set_counts(2_000_000, (0, 0, 0, 0))
    body.advance(3_000_000)
    assert body.rpm[3] == pytest.approx(0.0, abs=1.0)


def test_every_fault_of_a_motor_turns_a_setting_of_it() -> None:
    settings = make().settings
    assert {failure.setting for failure in MOTOR_FAILURES.values()} == set(settings)
    assert all(name[-1] == failure.setting[-1] for name, failure in MOTOR_FAILURES.items())
    assert KINDS["motor.weak.1"].needs == "--profile crazyflie"


def test_vibration_grows_with_the_square_of_the_rotors_speeds() -> None:
    hovering = spun_up((0.625,) * 4, hover_volts() / 0.625)
    assert hovering.vibration == pytest.approx([0.02, 0.5], rel=0.005)
    assert rpm_for(hovering.rotors.fields, 0.029 * G / 4) == pytest.approx(hovering.rpm, rel=0.003)
    one = spun_up((0.625, 0.0, 0.0, 0.0), hover_volts() / 0.625)
    assert one.vibration == pytest.approx([0.01, 0.25], rel=0.005)
    slow = spun_up((0.4,) * 4)
    assert slow.vibration == pytest.approx(
        hovering.vibration * (slow.rpm[0] / hovering.rpm[0]) ** 2, rel=1e-6
    )
    assert make(None).vibration.tolist() == [0.0, 0.0]


def test_seeds_draw_other_motors() -> None:
    one, other = (spun_up((0.6,) * 4, seed=seed, motor_spread=0.02).thrust.copy() for seed in (1, 2))
    assert np.abs(one - other).max() > 1e-5
    assert one == pytest.approx(other, rel=0.15)


def test_cannot_be_placed_where_nothing_is() -> None:
    with pytest.raises(LabError, match="not a finite pose"):
        make().place((0.0, math.nan, 1.0), LEVEL)


# The profile's Crazyflie 2.1 Brushless

BRUSHLESS = load_config("crazyflie-brushless").quadrotor.model_dump() | {"motor_spread": 0.0, "ceiling": 3.0}
# crazyflie-firmware 2a18fc29, platform_defaults_cf21bl.h
BRUSHLESS_THRUST_OF_V = np.polynomial.Polynomial(
    (-0.014058926705279723, 0.04265273261724981, 0.0018327760144017432, 0.0020576974784587178)
)
BRUSHLESS_THRUST2TORQUE, THRUST_MIN, THRUST_MAX = 0.00569278844371417, 0.02136263, 0.2


@pytest.mark.parametrize("volts", [1.5, 2.0, 3.0])
def test_brushless_thrust_is_bitcrazes_measurement_and_torque_its_share(volts: float) -> None:
    body = spun_up((0.75, 0.75, 0.75, 0.75), volts / 0.75, **BRUSHLESS)
    assert body.thrust == pytest.approx(4 * [BRUSHLESS_THRUST_OF_V(volts)], rel=2e-4)
    assert THRUST_MIN < body.thrust[0] < THRUST_MAX
    only = spun_up((0.0, 0.75, 0.0, 0.0), volts / 0.75, **BRUSHLESS)
    torque = only.alpha_B[2] * BRUSHLESS["inertia"][2]
    assert torque / only.thrust[1] == pytest.approx(BRUSHLESS_THRUST2TORQUE, rel=0.12)  # crazyflow's fit


@pytest.mark.parametrize("volts", [3.5, 4.2])
def test_idling_motors_turn_as_the_firmwares_arming_check_expects(volts: float) -> None:
    body = make(**BRUSHLESS)
    body.draw(0, volts)
    body.set_counts(0, 4 * [7000 >> 5])
    assert body.escs is not None
    body.advance(250_000)  # of its 500 ms before the take-off it needs 200
    assert body.escs.min() > 1000
    body.advance(2_000_000)
    assert body.escs.max() < 3500
