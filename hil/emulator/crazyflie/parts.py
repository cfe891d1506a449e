"""The parts around a Crazyflie 2.1's STM32F405: BMI088 and BMP388 on I2C3, EEPROM on I2C1, pins.

The sensors are register files, numbered as in their data sheets; the caller supplies the IMU's counts at every
data-ready, the gyro's interrupt on PC14. The others measure the body themselves.
"""

import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hil.emulator.crazyflie.barometer import Barometer
from hil.emulator.stm32f405.chip import OTP, Chip
from hil.world.body import Carrier
from hil.world.fixed_order import normal

GYRO_ADDRESSES, ACCEL_ADDRESSES, PRESSURE_ADDRESS, EEPROM_ADDRESS = (0x68, 0x69), (0x18, 0x19), 0x77, 0x50
EEPROM_SIZE = 8192  # [bytes]
DECK_BUS, SENSOR_BUS = 1, 3
SYSLINK_USART = 6
GYRO_ID, ACCEL_ID = 0x0F, 0x1E
GYRO_RATES, GYRO_SELF_TEST, GYRO_FINE = 0x02, 0x3C, 0x12  # data sheet: rate_ok and bist_rdy
ACCEL_STATUS, ACCEL_READY, ACCELERATIONS = 0x03, 0x80, 0x12
BRUSHED, BRUSHLESS = "CF21", "C21B"  # device types
DATA_READY = ("C", 14)
RADIO_BUSY = ("A", 4)  # the nRF51 holds it high while it takes no bytes


class Parts:
    """The parts around a chip; without a carrier they rest. `eeprom` (8192,) uint8 may be shared with what keeps it."""

    def __init__(self, chip: Chip, eeprom: NDArray[np.uint8], carrier: Carrier | None = None) -> None:
        if eeprom.size != EEPROM_SIZE:
            raise ValueError(f"an EEPROM of {eeprom.size} bytes: it has {EEPROM_SIZE}")
        self._chip, self._carrier = chip, carrier
        self.gyro, self.accel, pressure = (np.zeros(256, np.uint8) for _ in range(3))
        self.gyro[0], self.gyro[GYRO_SELF_TEST] = GYRO_ID, GYRO_FINE
        self.accel[0], self.accel[ACCEL_STATUS] = ACCEL_ID, ACCEL_READY
        self._barometer = Barometer(pressure)
        for address in GYRO_ADDRESSES:
            chip.add_device(SENSOR_BUS, address, self.gyro)
        for address in ACCEL_ADDRESSES:
            chip.add_device(SENSOR_BUS, address, self.accel)
        chip.add_device(SENSOR_BUS, PRESSURE_ADDRESS, pressure, pairs=True)
        chip.add_device(DECK_BUS, EEPROM_ADDRESS, eeprom, address_bytes=2)
        self.device_type = BRUSHED if carrier is None or carrier.escs is None else BRUSHLESS
        chip.set_system(OTP, f"0;{self.device_type}\0".encode())
        for port in "ABCDE":
            for number in range(16):
                chip.pin(port, number, (port, number) not in (DATA_READY, RADIO_BUSY))

    def sample(self, counts: Sequence[int]) -> None:
        """Put a sample into the IMU's registers and tell the processor."""
        _put(self.gyro, GYRO_RATES, struct.pack("<3h", *counts[:3]))
        _put(self.accel, ACCELERATIONS, struct.pack("<3h", *counts[3:]))
        self._chip.pin(*DATA_READY, True)
        self._chip.pin(*DATA_READY, False)

    def measure_pressure(self) -> None:
        """Put the next measurement into the barometer's registers."""
        if self._carrier is not None:
            self._barometer.measure(
                float(self._carrier.motion.p_WB[2]), float(normal(self._carrier.rng, 1)[0])
            )


def _put(registers: NDArray[np.uint8], first: int, contents: bytes) -> None:
    registers[first : first + len(contents)] = np.frombuffer(contents, np.uint8)
