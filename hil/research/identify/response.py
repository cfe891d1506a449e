"""What an identified model says of telemetry: frequency responses of flaps and axes, and one-step predictions.

The responses include servo lag and delay. A one-step prediction is the next sample as predicted by the model in the
board's stationary filter. A simulation from the input alone ignores the flow; every sample corrects a prediction, so that
its errors are the flow's accelerations of one step, the noise of the sensors, and the errors of the model. A step is from
one row of the telemetry to the next.
"""

from collections.abc import Mapping

import numpy as np
from scipy.signal import dlsim

from hil.research.design.axes import ANGLE, AXES, POSITION, RATE, STEP_S, UNITS, Axis, dynamics
from hil.research.design.loop import filter_gain, held
from hil.research.identify.record import Array, Record
from hil.research.identify.spectra import Complex

LAG, DELAY = "lag", "delay"  # [s] DELAY is from input to gyro
TICK_DELAYS_S = 0.010  # part not caused by the robot: half a tick of holding, half the gyro's mean
SHOWN = (RATE, ANGLE, POSITION)  # states in telemetry, in the order of an axis' outputs
UNIT = {name: UNITS[term] for axis in AXES for name, term in axis.terms.items()} | {LAG: "s", DELAY: "s"}


def outputs(axis: Axis) -> tuple[int, ...]:
    """Return the axis' signals of `hil.research.identify.spectra.period_spectra`."""
    turn = (8 + axis.input,) if RATE in axis.states else ()
    return (*turn, *(11 + axis.pose[state] for state in SHOWN if state in axis.pose))


def flap_response(w: Array, lag: float, delay: float) -> Complex:
    """Return the frequency response of a flap to its reported input, the mean of a tick and the one before.

    The inputs themselves are held over ticks; `delay` counts from the tick.
    """
    reported = np.cos(0.5 * w * STEP_S) * np.exp(-0.5j * w * STEP_S)
    held = np.sinc(w * STEP_S / (2 * np.pi)) * np.exp(-1j * w * delay)
    response: Complex = held / reported / (1 + 1j * w * lag)
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


def one_step(
    record: Record, input: int, values: Mapping[str, float], late: float
) -> tuple[Array, Array, Array]:
    """Return times t (N,) [s], the measured values, and those predicted one step before, (N,) each.

    The signal is the axis' angular rate [rad/s] in B, of u4 the height [m] in W, without their means. `values` come from
    `hil.research.identify.joint`; poses are `late` [s] later than their stamps.
    """
    axis, step = AXES[input], record.period_s
    flow, columns = dynamics(axis, {**values, "flap_rate": 1 / values[LAG]})
    Phi, G = held(flow, columns[:, :1], step)
    K, C = filter_gain(axis, record.config, Phi)
    first = max(record.t[0] + values[DELAY], record.pose_t[0] - late)
    t = np.arange(first, min(record.t[-1], record.pose_t[-1] - late), step)
    shown = [np.interp(t + late, record.pose_t, record.pose[:, column]) for column in axis.pose.values()]
    turn = [np.interp(t, record.t, record.rates[:, input])] if RATE in axis.states else []
    measured = np.stack([*turn, *shown], axis=1)
    # The mean effect until the next step; `delay` includes the half tick of a held input.
    u = np.interp(t - values[DELAY] + step / 2, record.mean_t, record.u[:, input])
    measured -= measured.mean(axis=0)
    u -= u.mean()
    A, B = Phi @ (np.eye(len(Phi)) - K @ C), np.hstack([Phi @ K, G])
    filtered = (A, B, C[:1], np.zeros((1, len(C) + 1)), step)
    _, predicted, _ = dlsim(filtered, np.column_stack([measured, u]))
    return t, measured[:, 0], predicted[:, 0]
