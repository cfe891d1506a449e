"""Laws of the BMP388: what the data sheet's compensation reads from its registers follows the height, with its noise."""

import struct

import numpy as np
import pytest

from hil.emulator.crazyflie.barometer import CONFIG, DATA, SPECIMEN, Barometer

DRONE = 0b100  # in CONFIG: the filter's coefficient is 3


def compensated(registers: np.ndarray) -> tuple[float, float]:
    """Pressure [Pa] and temperature [deg C] by the formulas of the data sheet, section 9."""
    t1, t2, t3, p1, p2, p3, p4, p5, p6, p7, p8, p9, p10, p11 = struct.unpack("<HHbhhbbHHbbhbb", SPECIMEN)
    low, middle, high, *raw_t = registers[DATA : DATA + 6].tolist()
    p, t = low + (middle << 8) + (high << 16), raw_t[0] + (raw_t[1] << 8) + (raw_t[2] << 16)
    d = t - t1 * 2**8
    T = d * t2 / 2**30 + d * d * t3 / 2**48
    offset = p5 * 2**3 + T * p6 / 2**6 + T**2 * p7 / 2**8 + T**3 * p8 / 2**15
    slope = (p1 - 2**14) / 2**20 + T * (p2 - 2**14) / 2**29 + T**2 * p3 / 2**32 + T**3 * p4 / 2**37
    return offset + p * slope + p**2 * (p9 / 2**48 + T * p10 / 2**48) + p**3 * p11 / 2**65, T


def test_pressure_falls_with_height_as_air_weighs() -> None:
    registers = np.zeros(256, np.uint8)
    barometer = Barometer(registers)
    assert compensated(registers) == pytest.approx((101_570.0, 23.77), abs=0.02)
    weight = 101_570.0 / (287.05 * (23.77 + 273.15)) * 9.81  # [Pa/m]
    for height in (0.0, 1.0, 2.5, -1.5):
        barometer.measure(height, 0.0)
        assert compensated(registers)[0] == pytest.approx(101_570.0 - weight * height, abs=0.03)


def test_noise_is_that_of_the_data_sheet_with_the_filter_for_drones() -> None:
    registers, rng = np.zeros(256, np.uint8), np.random.default_rng(1)
    registers[CONFIG] = DRONE
    barometer = Barometer(registers)
    pressures = []
    for draw in rng.standard_normal(4000):
        barometer.measure(1.0, float(draw))
        pressures.append(compensated(registers)[0])
    assert np.std(pressures[20:]) == pytest.approx(0.11 * 11.69, rel=0.05)


@pytest.mark.parametrize(("config", "coefficient"), [(0, 0), (DRONE, 3), (0b1000, 15)])
def test_the_filter_has_the_step_response_of_its_coefficient(config: int, coefficient: int) -> None:
    registers, stays = np.zeros(256, np.uint8), coefficient / (coefficient + 1)
    registers[CONFIG] = config
    barometer = Barometer(registers)
    barometer.measure(0.0, 0.0)
    start, shares = compensated(registers)[0], []
    for _ in range(3):
        barometer.measure(1.0, 0.0)
        shares.append((start - compensated(registers)[0]) / 11.69)
    assert shares == pytest.approx([1 - stays, 1 - stays**2, 1 - stays**3], abs=0.002)
