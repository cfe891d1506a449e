"""Laws of the air: mean profile, gust statistics, and the knobs of the tunnel."""

import math
import re
from collections.abc import Callable

import numpy as np
import pytest
from pydantic import ValidationError

from hil.errors import LabError
from hil.world.config import GeometryConfig, PlantConfig, PlantServoConfig, TunnelConfig
from hil.world.floaty.plant import Plant
from hil.world.tunnel import Tunnel

LEVEL = (1.0, 0.0, 0.0, 0.0)


def make(**tunnel: object) -> Plant:
    config = TunnelConfig.model_validate({"turbulence": "none", "hover_height": 1.0} | tunnel)
    return Plant(GeometryConfig(), PlantConfig(), config, PlantServoConfig(), np.random.default_rng(5))


def flow(plant: Plant, x: float, y: float, z: float) -> list[float]:
    plant.place((x, y, z), LEVEL)
    return plant.flow_W.tolist()


def test_mean_flow_falls_with_radius_and_height() -> None:
    plant = make(speed=9.0)
    assert flow(plant, 0, 0, 1.0) == pytest.approx([0, 0, 9.0])
    assert flow(plant, 0.27, -0.36, 1.0) == pytest.approx([0, 0, 4.5])
    assert flow(plant, 0.225, 0, 1.0) == pytest.approx([0, 0, 9.0 * 64 / 65])
    assert flow(plant, 0, 0, 1.4) == pytest.approx([0, 0, 9.0 * 0.98])


def test_fans_scale_what_they_blow_and_not_the_side_wind() -> None:
    plant = make(side_wind=(1.0, 2.0, 3.0), fan_factor=0.5)
    assert flow(plant, 0, 0, 1.0) == pytest.approx([1, 2, 8])
    plant.tunnel.set_fan_factor(0.8)
    plant.tunnel.set_side_wind(-1.0, 0.5)
    assert flow(plant, 0, 0, 1.0) == pytest.approx([-1, 0.5, 8])


def test_blocked_patch_takes_half_its_depth_at_its_radius_and_clears() -> None:
    plant = make()
    plant.tunnel.block(0.06, 0.08, 0.1, 0.4)
    free = 10 / (1 + (0.1 / 0.45) ** 6)
    assert flow(plant, 0.06, 0.08, 1.0)[2] == pytest.approx(free * 0.6)
    assert flow(plant, 0, 0, 1.0)[2] == pytest.approx(10 * 0.8)
    plant.tunnel.block(0, 0, 1, 0)
    assert flow(plant, 0, 0, 1.0)[2] == pytest.approx(10)


def test_blocking_one_side_unloads_the_flaps_there() -> None:
    plant = make()
    plant.tunnel.block(0.1, 0.0, 0.08, 0.5)
    flow(plant, 0, 0, 1.0)
    lift = plant.plate_forces_W[1:, 2]
    assert lift[0] == pytest.approx(lift[1])
    assert lift[2] == pytest.approx(lift[3])
    assert lift[0] < 0.7 * lift[2]


