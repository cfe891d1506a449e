"""The four decoupled axes of the linear model: which constants each has, and what its log must contain.

    flap' = (u(t - delay) - flap) / lag
    roll:  p' = a flap + b p + c roll + d vy      y:  vy' = e flap + h roll + g vy + k p
           (pitch and x alike)
    yaw:   r' = a flap + b r                      z:  vz' = a flap + g vz

Symbols of the paper's Methods; names are those of a profile's [model], except k: flaps above the centre of mass push
sideways when the robot turns, which neither the Table nor the model on board contains.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hil.identify.record import Array
from hil.identify.spectra import Complex

LAG, DELAY = "lag", "delay"  # [s]
TICK_S = 0.01  # over which inputs are held


@dataclass(frozen=True, slots=True)
class Axis:
    """One input and its outputs. `outputs` index the signals of `hil.identify.spectra.period_spectra`."""

    name: str
    input: int
    constants: tuple[str, ...]  # a, b, c, d, e, h, g of those that the axis has, by its kind
    outputs: tuple[int, ...]
    units: tuple[str, ...]


TURN_UNITS = ("1/s²", "1/s", "1/s²", "rad/s/m", "m/s²/rad", "m/s²/rad", "1/s", "m/s/rad")
AXES = (
    Axis(
        "roll",
        0,
        ("roll_u1", "roll_rate", "roll_roll", "roll_vy", "y_u1", "y_roll", "y_vy", "y_rate"),
        (8, 14, 12),
        TURN_UNITS,
    ),
    Axis(
        "pitch",
        1,
        ("pitch_u2", "pitch_rate", "pitch_pitch", "pitch_vx", "x_u2", "x_pitch", "x_vx", "x_rate"),
        (9, 15, 11),
        TURN_UNITS,
    ),
    Axis("yaw", 2, ("yaw_u3", "yaw_rate"), (10, 16), ("1/s²", "1/s")),
    Axis("z", 3, ("z_u4", "z_vz"), (13,), ("m/s²/rad", "1/s")),
)
UNITS = {name: unit for axis in AXES for name, unit in zip(axis.constants, axis.units, strict=True)} | {
    LAG: "s",
    DELAY: "s",
}


def flap_response(w: Array, lag: float, delay: float) -> Complex:
    """Return the frequency response of a flap to its input, held over ticks."""
    held = np.sinc(w * TICK_S / (2 * np.pi))
    response: Complex = held * np.exp(-1j * w * delay) / (1 + 1j * w * lag)
    return response


def response(axis: Axis, values: Mapping[str, float], w: Array, pose_late: float = 0.0) -> Complex:
    """Return the outputs per input on the lines, (L, outputs); poses are `pose_late` [s] later than their stamps."""
    s = 1j * w
    f = flap_response(w, values[LAG], values[DELAY])
    late = np.exp(-s * pose_late)
    averaged = np.sinc(w * TICK_S / (2 * np.pi))  # the gyro's mean over a tick; its delay is part of `delay`
    k = [values[name] for name in axis.constants]
    if len(k) == 8:
        a, b, c, d, e, h, g, of_rate = k
        aside = h + of_rate * s
        angle = f * (a + d * e / (s - g)) / (s * s - b * s - c - d * aside / (s - g))
        place = (e * f + aside * angle) / (s - g) / s
        return np.stack([averaged * s * angle, late * angle, late * place], axis=1)
    first = k[0] * f / (s - k[1])
    if axis.name == "yaw":
        return np.stack([averaged * first, late * first / s], axis=1)
    return np.stack([late * first / s], axis=1)
