"""The geometry's part in an identification: how the effects of inputs and tilt bend with the flap angles.

Plates twist the robot by about sin(phi) cos(phi)^2: the slope changes by several percent per degree, also through the
other inputs. A linear fit of such a response finds a mean over all that. The profile's geometry gives the curvature of
the effects, and the flight their size: the records are straightened before the fit, whose constants then refer to the
mean flap angles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from firmware_py.geometry import from_euler_zyx
from hil.config import LabConfig
from hil.laboratory.robot import Streams
from hil.research.identify.record import Array, Record
from hil.world.floaty.plant import Plant
from hil.world.floaty.shape import MIX, SIGNS
from hil.world.motion import GRAVITY

# Inputs with the plates' effect, and the axis of B about which they turn; the identified pitch and height differ.
BENT = {0: 0, 2: 2}
SIDEWAYS, HEIGHT = 1, 2  # y, whose force depends on flaps and roll and bends with both; z
STEP = 0.02  # [rad, m/s, rad/s] of the differences
Rates = tuple[float, float, float]
STILL: Rates = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Straightened:
    """A record as if effects were linear, at its own times."""

    u: Array  # (N, 4) [rad]
    bent: Array  # (N, 2) [m/s2] the nonlinear accelerations along y and z


def straightened(record: Record) -> Straightened:
    """Return inputs as if their effects were linear, and the nonlinear accelerations along y and z.

    Along z these are the effects of roll and sideways velocity on a robot that leans in a side wind. The flaps follow
    their commands by the profile's lag. Records of other robots than Floaty stay unchanged: their curvature is unknown.
    """
    if not record.config.robot.has_plates:
        return Straightened(record.u, np.zeros((len(record.t), 2)))
    step, config = record.period_s, record.config
    share = 1.0 - np.exp(-step * config.model.flap_rate)
    t = np.arange(record.mean_t[0], record.mean_t[-1] + step, step)
    u = np.stack([np.interp(t, record.mean_t, column) for column in record.u.T], axis=1)
    mean = u.mean(axis=0)
    moved = lfilter([share], [1.0, share - 1.0], u - mean, axis=0)
    roll, y = (np.interp(t, record.pose_t, record.pose[:, column]) for column in (3, SIDEWAYS))
    middle, speed = float(roll.mean()), np.gradient(y, step)
    motion = _plates(config)

    def aside(speed: float, roll: float = middle) -> float:
        return float(motion(mean, roll, speed)[SIDEWAYS])

    model = config.model
    # In this flow a robot with this lean stays in place.
    wind = (model.y_u1 * mean[0] + model.y_roll * middle) / model.y_vy
    damping = (aside(STEP - wind) - aside(-STEP - wind)) / (2 * STEP)
    tilting = (aside(-wind, middle + STEP) - aside(-wind, middle - STEP)) / (2 * STEP)
    slopes = [
        (motion(mean + more, middle, -wind) - motion(mean - more, middle, -wind)) / (2 * STEP)
        for more in STEP * np.eye(4)
    ]
    level = np.array([motion(mean + one, middle, -wind) for one in moved])
    every = np.array([
        motion(mean + one, tilt, along - wind)
        for one, tilt, along in zip(moved, roll.tolist(), speed.tolist(), strict=True)
    ])  # fmt: skip
    scale = GRAVITY / level[:, 2].mean()  # the mass comes from the flight, not from the profile
    straight = record.u.copy()
    for number, about in BENT.items():
        more = level[:, 3 + about] / slopes[number][3 + about] - moved[:, number]
        commanded = lfilter([1.0 / share, (share - 1.0) / share], [1.0], more - more.mean())
        straight[:, number] += np.interp(record.mean_t, t, commanded)
    linear = slopes[0][SIDEWAYS] * moved[:, 0] + tilting * (roll - middle) + damping * speed
    bent = scale * np.column_stack([every[:, SIDEWAYS] - linear, every[:, 2] - level[:, 2]])
    bent -= bent.mean(axis=0)
    return Straightened(straight, np.stack([np.interp(record.t, t, one) for one in bent.T], axis=1))


def turns_of(record: Record) -> dict[str, float]:
    """Return x_rate and y_rate [m/s/rad] of plates at the mean flap angles: the push on the robot by turning alone."""
    motion, mean = _plates(record.config), record.u.mean(axis=0)
    about_x = motion(mean, turn=(STEP, 0.0, 0.0)) - motion(mean, turn=(-STEP, 0.0, 0.0))
    about_y = motion(mean, turn=(0.0, STEP, 0.0)) - motion(mean, turn=(0.0, -STEP, 0.0))
    return {"y_rate": float(about_x[1]) / (2 * STEP), "x_rate": float(about_y[0]) / (2 * STEP)}


def plant_of(config: LabConfig) -> Plant:
    """Return a profile's plant, whose gusts are not used."""
    return Plant(config.geometry, config.plant, config.tunnel, config.actuators, Streams.of_seed(1).gusts)


def _plates(config: LabConfig) -> Callable[..., Array]:
    """Return a function from inputs, roll, velocity along y and rates to specific force (W) and angular acceleration (B).

    Both are for plates alone in calm air, (6,) together.
    """
    plain = config.plant.model_copy(update={"variant": "plate", "constant_factors": {}, "mass_factor": 1.0})
    air = config.tunnel.model_copy(update={"side_wind": (0.0, 0.0, 0.0)})
    plates = plant_of(config.model_copy(update={"plant": plain, "tunnel": air}))
    hover = SIGNS * config.allocation.hover_angle
    place = (0.0, 0.0, config.tunnel.hover_height)

    def motion(inputs: Array, roll: float = 0.0, speed: float = 0.0, turn: Rates = STILL) -> Array:
        q_WB = from_euler_zyx(roll, 0.0, 0.0)
        plates.place(place, q_WB, (0.0, speed, 0.0), turn, flaps=(hover + MIX @ inputs).tolist())
        return np.array([*plates.acceleration_W[:2], plates.acceleration_W[2] + GRAVITY, *plates.alpha_B])

    return motion
