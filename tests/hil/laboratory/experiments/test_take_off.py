"""The net under the robot, and the flight that begins and ends on it."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hil.laboratory.experiments.take_off import CONTROLLER_ON, FANS_OFF, LANDING_FROM, STANDING_Z
from hil.laboratory.files.recorder import load_events, load_log
from hil.laboratory.metrics import column, free_flight
from hil.world.config import GeometryConfig, PlantConfig, PlantServoConfig, TunnelConfig
from hil.world.floaty.plant import Plant
from support.flights import flown

LEVEL = (1.0, 0.0, 0.0, 0.0)
GROUND = PlantConfig().ground
GRAVITY, MASS = 9.81, 0.340
HOVER, FAILSAFE = math.radians(25.0), 3


def standing(**changes: float) -> Plant:
    """A robot in still air, with limits and tether out of its way."""
    config = PlantConfig.model_validate(
        {"tether": {"length": 5.0}, "limits": {"below": 1.2}, "ground": changes}
    )
    calm = TunnelConfig(turbulence="none")
    plant = Plant(GeometryConfig(), config, calm, PlantServoConfig(), np.random.default_rng(1))
    plant.tunnel.set_fan_factor(0.0)
    return plant


@pytest.mark.long
def test_a_drop_bounces_by_spring_and_damper() -> None:
    def motion(t: float, state: np.ndarray) -> list[float]:
        z, v = state
        depth = GROUND.foot_below - z
        push = max(GROUND.stiffness * depth - GROUND.damping * v, 0.0) if depth > 0 else 0.0
        return [v, 4 * push / MASS - GRAVITY]

    plant, start = standing(), GROUND.foot_below + 0.02
    plant.place((0.0, 0.0, start), LEVEL)
    times = np.arange(1, 201) * 1e-3
    expected = solve_ivp(motion, (0.0, 0.2), [start, 0.0], t_eval=times, max_step=1e-4, rtol=1e-8).y[0]
    got = []
    for time in times:
        plant.advance(round(time * 1e6))
        got.append(float(plant.p_WB[2]))
    assert np.abs(got - expected).max() < 3e-4  # the air of the fall, and steps of 1 ms
    assert max(got[60:]) < start


def test_friction_brakes_a_slide_and_holds_the_rest() -> None:
    plant = standing()
    plant.place((0.0, 0.0, STANDING_Z), LEVEL, v_WB=(0.6, 0.0, 0.0))
    plant.advance(50_000)
    assert plant.v_WB[0] == pytest.approx(0.6 - GROUND.friction * GRAVITY * 0.05, rel=0.05)
    plant.advance(1_000_000)
    assert abs(plant.v_WB[0]) < 1e-3
    plant.push((0.2, 0.1, 0.0))  # less than friction
    before = plant.p_WB.copy()
    plant.advance(1_100_000)
    assert np.abs(plant.p_WB - before).max() < 2e-3


def test_a_tilted_drop_comes_to_rest_upright_without_gaining_energy() -> None:
    plant = standing()
    tilt = math.radians(15.0)
    plant.place(
        (0.0, 0.0, 0.10), (math.cos(tilt / 2), 0.6 * math.sin(tilt / 2), 0.8 * math.sin(tilt / 2), 0.0)
    )
    highest = 0.10
    for ms in range(1, 1500):
        plant.advance(1000 * ms)
        energy = 0.5 * plant.v_WB @ plant.v_WB + GRAVITY * plant.p_WB[2]
        assert energy <= GRAVITY * highest + 1e-3
    assert 1.0 - 2.0 * (plant.q_WB[1] ** 2 + plant.q_WB[2] ** 2) == pytest.approx(1.0, abs=1e-6)
    assert plant.p_WB[2] == pytest.approx(STANDING_Z, abs=2e-4)


def test_the_net_ends_where_the_feet_are_above_it() -> None:
    plant, free = standing(), standing(height=-2.0)
    for one in (plant, free):
        one.place((0.0, 0.0, 0.4), (0.9, 0.1, -0.2, 0.3))
        one.advance(200_000)
    assert plant.p_WB[2] > 0.15
    assert plant.state.tobytes() == free.state.tobytes()


@pytest.mark.long
@pytest.mark.parametrize(
    ("profile", "seed"),
    [
        ("floaty", 1),
        *(
            pytest.param(*flight, marks=pytest.mark.long)
            for flight in (("as-flown", 1), ("floaty", 2), ("as-flown", 2))
        ),
    ],
)
def test_take_off_and_landing_hold_their_limits(tmp_path: Path, profile: str, seed: int) -> None:
    result = flown(tmp_path / "run", "take-off-landing", profile=profile, seed=seed)
    assert result.passed, [str(verdict) for verdict in result.verdicts if not verdict.holds]


@pytest.mark.long
def test_the_operator_closes_the_loop_and_opens_it_again(tmp_path: Path) -> None:
    flown(tmp_path / "run", "take-off-landing")
    log = free_flight(load_log(tmp_path / "run"))
    times = 1e-6 * (column(log, "t") - column(log, "t")[0])
    z, state = column(log, "truth.z"), column(log, "supervisor.state")
    flaps = column(log, *(f"truth.flap_{number}" for number in (1, 2, 3, 4)))
    off = (times < CONTROLLER_ON - 0.1) | (times > FANS_OFF + 1.0)
    assert (state[off] == FAILSAFE).all()
    assert np.abs(np.abs(flaps[off]) - HOVER).max() < math.radians(0.5)
    assert (state[(times > CONTROLLER_ON + 0.1) & (times < FANS_OFF - 0.1)] != FAILSAFE).all()
    assert np.abs(z[off] - STANDING_Z).max() < 0.005
    assert z[(times > LANDING_FROM - 5.0) & (times < LANDING_FROM)].min() > 1.0
    texts = [event["text"] for event in load_events(tmp_path / "run")]
    assert texts.count("supervisor: failsafe, disarmed") == 2
    assert "fans from 0% to 93% of the flight speed" in texts
