"""The configuration block in the EEPROM of robot 1, 2, ...: its radio's channel, data rate and own address."""

from firmware_py.wire.memories import RadioSettings, encode_config
from hil.emulator.crazyflie.nrf51 import RATES

CHANNEL = 80


def address_of(number: int) -> bytes:
    """Return the radio address of board 1, 2, ...: the Crazyflie's default, then E7E7E7E702 and on."""
    return bytes((0xE7, 0xE7, 0xE7, 0xE7, 0xE7 if number == 1 else number))


def factory_config(number: int, bits_per_second: int) -> bytes:
    """Return the configuration block with a board's own address."""
    rate = RATES.index(bits_per_second)
    return encode_config(RadioSettings(CHANNEL, rate, int.from_bytes(address_of(number))))
