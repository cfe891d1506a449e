"""One-step prediction: the next sample as predicted by the identified model in the board's stationary filter.

A simulation from the input alone ignores the flow; every sample corrects a prediction, so that its errors are the flow's
accelerations of one step, the noise of the sensors, and the errors of the model. A step is from one row of the telemetry
to the next.
"""

from collections.abc import Mapping

import numpy as np
from scipy.signal import dlsim

from hil.design.axes import AXES, RATE, dynamics
from hil.design.loop import filter_gain, held
from hil.identify.record import Array, Record
from hil.identify.response import DELAY, LAG


def one_step(
    record: Record, input: int, values: Mapping[str, float], late: float
) -> tuple[Array, Array, Array]:
    """Return times t (N,) [s], the measured values, and those predicted one step before, (N,) each.

    The signal is the axis' angular rate [rad/s] in B, of u4 the height [m] in W, without their means. `values` come from
    `hil.identify.joint`; poses are `late` [s] later than their stamps.
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
    u = np.interp(t - values[DELAY] + step / 2, record.u_t, record.u[:, input])
    measured -= measured.mean(axis=0)
    u -= u.mean()
    filtered = (
        Phi @ (np.eye(len(Phi)) - K @ C),
        np.hstack([Phi @ K, G]),
        C[:1],
        np.zeros((1, len(C) + 1)),
        step,
    )
    _, predicted, _ = dlsim(filtered, np.column_stack([measured, u]))
    return t, measured[:, 0], predicted[:, 0]
