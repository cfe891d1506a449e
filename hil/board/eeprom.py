"""The configuration block in the EEPROM of robot 1, 2, ...: its radio's channel, data rate and own address."""

from firmware_py.wire.memories import RadioSettings, encode_config
from hil.emulator.crazyflie.config import RadioConfig
from hil.emulator.crazyflie.nrf51 import RATES


def address_of(number: int, first: str = "") -> bytes:
    """Return the radio address of board 1, 2, ... from the configured first one, of 10 hexadecimal digits.

    Without it: the Crazyflie's default, then E7E7E7E702 and on.
    """
    if first:
        return (int(first, 16) + number - 1).to_bytes(5)
    return bytes((0xE7, 0xE7, 0xE7, 0xE7, 0xE7 if number == 1 else number))


def factory_config(number: int, radio: RadioConfig) -> bytes:
    """Return the configuration block with a board's own address."""
    address = int.from_bytes(address_of(number, radio.address))
    return encode_config(RadioSettings(radio.channel, RATES.index(radio.bits_per_second), address))
