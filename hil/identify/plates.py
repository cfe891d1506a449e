"""What the drawings contribute to an identification: how the effect of inputs and tilt bends with the flap angles.

Plates twist the robot by about sin(phi) cos(phi)^2: the slope changes by several percent per degree, also with what the
other inputs do to the flaps. A linear fit of such a response finds a mean over all that. The geometry of the profile says
how the effects bend, and the flight what they are: the records are straightened before the fit, whose constants are then
those at the mean flap angles.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from firmware_py.geometry import from_euler_zyx
from hil.config import LabConfig
from hil.floaty.plant import Plant
from hil.floaty.shape import MIX, SIGNS
from hil.identify.record import Array, Record
from hil.laboratory.robot import Streams
from hil.world.motion import GRAVITY

# Inputs that act as the plates do, and the axis of B about which they turn; the identified pitch and height act otherwise.
BENT = {0: 0, 2: 2}
SIDEWAYS = 1  # y: its force depends on flaps and roll, and bends with both
STEP = 0.02  # [rad] of the differences


def straightened(record: Record) -> tuple[Array, Array]:
    """Return the inputs (N, 4) [rad] as if their effects were linear, and the acceleration along y (N,) [m/s2] that is not.

    The flaps follow their commands by the profile's lag.
    """
    step, config = record.period_s, record.config
    share = 1.0 - np.exp(-step * config.model.flap_rate)
    t = np.arange(record.u_t[0], record.u_t[-1] + step, step)
    u = np.stack([np.interp(t, record.u_t, column) for column in record.u.T], axis=1)
    mean = u.mean(axis=0)
    moved = lfilter([share], [1.0, share - 1.0], u - mean, axis=0)
    roll = np.interp(t, record.pose_t, record.pose[:, 3])
    middle = float(roll.mean())
    motion = _plates(config)

    every = np.array([motion(mean + one, tilt) for one, tilt in zip(moved, roll.tolist(), strict=True)])
    level = np.array([motion(mean + one, middle) for one in moved])
    every[:, SIDEWAYS] *= GRAVITY / every[:, 2].mean()  # the flight, not the profile, knows the mass
    slopes = [
        (motion(mean + aside, middle) - motion(mean - aside, middle)) / (2 * STEP)
        for aside in STEP * np.eye(4)
    ]
    straight = record.u.copy()
    for number, about in BENT.items():
        more = level[:, 3 + about] / slopes[number][3 + about] - moved[:, number]
        commanded = lfilter([1.0 / share, (share - 1.0) / share], [1.0], more - more.mean())
        straight[:, number] += np.interp(record.u_t, t, commanded)
    causes = np.column_stack([moved[:, 0], roll - middle])
    tilted = (motion(mean, middle + STEP) - motion(mean, middle - STEP))[SIDEWAYS] / (2 * STEP)
    scale = GRAVITY / motion(mean, middle)[2]
    aside = every[:, SIDEWAYS] - causes @ np.array([slopes[0][SIDEWAYS], tilted]) * scale
    return straight, np.interp(record.t, t, aside - aside.mean())


def turns_of(record: Record) -> dict[str, float]:
    """Return x_rate and y_rate [m/s/rad] of plates at the mean flap angles: by how much turning alone pushes the robot."""
    motion, mean = _plates(record.config), record.u.mean(axis=0)
    about_x = motion(mean, 0.0, (STEP, 0.0, 0.0)) - motion(mean, 0.0, (-STEP, 0.0, 0.0))
    about_y = motion(mean, 0.0, (0.0, STEP, 0.0)) - motion(mean, 0.0, (0.0, -STEP, 0.0))
    return {"y_rate": float(about_x[1]) / (2 * STEP), "x_rate": float(about_y[0]) / (2 * STEP)}


def _plates(config: LabConfig) -> Callable[..., Array]:
    """Return the specific force (W) and angular acceleration (B), (6,), of plates alone by inputs, roll and rates."""
    plain = config.plant.model_copy(update={"variant": "plate", "constant_factors": {}, "mass_factor": 1.0})
    air = config.tunnel.model_copy(update={"side_wind": (0.0, 0.0, 0.0)})
    plates = Plant(config.geometry, plain, air, config.actuators, Streams.of_seed(1).gusts)
    hover = SIGNS * config.allocation.hover_angle
    place = (0.0, 0.0, config.tunnel.hover_height)

    def motion(inputs: Array, roll: float, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
        q_WB = from_euler_zyx(roll, 0.0, 0.0)
        plates.place(place, q_WB, omega_B=turn, flaps=(hover + MIX @ inputs).tolist())
        return np.array([*plates.acceleration_W[:2], plates.acceleration_W[2] + GRAVITY, *plates.alpha_B])

    return motion