@pytest.mark.parametrize(
    ("level", "rms"),
    [
        ("T0", [0.35, 0.35, 0.20, 0.05, 0.05, 0.03] + [0.40] * 4 + [0.10] * 4),
        ("T1", [0.40, 0.40, 0.20, 0.06, 0.06, 0.03] + [0.50] * 4 + [0.15] * 4),
    ],
)
@pytest.mark.long
def test_gusts_have_the_levels_and_time_constants_of_the_specification(level: str, rms: list[float]) -> None:
    tau = np.array([0.015] * 3 + [0.4] * 3 + [0.010] * 4 + [0.15] * 4)
    plant = make(turbulence=level)
    plant.hold()
    series = np.empty((120_000, 14))
    for step in range(len(series)):
        plant.advance(1000 * (step + 1))
        series[step] = plant.blocks.air.fields.gusts
    series = series[5000:]
    spread = 3.5 * np.sqrt(tau / 115) + 0.005  # an estimate of the rms over 115 s varies by sqrt(tau / 115 s)
    assert (np.abs(series.std(axis=0) / rms - 1) < spread).all()
    decay = np.exp(-1e-3 / tau)  # exact discretisation: s' = decay s + white noise of rms sqrt(1 - decay^2)
    kicks = series[1:] - decay * series[:-1]
    assert kicks.std(axis=0) == pytest.approx(rms * np.sqrt(1 - decay**2), rel=0.01)
    for i in range(14):
        assert abs(np.corrcoef(kicks[1:, i], kicks[:-1, i])[0, 1]) < 0.015
        assert abs(np.corrcoef(kicks[:, i], series[:-1, i])[0, 1]) < 0.015
    crossed = np.corrcoef(series[:, [0, 1, 2, 6, 7, 8, 9]].T) - np.eye(7)
    assert np.abs(crossed).max() < 0.06


def test_gusts_shake_every_flap_on_its_own() -> None:
    plant = make(turbulence="T1")
    plant.hold()
    lifts = np.empty((20_000, 4))
    for step in range(len(lifts)):
        plant.advance(1000 * (step + 1))
        lifts[step] = plant.plate_forces_W[1:, 2]
    # Lift goes with the square of the wind: 2 x 0.52 m/s own gust, 0.20 common vertical, 0.40 horizontal on 20 deg slopes
    assert lifts.std(axis=0) / lifts.mean(axis=0) == pytest.approx(4 * [0.118], rel=0.1)
    assert np.abs(np.corrcoef(lifts.T) - np.eye(4)).max() < 0.35


def test_gusts_grow_towards_the_edge_and_then_no_more() -> None:
    plant = make(turbulence="T1")
    plant.hold()
    plant.advance(100_000)
    u = flow(plant, 0, 0, 1.0)[0]
    assert u != 0
    assert flow(plant, 0.25, 0, 1.0)[0] == pytest.approx(2 * u)
    assert flow(plant, 0, 0.45, 1.0)[0] == pytest.approx(6 * u)
    plant.tunnel.set_gust_scale(0.5)
    assert flow(plant, 0, 0, 1.0)[0] == pytest.approx(0.5 * u)


@pytest.mark.parametrize(
    ("knob", "low", "high"),
    [
        (Tunnel.set_fan_factor, 0.0, 2.0),
        (Tunnel.set_gust_scale, 0.0, 5.0),
        (lambda tunnel, wind: tunnel.set_side_wind(wind, 0.0), -20.0, 20.0),
        (lambda tunnel, wind: tunnel.set_side_wind(0.0, 0.0, wind), -20.0, 20.0),
        (lambda tunnel, x: tunnel.block(x, 0.0, 0.1, 0.5), -2.0, 2.0),
        (lambda tunnel, y: tunnel.block(0.0, y, 0.1, 0.5), -2.0, 2.0),
        (lambda tunnel, radius: tunnel.block(0.0, 0.0, radius, 0.5), 0.01, 5.0),
        (lambda tunnel, depth: tunnel.block(0.0, 0.0, 0.1, depth), 0.0, 1.0),
    ],
)
def test_knobs_take_what_is_within_their_bounds_and_nothing_else(
    knob: Callable[[Tunnel, float], None], low: float, high: float
) -> None:
    tunnel = make().tunnel
    for value in (low, high):
        knob(tunnel, value)
        for outside in (math.nextafter(low, -math.inf), math.nextafter(high, math.inf), math.nan):
            with pytest.raises(LabError, match=re.escape(f"= {outside}: outside {low:g}..{high:g}")):
                knob(tunnel, outside)


def test_an_unknown_turbulence_is_refused() -> None:
    with pytest.raises(ValidationError):
        TunnelConfig.model_validate({"turbulence": "T2"})
