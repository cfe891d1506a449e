"""Yaw: the paper's steps up to 110 degrees, settled in less than 0.5 s, and sines of 90 degrees up to 0.15 Hz.

The step needs more torque than the flaps give between 0 and 52 degrees: the time-optimal bound there is 0.47 s. Opened
through zero, to -11 degrees, they give more, and the step settles in time; its gains are slightly lower, so that yaw
neither creeps through the last five per cent nor overshoots them. `yaw-step-0` is the same step with the values of the
profile.

The estimator accepts a step above its gate (28 degrees) with the second pose, 20 ms later: settling includes that.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from math import radians, sqrt, tau

from ground_station.trajectory import Goal, Offsets, Sine, Step, Trajectory
from hil.laboratory.experiment import Experiment
from hil.laboratory.experiments.measures import yaw_sine, yaw_step

BEGIN_S = 1.0  # the robot is at rest after its release
STEP = radians(110.0)  # paper, Yaw tracking performance
SWING = radians(90.0)  # paper, likewise
LATE_S = 0.22  # measured 0.17 s: 40 ms of pose latency, 50 ms of flaps, the gains
ROUGH = radians(1.0)  # of yaw in the turbulence, with a margin
OPENED = "allocation.opening_min=-0.192"  # -11 deg


def step_yaw(home: Goal, release_us: int) -> Trajectory:
    """Turn by the step, once."""
    return Offsets(home, release_us + round(BEGIN_S * 1e6), yaw=Step(STEP))


def swing_yaw(frequency_hz: float, home: Goal, release_us: int) -> Trajectory:
    """Turn back and forth by 90 degrees."""
    return Offsets(home, release_us + round(BEGIN_S * 1e6), yaw=Sine(SWING, frequency_hz))


YAW_STEP = Experiment(
    name="yaw-step",
    summary="turn by 110 deg at once, flaps opened through zero, -11..52 deg (paper: settles in < 0.5 s)",
    duration_s=5.0,
    limits={"lost": 0.0, "settle": 0.50, "overshoot": 0.05, "max_x": 0.06, "max_y": 0.06},
    trajectory=step_yaw,
    settings=(OPENED, "controller.limit_u3=0.6", "controller.gain_yaw=1.0", "controller.gain_r=0.09"),
    measure=yaw_step,
    pictures=("yaw-step",),
)
YAW_STEP_0 = replace(
    YAW_STEP,
    name="yaw-step-0",
    summary="the same turn with the profile's flap range, 0..52 deg",
    limits={**YAW_STEP.limits, "settle": 0.65},
    settings=(),
)


def follow_sine(frequency_hz: float, periods: int, more: Mapping[str, float]) -> Experiment:
    """Return the sine of one frequency; yaw lags it by at most `LATE_S`."""
    lag = tau * frequency_hz * LATE_S
    limits = {"lost": 0.0, "gain": 0.97, "lag": lag, "rms_yaw": SWING / sqrt(2.0) * lag + ROUGH}
    return Experiment(
        name=f"yaw-sine-{frequency_hz:.2f}",
        summary=f"turn back and forth by 90 deg at {frequency_hz:.2f} Hz (paper: follows up to 0.15 Hz, > 80 deg/s)",
        duration_s=BEGIN_S + periods / frequency_hz,
        limits={**limits, "max_x": 0.10, "max_y": 0.06, **more},
        trajectory=partial(swing_yaw, frequency_hz),
        measure=partial(yaw_sine, frequency_hz),
        pictures=("yaw-sine",),
    )


YAW_SINES = (
    follow_sine(0.02, 1, {}),
    follow_sine(0.05, 1, {}),
    follow_sine(0.10, 2, {}),
    follow_sine(0.15, 3, {"peak_rate": radians(80.0)}),  # the goal's own: 85 deg/s
)
