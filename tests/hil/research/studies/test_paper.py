"""Where the paper contradicts itself, computed: what profiles/floaty.toml decides and why.

Sources: the paper's Table of dynamics constants, its Methods and its main text; the gains are the author's firmware's.
"""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_py.config import ControllerConfig, ModelConfig
from hil.config import load_config
from hil.research.studies.paper_rows import ROWS as PAPER_ROWS
from hil.world.floaty.correction import PAPER_TABLE

ROWS = PAPER_TABLE  # value, uncertainty
METHODS_PITCH_U2 = -1066.0  # paper, Methods, "Data-driven estimation of dynamics constants"
G, AIRSPEED = 9.81, 10.0  # [m/s2], [m/s] paper, Experimental platform
FLAP_LAG = 0.05  # [s] the author's firmware, flapTimeConst = 20 1/s

MODEL: ModelConfig = load_config("floaty").model
AUTHOR: ControllerConfig = load_config("as-flown").controller
Matrix = NDArray[np.float64]


def test_the_paper_s_claims_are_judged_by_the_numbers_in_their_words() -> None:
    claims = {(one.text, one.bound) for row in PAPER_ROWS.values() for one in row.claims.values()}
    assert claims == {
        ("", None), ("3.4 W", None), ("33 min", 33.0), ("10 W/kg", 10.05), ("< 0.5 s", 0.5), ("> 1", 1.0), ("0", 0.0),
        ("< 20 deg", math.radians(20.0)), ("> 80 deg/s", math.radians(80.0)), ("about 1", 0.95), ("mostly", 0.5),
        ("always", 1.0), ("all 9", 9.0), ("yes", 1.0), ("hovers", 0.1),
    }  # fmt: skip


def closed_loop(
    angle: float, rate: float, velocity: float, u: float, force_angle: float, force_velocity: float, force_u: float,
    gains: tuple[float, float, float, float],
) -> float:  # fmt: skip
    """Return the largest real part [1/s] of one lateral axis: position, velocity, angle, rate, u behind the flap lag.

    `gains` are those of the position error, velocity, angle and rate in u = k e - k_v v - k_a angle - k_r rate.
    """
    k, k_v, k_a, k_r = gains
    A: Matrix = np.array([
        [0, 1, 0, 0, 0],
        [0, force_velocity, force_angle, 0, force_u],
        [0, 0, 0, 1, 0],
        [0, velocity, angle, rate, u],
        [-k / FLAP_LAG, -k_v / FLAP_LAG, -k_a / FLAP_LAG, -k_r / FLAP_LAG, -1 / FLAP_LAG],
    ])  # fmt: skip
    return float(np.linalg.eigvals(A).real.max())


def pitch_loop(pitch_u2: float, sign_of_x_gains: float = 1.0) -> float:
    gains = (
        sign_of_x_gains * AUTHOR.gain_x,
        sign_of_x_gains * AUTHOR.gain_vx,
        AUTHOR.gain_pitch,
        AUTHOR.gain_q,
    )
    m = MODEL
    return closed_loop(m.pitch_pitch, m.pitch_rate, m.pitch_vx, pitch_u2, m.x_pitch, m.x_vx, m.x_u2, gains)


def roll_loop(controller: ControllerConfig) -> float:
    gains = (controller.gain_y, controller.gain_vy, controller.gain_roll, controller.gain_p)
    m = MODEL
    return closed_loop(m.roll_roll, m.roll_rate, m.roll_vy, m.roll_u1, m.y_roll, m.y_vy, m.y_u1, gains)


def test_model_on_board_is_the_papers_table_but_for_the_sign_of_pitch() -> None:
    for name, (value, _) in ROWS.items():
        if name != "pitch_u2":
            assert getattr(MODEL, name) == value, name
    assert MODEL.pitch_u2 == METHODS_PITCH_U2
    value, error = ROWS["pitch_u2"]
    assert abs(abs(MODEL.pitch_u2) - value) < error  # the magnitudes agree, the signs do not
    assert MODEL.flap_rate == pytest.approx(1 / FLAP_LAG)


