"""Laws of the virtual BMI088: axes, scale, low pass, noise, saturation, faults."""

import math

import numpy as np
import pytest
from scipy.signal import butter, lfilter
from scipy.spatial.transform import Rotation

from hil.board.config import ImuConfig
from hil.board.imu import VirtualImu
from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.bodies import make_body
from hil.world.floaty.plant import Plant
from support.still_plant import still_plant

GYRO_LSB = math.radians(2000 / 32768)  # [rad/s] data sheet
ACCEL_LSB = 24 * 9.81 / 32768  # [m/s2] data sheet
SILENT = ImuConfig(gyro_noise=0, accel_noise=0, gyro_bias=0, accel_bias=0)
HOME = (0.0, 0.0, 1.15)
LEVEL = (1.0, 0.0, 0.0, 0.0)


def settled(imu: VirtualImu, plant: Plant) -> tuple[int, ...]:
    for _ in range(50):
        counts = imu.sample(plant)
    return counts


def test_original_firmware_reads_body_rates_and_forces_from_the_counts() -> None:
    """The author's firmware: p = .7071 (gx + gy), q = .7071 (gy - gx), r = gz; on (1, 2, 3)."""
    plant = still_plant()
    tilt = Rotation.from_euler("ZYX", [0.3, -0.5, 0.7])
    plant.place(HOME, tilt.as_quat(scalar_first=True), omega_B=(1, 2, 3))
    counts = settled(VirtualImu(SILENT, np.random.default_rng(1)), plant)
    assert all(type(count) is int for count in counts)
    gx, gy, gz = np.array(counts[:3]) * GYRO_LSB
    assert [0.7071 * (gx + gy), 0.7071 * (gy - gx), gz] == pytest.approx([1, 2, 3], abs=1.5 * GYRO_LSB)
    ax, ay, az = np.array(counts[3:]) * ACCEL_LSB
    expected = tilt.inv().apply([0, 0, 9.81])
    assert [0.7071 * (ax + ay), 0.7071 * (ay - ax), az] == pytest.approx(expected, abs=1.5 * ACCEL_LSB)


def test_sensor_mounted_along_the_body_reads_body_rates_and_forces() -> None:
    plant = still_plant()
    tilt = Rotation.from_euler("ZYX", [0.3, -0.5, 0.7])
    plant.place(HOME, tilt.as_quat(scalar_first=True), omega_B=(1, 2, 3))
    imu = VirtualImu(SILENT.model_copy(update={"azimuth": 0.0}), np.random.default_rng(1))
    imu.set_rate_bias(0.1, 0.2, 0.3)
    counts = settled(imu, plant)
    assert np.array(counts[:3]) * GYRO_LSB == pytest.approx([1.1, 2.2, 3.3], abs=1.5 * GYRO_LSB)
    assert np.array(counts[3:]) * ACCEL_LSB == pytest.approx(
        tilt.inv().apply([0, 0, 9.81]), abs=1.5 * ACCEL_LSB
    )


def test_a_twin_samples_what_the_sensor_would_and_leaves_it_unchanged() -> None:
    plant, sensors = still_plant(), [VirtualImu(ImuConfig(), np.random.default_rng(1)) for _ in range(2)]
    alone, copied = sensors
    assert settled(alone, plant) == settled(copied, plant)
    twin = copied.twin()
    twin.set_rate_bias(0.1, 0.2, 0.3)
    twin.set_rate_bias(0.0, 0.0, 0.0)
    expected = [alone.sample(plant) for _ in range(3000)]  # beyond a block of noise
    assert [twin.sample(plant) for _ in range(3000)] == expected
    twin.freeze(True)
    assert [copied.sample(plant) for _ in range(3000)] == expected


def test_low_pass_is_second_order_butterworth_at_the_sample_instants() -> None:
    plant, imu = still_plant(), VirtualImu(SILENT, np.random.default_rng(1))
    turning = np.random.default_rng(2).uniform(-3, 3, 300)
    tilting = np.random.default_rng(3).uniform(-1, 1, 300)
    counts = []
    for rate, angle in zip(turning, tilting, strict=True):
        plant.place(HOME, (math.cos(angle / 2), 0, math.sin(angle / 2), 0), omega_B=(0, 0, rate))
        counts.append(imu.sample(plant))
    gyro = lfilter(*butter(2, 116, fs=1000), turning)
    accel = lfilter(*butter(2, 145, fs=1000), 9.81 * np.cos(tilting))
    assert np.abs(np.array(counts)[:, 2] - gyro / GYRO_LSB).max() <= 0.5 + 1e-6
    assert np.abs(np.array(counts)[:, 5] - accel / ACCEL_LSB).max() <= 0.5 + 1e-6


def test_mean_of_ten_samples_has_the_noise_of_the_specification() -> None:
    plant = still_plant()
    imu = VirtualImu(ImuConfig(gyro_bias=0, accel_bias=0), np.random.default_rng(1))
    counts = np.array([imu.sample(plant) for _ in range(20_000)])[50:-50].reshape(-1, 10, 6)
    means = counts.mean(axis=1)
    assert means[:, :3].std(axis=0) * GYRO_LSB == pytest.approx(3 * [0.02], rel=0.07)
    assert counts[..., 3:].reshape(-1, 3).std(axis=0) * ACCEL_LSB == pytest.approx(3 * [0.05], rel=0.03)
    assert np.abs(means[:, :3].mean(axis=0)).max() * GYRO_LSB < 0.002
    assert np.abs(np.corrcoef(counts.reshape(-1, 6).T) - np.eye(6)).max() < 0.04


