"""The core gives the same bits as plain Python as compiled: 2000 ticks, all structs, every tick.

Run as a script, this file flies the stream and prints one digest per tick.
"""

import hashlib
import math
import os
import subprocess
import sys

import numpy as np
import pytest

from firmware_py.config import parameters_of
from firmware_py.core import entry
from firmware_py.core.structs import (
    MODE_FLY,
    MODE_HOVER,
    MODE_MANUAL,
    Control,
    Estimator,
    Input,
    Report,
    Sampling,
    Supervisor,
)
from hil.config import load_config

TICKS = 2000


def fly() -> None:
    """Fly a stream of everything that may come in: motion, noise, outliers, no numbers, saturation, silence."""
    rng = np.random.default_rng(5)
    parameters = parameters_of(load_config())
    data, estimator, control = Input.allocate(), Estimator.allocate(), Control.allocate()
    sampling, supervisor, report = Sampling.allocate(), Supervisor.allocate(), Report.allocate()
    fields = data.fields
    entry.reset(parameters.arg, estimator.arg)
    for tick in range(TICKS):
        t = 0.01 * tick
        for _ in range(int(rng.choice([0, 1, 2], p=[0.45, 0.5, 0.05]))):
            yaw = 3.0 * math.sin(0.5 * t) + 2.0 * (tick // 400)
            fields.poses_absolute = tick >= TICKS // 2
            position = 0.3 * np.sin([t, 1.3 * t, 0.7 * t]) + 1e-3 * rng.standard_normal(3)
            position[0] += 1.8 if 1500 <= tick < 1560 else 0.0  # beyond the bound
            q = np.array([math.cos(yaw / 2), 0.05 * math.sin(3 * t), 0.05 * math.cos(t), math.sin(yaw / 2)])
            fate = rng.random()
            if fate < 0.03:
                position = position + rng.choice([0.5, -0.5, math.nan, math.inf, 1e30, 1e-42])
            elif fate < 0.05:
                q = rng.choice([1.0, -1.0, math.nan, math.inf, 0.5], 4)
            fields.pose_position[:] = position
            fields.pose_quaternion[:] = q * rng.choice([1, -1])
            fields.pose_age_us = rng.choice([40_000, 41_234, 37_777, 5_000, 83_000, 200_000, -1])
            entry.file_pose(parameters.arg, data.arg, estimator.arg, sampling.arg, supervisor.arg)
        gyro = rng.normal(0, 3000, 3) if rng.random() < 0.97 else rng.choice([-327_680, 327_670], 3)
        fields.gyro_sum[:] = gyro.astype(np.int32)
        fields.gyro_samples = rng.choice([10, 9, 0], p=[0.9, 0.08, 0.02])
        fields.gyro_bias[:] = (1.5, -2.25, 0.3)
        if tick % 500 == 499:
            parameters.fields.predict = (tick // 500) % 2
            parameters.fields.age_measured = (tick // 1000) % 2
            parameters.fields.horizon = 6
        if tick in (700, 1300):
            estimator.fields.x[tick % 16] = math.nan
        entry.estimate(parameters.arg, data.arg, estimator.arg, control.arg, sampling.arg, report.arg)
        fields.mode = MODE_FLY if tick % 100 < 90 else (MODE_MANUAL if tick % 2 else MODE_HOVER)
        fields.manual[:] = (0.1, math.nan, -9.0, math.inf)
        entry.control(parameters.arg, data.arg, estimator.arg, control.arg)
        structs = b"".join(
            block.bytes() for block in (parameters, data, estimator, control, sampling, supervisor, report)
        )
        print(hashlib.sha256(structs).hexdigest()[:16])
    counters = {name: int(getattr(estimator.fields, name)) for name in
                ("fused", "refused", "jumps", "too_old", "invalid", "bounded", "resets")}  # fmt: skip
    print(counters)


def flown(plain: bool) -> list[str]:
    """Return the output of a process of its own."""
    environment = os.environ | {"NUMBA_DISABLE_JIT": str(int(plain))}
    command = [sys.executable, "-W", "ignore", __file__]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True
    ).stdout.splitlines()


@pytest.mark.long
def test_plain_python_gives_the_bits_of_the_compiled_core_in_every_tick() -> None:
    compiled, plain = flown(plain=False), flown(plain=True)
    assert len(compiled) == TICKS + 1
    assert len(set(compiled)) == TICKS + 1
    differing = [tick for tick in range(TICKS) if compiled[tick] != plain[tick]]
    assert not differing, f"first at tick {differing[0]}"
    # Every counter moved: the stream reaches every branch.
    assert "': 0" not in compiled[TICKS], compiled[TICKS]
    assert compiled == plain


if __name__ == "__main__":
    fly()
