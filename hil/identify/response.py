"""The frequency responses of flaps and axes in telemetry, including servo lag and delay."""

from collections.abc import Mapping

import numpy as np

from hil.design.axes import ANGLE, AXES, POSITION, RATE, STEP_S, UNITS, Axis, dynamics
from hil.identify.record import Array
from hil.identify.spectra import Complex

LAG, DELAY = "lag", "delay"  # [s] DELAY is from input to gyro
TICK_DELAYS_S = 0.010  # part not caused by the robot: half a tick of holding, half the gyro's mean
SHOWN = (RATE, ANGLE, POSITION)  # states in telemetry, in the order of an axis' outputs
UNIT = {name: UNITS[term] for axis in AXES for name, term in axis.terms.items()} | {LAG: "s", DELAY: "s"}


def outputs(axis: Axis) -> tuple[int, ...]:
    """Return the axis' signals of `hil.identify.spectra.period_spectra`."""
    turn = (8 + axis.input,) if RATE in axis.states else ()
    return (*turn, *(11 + axis.pose[state] for state in SHOWN if state in axis.pose))


def flap_response(w: Array, lag: float, delay: float) -> Complex:
    """Return the frequency response of a flap to its input, held over ticks."""
    held = np.sinc(w * STEP_S / (2 * np.pi))
    response: Complex = held * np.exp(-1j * w * delay) / (1 + 1j * w * lag)
    return response


def response(axis: Axis, values: Mapping[str, float], w: Array, pose_late: float = 0.0) -> Complex:
    """Return the outputs per input on the lines, (L, outputs); poses are `pose_late` [s] later than their stamps."""
    flow, _ = dynamics(axis, {**values, "flap_rate": 1 / values[LAG]})
    n = len(axis.states)
    states = np.linalg.solve(1j * w[:, None, None] * np.eye(n) - flow[:n, :n], flow[:n, n:])[:, :, 0]
    late = np.exp(-1j * w * pose_late)
    averaged = np.sinc(w * STEP_S / (2 * np.pi))  # the gyro's mean over a tick; its delay is part of `delay`
    seen = [
        states[:, axis.states.index(state)] * (averaged if state == RATE else late)
        for state in SHOWN
        if state in axis.states
    ]
    flap = flap_response(w, values[LAG], values[DELAY])
    return np.stack(seen, axis=1) * flap[:, None]