@pytest.mark.long
def test_every_specimen_has_its_own_constant_bias() -> None:
    plant = still_plant()
    quiet = ImuConfig(gyro_noise=0, accel_noise=0, gyro_bias=0.03, accel_bias=0.2)
    rests = []
    for seed in range(300):
        rests.append(settled(VirtualImu(quiet, np.random.default_rng(seed)), plant))
    assert np.array(rests)[:, :3].std() * GYRO_LSB == pytest.approx(0.03, rel=0.1)
    assert np.array(rests)[:, 3:].std(axis=0) * ACCEL_LSB == pytest.approx(3 * [0.2], rel=0.15)


def test_a_moved_zero_is_a_rate_in_the_body_frame_and_heals() -> None:
    plant, imu = still_plant(), VirtualImu(SILENT, np.random.default_rng(1))
    before = np.array(settled(imu, plant))
    imu.set_rate_bias(1.0, 2.0, 3.0)
    gx, gy, gz = (np.array(settled(imu, plant)) - before)[:3] * GYRO_LSB
    assert [0.7071 * (gx + gy), 0.7071 * (gy - gx), gz] == pytest.approx([1, 2, 3], abs=1.5 * GYRO_LSB)
    imu.set_rate_bias(0.0, 0.0, 0.0)
    assert settled(imu, plant) == tuple(before)


def test_a_smaller_range_bounds_the_gyro_alone_and_full_scale_always() -> None:
    plant, imu = still_plant(), VirtualImu(SILENT, np.random.default_rng(1))
    plant.place(HOME, LEVEL, omega_B=(0, 0, -2))
    free = settled(imu, plant)
    imu.set_rate_range(1.0)
    bounded = settled(imu, plant)
    assert bounded[2] * GYRO_LSB == pytest.approx(-1.0, abs=1.5 * GYRO_LSB)
    assert bounded[3:] == free[3:]
    imu.set_rate_range(1e6)  # beyond full scale: full scale
    assert settled(imu, plant) == free
    for rate, full_scale in ((60, 32767), (-60, -32768)):
        plant.place(HOME, LEVEL, omega_B=(0, 0, rate))
        assert settled(imu, plant)[2] == full_scale


def test_a_specimen_that_continues_does_not_settle_again() -> None:
    plant = still_plant()
    earlier, later = (VirtualImu(SILENT, np.random.default_rng(1)) for _ in range(2))
    for _ in range(3):  # the filters are on their way
        earlier.sample(plant)
    later.continue_from(earlier)
    for _ in range(5):
        assert later.sample(plant) == earlier.sample(plant)


def test_a_frozen_sensor_repeats_itself_until_it_thaws() -> None:
    plant, imu = still_plant(), VirtualImu(SILENT, np.random.default_rng(1))
    before = settled(imu, plant)
    imu.freeze(True)
    plant.place(HOME, (0.0, 1.0, 0.0, 0.0), omega_B=(1, 2, 3))
    assert settled(imu, plant) == before
    imu.freeze(False)
    after = settled(imu, plant)
    assert after[5] == pytest.approx(-before[5], abs=1)
    assert after[2] * GYRO_LSB == pytest.approx(3, abs=1.5 * GYRO_LSB)


def test_noise_can_be_scaled_but_not_to_nonsense() -> None:
    plant, imu = still_plant(), VirtualImu(ImuConfig(), np.random.default_rng(1))
    settled(imu, plant)
    plain = np.array([imu.sample(plant) for _ in range(2000)]).std(axis=0)
    imu.set_noise_scale(3.0)
    assert np.array([imu.sample(plant) for _ in range(2000)]).std(axis=0) == pytest.approx(3 * plain, rel=0.1)
    for scale in (-1.0, math.nan):
        with pytest.raises(LabError, match="noise scale"):
            imu.set_noise_scale(scale)


@pytest.mark.parametrize(("own", "duty"), [(0.01, 160), (0.01, 0), (0.0, 160)])
def test_vibration_adds_to_the_sensors_own_noise_as_independent_noise_does(own: float, duty: int) -> None:
    body = make_body(load_config("crazyflie"), np.random.default_rng(1), (0.0, 0.0, 1.0))
    body.hold()
    body.draw(0, 3.9)
    body.set_counts(0, 4 * [duty])
    body.advance(2_000_000)
    assert (body.vibration[0] > 0.01) == (duty > 0)
    config = ImuConfig(gyro_noise=own, accel_noise=own, gyro_bias=0, accel_bias=0)
    imu = VirtualImu(config, np.random.default_rng(1))
    counts = np.array([imu.sample(body) for _ in range(5_000)])[50:]
    gyro, accel = np.hypot(own, body.vibration)
    assert counts[:, :3].std(axis=0) * GYRO_LSB == pytest.approx(3 * [gyro], rel=0.05)
    assert counts[:, 3:].std(axis=0) * ACCEL_LSB == pytest.approx(3 * [accel], rel=0.05)
