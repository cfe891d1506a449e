"""The 1 kHz step: which steps run estimator and controller, the gyro's samples, its monitoring and its zero."""

from firmware_py.core.maths import ZERO
from firmware_py.core.structs import Input, Sampling
from firmware_py.core.subset import elapsed, f32, i32, kernel

STEPS = 10  # of 1 ms in a tick: the controller runs in steps 0, 10, 20 ...
BEFORE_ESTIMATOR = 1  # and the estimator in the steps before: 9, 19 ...
STEP_US = 1000
# The gyro is stale after this many steps without a change on any axis. A BMI088 at rest has the least
# noise: 0.014 deg/s/sqrt(Hz) (data sheet) over its 116 Hz, 0.16 deg/s rms, 2.6 counts of 16.4 per deg/s. Samples 3 ms apart
# are independent; their difference of 3.7 counts rms rounds to 0 with a chance of 0.11, on three axes at once with
# 0.0013. In 20 ms that has to happen six times in a row: 5e-18, once in 10 million years of samples at 1 kHz.
STALE_STEPS = 20
RECOVERY_STEPS = 100  # with new counts; the estimator gets five poses in that time
WINDOW = 512  # samples, original firmware
# [counts^2] 0.1 rad/s rms: more than sensor noise in the flow, less than a moving robot.
VARIANCE_LIMIT = f32(10000.0)


@kernel
def watch_gyro(data: Input, sampling: Sampling) -> None:
    """Detect a gyro whose counts stay the same: it is frozen, or its samples do not arrive."""
    same = True
    for axis in range(3):
        if data.gyro[axis] != sampling.before[axis]:
            same = False
        sampling.before[axis] = data.gyro[axis]
    if same:
        sampling.unchanged = i32(sampling.unchanged + 1)
    else:
        sampling.unchanged = i32(0)
    if sampling.unchanged >= STALE_STEPS:
        sampling.unchanged = i32(STALE_STEPS)
        sampling.recovering = i32(RECOVERY_STEPS)
    elif sampling.recovering > 0:
        sampling.recovering = i32(sampling.recovering - 1)


@kernel
def begin_step(data: Input, sampling: Sampling) -> i32:
    """Begin a step; return whether the controller runs in it. A late step does not delay the next one."""
    if data.gyro_again == 0:
        watch_gyro(data, sampling)
    passed = elapsed(data.tick, sampling.tick)
    if passed < 0:
        passed = i32(0)
    sampling.tick = data.tick
    ahead = sampling.phase + passed % STEPS
    if passed >= STEPS or (sampling.phase + BEFORE_ESTIMATOR) % STEPS + passed >= STEPS:
        sampling.estimate_due = i32(1)
    sampling.phase = i32(ahead % STEPS)
    if passed >= STEPS or ahead >= STEPS:
        return i32(1)
    return i32(0)


@kernel
def until_estimate_us(sampling: Sampling) -> i32:
    """Return the time from this step to the estimator's next one."""
    return i32((STEPS - BEFORE_ESTIMATOR - sampling.phase) * STEP_US)


@kernel
def clear_samples(data: Input, sampling: Sampling) -> None:
    """Start a new sum of samples after the estimator's tick."""
    sampling.estimate_due = i32(0)
    data.gyro_samples = i32(0)
    for axis in range(3):
        data.gyro_sum[axis] = i32(0)


@kernel
def seek_zero(data: Input, sampling: Sampling) -> i32:
    """Add a sample to the window that measures the gyro's zero; return whether the zero is found.

    A window in which the robot moved is dropped and the next one begins. Squares are of differences from the window's
    first sample, so they are exact while the robot is still.
    """
    for axis in range(3):
        if sampling.samples == 0:
            sampling.first[axis] = data.gyro[axis]
            sampling.sums[axis] = i32(0)
            sampling.squares[axis] = ZERO
        difference = f32(data.gyro[axis]) - f32(sampling.first[axis])
        sampling.sums[axis] = i32(sampling.sums[axis] + data.gyro[axis])
        sampling.squares[axis] = sampling.squares[axis] + difference * difference
    sampling.samples = i32(sampling.samples + 1)
    if sampling.samples < WINDOW:
        return i32(0)
    sampling.samples = i32(0)
    still = True
    for axis in range(3):
        offset = f32(sampling.sums[axis]) / f32(WINDOW) - f32(sampling.first[axis])
        sampling.variance[axis] = sampling.squares[axis] / f32(WINDOW) - offset * offset
        if sampling.variance[axis] > VARIANCE_LIMIT:
            still = False
    if not still:
        sampling.windows_refused = i32(sampling.windows_refused + 1)
        return i32(0)
    for axis in range(3):
        data.gyro_bias[axis] = f32(sampling.sums[axis]) / f32(WINDOW)
    sampling.calibrated = i32(1)
    return i32(1)


@kernel
def take_sample(data: Input, sampling: Sampling) -> i32:
    """Take a gyro sample; return whether it completes the search for the gyro's zero."""
    for axis in range(3):
        data.gyro_sum[axis] = i32(data.gyro_sum[axis] + data.gyro[axis])
    data.gyro_samples = i32(data.gyro_samples + 1)
    if sampling.calibrated != 0:
        return i32(0)
    return seek_zero(data, sampling)


@kernel
def forget_zero(data: Input, sampling: Sampling) -> None:
    """Search for the gyro's zero again: another gyro measures from now on."""
    clear_samples(data, sampling)
    sampling.samples = i32(0)
    sampling.calibrated = i32(0)
    for axis in range(3):
        data.gyro_bias[axis] = ZERO
