"""The IMU on board: mounting and scale, by another implementation of rotations and by the data sheet; and in the core."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.board import ImuCounts
from firmware_py.config import parameters_of
from firmware_py.core import entry
from firmware_py.core.structs import RATE, Control, Estimator, Input, Report, Sampling
from firmware_py.drivers.imu import acceleration, body_of, rates
from hil.config import load_config

R_BS = Rotation.from_euler("z", -45, degrees=True)  # as the chip is soldered on the original board
FULL_RATE = np.radians(2000)  # BMI088 data sheet, of 32768 counts
FULL_ACCELERATION = 24  # [g]
COUNTS: ImuCounts = (1000, 2000, 3000, 4000, 5000, 7000)
ZERO = (10.0, -20.0, 30.0)


def test_the_sensor_lies_at_minus_45_degrees_in_the_body() -> None:
    assert body_of((1.0, 2.0, 3.0)) == pytest.approx(R_BS.apply((1, 2, 3)), abs=1e-12)


def test_gyro_counts_above_the_zero_are_body_rates() -> None:
    expected = R_BS.apply(FULL_RATE / 32768 * np.subtract(COUNTS[:3], ZERO))
    assert rates(COUNTS, ZERO) == pytest.approx(expected, rel=1e-12)


def test_accelerometer_counts_are_specific_force_in_the_body() -> None:
    expected = R_BS.apply(FULL_ACCELERATION / 32768 * np.array(COUNTS[3:]))
    assert acceleration(COUNTS) == pytest.approx(expected, rel=1e-12)


def test_the_core_turns_and_scales_the_gyro_as_the_driver_does() -> None:
    parameters = parameters_of(load_config())
    data, estimator, control = Input.allocate(), Estimator.allocate(), Control.allocate()
    data.fields.gyro_sum[:] = 10 * np.array(COUNTS[:3])
    data.fields.gyro_samples = np.int32(10)
    data.fields.gyro_bias[:] = ZERO
    entry.reset(parameters.fields, estimator.fields)
    entry.estimate(
        parameters.fields,
        data.fields,
        estimator.fields,
        control.fields,
        Sampling.allocate().fields,
        Report.allocate().fields,
    )
    assert estimator.fields.now[RATE : RATE + 3] == pytest.approx(rates(COUNTS, ZERO), rel=1e-6)
