"""The keys of the section `radio` of a profile, with unit and source."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class RadioConfig(BaseModel):
    """The radio link. Losses, bit errors and uplink jitter can be changed in flight: see `VirtualRadio`."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    bits_per_second: Literal[250_000, 1_000_000, 2_000_000] = Field(
        2_000_000, description="data rate on the air [bit/s]; the original's URI radio://0/80/2M"
    )
    usb_us: int = Field(
        250, ge=0, le=10_000, description="one USB transfer with the host's share [us]; emulation with cflib"
    )
    usb_jitter_us: int = Field(
        100,
        ge=0,
        le=10_000,
        description="extra per exchange, uniform from 0 [us]; estimate of the host's scheduling",
    )
    uplink_queue: int = Field(
        4,
        ge=1,
        le=1000,
        description="packets waiting at the host [1]; when full the oldest is dropped; choice",
    )
    downlink_queue: int = Field(
        8, ge=1, le=1000, description="packets waiting in the board's nRF51 [1]; Crazyflie firmware"
    )
    uplink_loss: float = Field(0.01, ge=0, le=1, description="packets lost on the air, per try [1]; estimate")
    downlink_loss: float = Field(
        0.01, ge=0, le=1, description="answers lost on the air, per try [1]; estimate"
    )
    uplink_bit_error_rate: float = Field(
        0.0,
        ge=0,
        le=1,
        description="wrong bits up, as by interference [1]; the CRC makes them losses; a fault",
    )
    downlink_bit_error_rate: float = Field(0.0, ge=0, le=1, description="wrong bits down [1]; a fault")
    uplink_jitter_us: int = Field(
        0,
        ge=0,
        le=1_000_000,
        description="delay ahead of the host's queue, uniform from 0, order kept [us]; a fault",
    )
    downlink_jitter_us: int = Field(
        0,
        ge=0,
        le=1_000_000,
        description="delay of every answer on the way to the host, uniform from 0 [us]; a fault",
    )