def test_couplings_to_horizontal_velocity_are_those_of_any_flat_plate_model() -> None:
    assert MODEL.y_vy == pytest.approx(-(G + MODEL.y_roll) / AIRSPEED, abs=5e-4)
    assert MODEL.x_vx == pytest.approx(-(G - MODEL.x_pitch) / AIRSPEED, abs=5e-4)
    assert MODEL.roll_vy == pytest.approx(-MODEL.roll_roll / AIRSPEED, abs=5e-4)
    assert MODEL.pitch_vx == pytest.approx(MODEL.pitch_pitch / AIRSPEED, abs=5e-4)
    assert MODEL.z_vz == pytest.approx(-2 * G / AIRSPEED, abs=ROWS["z_vz"][1])


def test_authors_gains_fly_only_the_pitch_constant_of_the_methods() -> None:
    assert pitch_loop(METHODS_PITCH_U2) == pytest.approx(-1.54, abs=0.01)
    assert pitch_loop(ROWS["pitch_u2"][0]) == pytest.approx(1.46, abs=0.01)


def test_tables_pitch_constant_needs_negated_x_gains() -> None:
    assert pitch_loop(ROWS["pitch_u2"][0], -1.0) == pytest.approx(-0.72, abs=0.01)
    assert pitch_loop(METHODS_PITCH_U2, -1.0) > 0.0


def test_authors_y_loop_swings_and_the_tuned_one_does_not() -> None:
    assert 0.0 < roll_loop(AUTHOR) == pytest.approx(0.26, abs=0.02)
    assert roll_loop(load_config("floaty").controller) < -0.5


def test_rate_constants_of_the_table_are_rate_gain_times_input_constant() -> None:
    assert AUTHOR.gain_p * MODEL.roll_u1 == pytest.approx(-ROWS["roll_rate"][0], rel=0.05)
    assert AUTHOR.gain_q * ROWS["pitch_u2"][0] == pytest.approx(
        -ROWS["pitch_rate"][0], abs=ROWS["pitch_rate"][1]
    )
    assert AUTHOR.gain_r * MODEL.yaw_u3 == pytest.approx(-ROWS["yaw_rate"][0], rel=1e-9)


def test_papers_arithmetic_gives_minus_14_not_minus_16() -> None:
    gain_1, gain_2, closed_1, closed_2 = -0.2, -0.15, -60.0, -48.5  # Methods
    a = (closed_1 - closed_2) / (gain_1 - gain_2)
    assert a == pytest.approx(ROWS["roll_u1"][0])
    assert closed_1 - a * gain_1 == pytest.approx(-14.0)
    assert closed_2 - a * gain_2 == pytest.approx(-14.0)
    assert abs(-14.0 - ROWS["roll_roll"][0]) < ROWS["roll_roll"][1]  # within what the Table states
    assert AUTHOR.gain_roll == -gain_1


def test_papers_roll_poles_need_a_rate_constant_of_minus_1_not_minus_40() -> None:
    stated = np.array([-0.5 + 4j, -0.5 - 4j])  # main text, "Embodied intelligence"
    _, rate, stiffness = np.poly(stated).real
    assert rate == pytest.approx(1.0)
    assert -stiffness == pytest.approx(ROWS["roll_roll"][0], abs=0.3)
    table = np.roots([1, -ROWS["roll_rate"][0], -ROWS["roll_roll"][0]])
    assert sorted(table) == pytest.approx([-39.6, -0.40], abs=0.01)  # real: no swing at all


def test_profiles_angles_are_the_papers_degrees() -> None:
    profile = load_config("floaty")
    assert profile.allocation.hover_angle == pytest.approx(math.radians(25), abs=1e-6)
    assert profile.controller.limit_u == pytest.approx(1.5 * math.radians(25), abs=1e-6)
    assert AUTHOR.limit_u3 == pytest.approx(math.radians(37.5), abs=1e-6)
    assert profile.predictor.default_age_us == 40_000
    assert profile.predictor.horizon == 4
