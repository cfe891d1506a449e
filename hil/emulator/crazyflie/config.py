"""The keys of the section `radio` of a profile, with unit and source."""

import re
from typing import Final, Literal

from pydantic import Field, field_validator

from firmware_py.section import Section, number

LAST_ADDRESS: Final = 0xFFE7E7E7E7 - 16  # the boards after the first stay below the address of all


class RadioConfig(Section):
    """The radio link. Losses, bit errors and uplink jitter can be changed in flight: see `VirtualRadio`."""

    bits_per_second: Literal[250_000, 1_000_000, 2_000_000] = Field(
        2_000_000, description="data rate on the air [bit/s]; the original's URI radio://0/80/2M"
    )
    channel: int = number(80, "[0, 125]", "channel of the boards, above 2400 MHz [MHz]; the original's URI")
    address: str = Field(
        "",
        description="radio address of the first board, 10 hexadecimal digits; the next ones count up from it; "
        "empty: E7E7E7E7E7, then E7E7E7E702 and on; Crazyflie firmware",
    )
    usb_us: int = number(
        250, "[0, 10_000]", "one USB transfer with the host's share [us]; emulation with cflib"
    )
    usb_jitter_us: int = number(
        100, "[0, 10_000]", "extra per exchange, uniform from 0 [us]; estimate of the host's scheduling"
    )
    uplink_queue: int = number(
        4, "[1, 1000]", "packets waiting at the host [1]; when full the oldest is dropped; choice"
    )
    downlink_queue: int = number(
        8, "[1, 1000]", "packets waiting in the board's nRF51 [1]; Crazyflie firmware"
    )
    uplink_loss: float = number(0.01, "[0, 1]", "packets lost on the air, per try [1]; estimate")
    downlink_loss: float = number(0.01, "[0, 1]", "answers lost on the air, per try [1]; estimate")
    uplink_bit_error_rate: float = number(
        0.0, "[0, 1]", "wrong bits up, as by interference [1]; the CRC makes them losses; a fault"
    )
    downlink_bit_error_rate: float = number(0.0, "[0, 1]", "wrong bits down [1]; a fault")
    uplink_jitter_us: int = number(
        0, "[0, 1_000_000]", "delay ahead of the host's queue, uniform from 0, order kept [us]; a fault"
    )
    downlink_jitter_us: int = number(
        0, "[0, 1_000_000]", "delay of every answer on the way to the host, uniform from 0 [us]; a fault"
    )

    @field_validator("address", mode="before")
    @classmethod
    def _leaves_room(cls, address: object) -> object:
        """Refuse an address that leaves other boards none, and digits that TOML takes for a number."""
        digits = address if isinstance(address, str) else "number"
        if digits and not (re.fullmatch("[0-9A-Fa-f]{10}", digits) and int(digits, 16) <= LAST_ADDRESS):
            raise ValueError(f"expected 10 hexadecimal digits in quotation marks, at most {LAST_ADDRESS:X}")
        return digits.upper()
