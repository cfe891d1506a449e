"""Laws of the servos of the world: counts to angle, PWM period, lag, rate limit, dead band, faults."""

import json
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from hil.world.config import GeometryConfig, PlantConfig, PlantServoConfig, TunnelConfig
from hil.world.floaty.plant import Plant
from hil.world.servos import commanded_angles, next_period_us
from support.paths import VECTORS

ROWS = json.loads((VECTORS / "servo_angles.json").read_text())["rows"]
HOVER = math.radians(25) * np.array([1, -1, 1, -1])
TAU, RATE = 0.05, 10.5


def make(**servos: object) -> Plant:
    config = PlantServoConfig.model_validate({"dead_band": 0.0} | servos)
    plant = Plant(
        GeometryConfig(), PlantConfig(), TunnelConfig(turbulence="none"), config, np.random.default_rng(1)
    )
    plant.hold()
    return plant


def counts_for(angles: np.ndarray) -> tuple[int, ...]:
    """Original board: angle to word to counts, with the as-flown shifts; rounded instead of cut."""
    words = np.asarray(angles) * 31290 + 32767 + np.array([-3600, -5000, -9000, 6200])
    return tuple(round(21000 + word * 21000 / 65535) for word in words)


def test_counts_of_the_original_board_give_its_angles() -> None:
    checked = 0
    for row in ROWS:
        for i, angle in enumerate(commanded_angles(row["counts"], PlantServoConfig().zero_offset, 4 * [9.0])):
            if 0 < row["words"][i] < 65535:
                # The board cuts one word and one count.
                assert angle == pytest.approx(row["flaps_rad"][i], abs=1.5e-4)
                checked += 1
    assert checked > 800


@pytest.mark.parametrize(
    ("width_ms", "moves"), [(0.4999, False), (0.5, True), (1.5, True), (2.5, True), (2.5001, False)]
)
def test_pulses_of_0_5_to_2_5_ms_move_the_servo(width_ms: float, moves: bool) -> None:
    (angle,) = commanded_angles((math.floor(width_ms * 21_000 + 0.5),), (0.0,), (9.0,))
    assert (angle != 9.0) == moves


@pytest.mark.long
@given(st.integers(0, 10**10))
def test_next_period_is_the_first_whole_microsecond_of_the_next_pwm_period(now_us: int) -> None:
    period = Fraction(52501, 21)
    start = (now_us // period + 1) * period
    assert now_us < start <= next_period_us(now_us) < start + 1


def test_small_step_is_first_order_and_large_step_runs_at_the_rate_limit() -> None:
    step = np.array([0.9, -0.9, 0.2, -0.2])
    plant = make()
    plant.set_counts(0, counts_for(HOVER - step))
    plant.advance(2000)
    for now_us in (20_000, 60_000, 150_000):
        plant.advance(now_us)

        def rate(_: float, angle: np.ndarray) -> np.ndarray:
            return np.clip((HOVER - step - angle) / TAU, -RATE, RATE)

        span = (0, (now_us - 2501) * 1e-6)
        reference = solve_ivp(rate, span, HOVER, rtol=1e-9, atol=1e-12, max_step=1e-3).y[:, -1]
        assert plant.flaps == pytest.approx(reference, abs=2e-4)


def test_dead_band_ignores_small_commands_and_stops_early() -> None:
    plant = make(dead_band=0.002)
    plant.set_counts(0, counts_for(np.add(HOVER, [0.0015, -0.0015, 0.05, -0.05])))
    plant.advance(1_000_000)
    assert plant.flaps == pytest.approx(np.add(HOVER, [0, 0, 0.048, -0.048]), abs=1.1e-4)


@given(st.lists(st.tuples(st.integers(0, 20_000), st.floats(-0.2, 0.2)), min_size=1, max_size=12))
@settings(max_examples=60, deadline=None)
def test_every_change_of_counts_acts_from_its_period_on(changes: list[tuple[int, float]]) -> None:
    """Compare with the exact exponential from latch to latch, for changes at any microsecond."""
    plant = make(rate_limit=100.0)
    changes.sort(key=lambda change: change[0])
    latches: dict[int, float] = {}
    for now_us, offset in changes:
        counts = counts_for(HOVER + offset)
        plant.set_counts(now_us, counts)
        latches[next_period_us(now_us)] = commanded_angles(counts, PlantServoConfig().zero_offset, HOVER)[0]
    plant.advance(30_000)
    angle, command, since_us = float(HOVER[0]), float(HOVER[0]), 0
    for latch_us, target in [*latches.items(), (30_000, 0.0)]:
        angle = command + (angle - command) * math.exp(-(latch_us - since_us) / 50_000)
        command, since_us = target, latch_us
    assert plant.flaps[0] == pytest.approx(angle, abs=1e-9)


def test_without_pulses_a_servo_keeps_its_angle() -> None:
    plant = make()
    plant.set_counts(0, (0, 60_000, *counts_for(HOVER + 0.1)[2:]))
    plant.advance(1_000_000)
    assert plant.flaps == pytest.approx(np.add(HOVER, [0, 0, 0.1, 0.1]), abs=1e-4)


def test_faults_act_on_their_servo_and_heal() -> None:
    plant = make(trim_error=(0.05, 0, 0, 0), speed=(1, 0, 0.5, 1))
    plant.set_counts(0, counts_for(HOVER + 0.1))
    plant.advance(2000)
    assert plant.flaps[0] > HOVER[0]  # a trim error acts at once
    plant.advance(52_501)
    plant.advance(53_000)
    moved = plant.flaps - HOVER
    assert moved[1] == 0
    assert moved[2] == pytest.approx(0.1 * (1 - math.exp(-0.0505 * 0.5 / TAU)), rel=0.01)
    assert moved[3] == pytest.approx(0.1 * (1 - math.exp(-0.0505 / TAU)), rel=0.01)
    plant.advance(1_000_000)
    assert plant.flaps == pytest.approx(np.add(HOVER, [0.15, 0, 0.1, 0.1]), abs=1e-4)
    for servo in (1, 2, 3, 4):
        plant.settings[f"servo.trim.{servo}"].write(0.0)
        plant.settings[f"servo.pace.{servo}"].write(1.0)
    plant.advance(2_000_000)
    assert plant.flaps == pytest.approx(HOVER + 0.1, abs=1e-4)
