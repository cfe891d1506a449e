"""Every key of the devices' sections of a profile, with unit and source."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

MARKERS = 8  # on the robot


class ImuConfig(BaseModel):
    """The errors of this specimen of the sensor."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    gyro_bandwidth: float = Field(
        116.0, gt=1, lt=500, description="-3 dB [Hz]; original firmware, BMI088 at 1 kHz"
    )
    accel_bandwidth: float = Field(145.0, gt=1, lt=500, description="-3 dB [Hz]; estimate for 1600 Hz OSR4")
    gyro_noise: float = Field(
        0.02 * math.sqrt(10),
        ge=0,
        le=5,
        description="white, per sample [rad/s]: the mean of ten has 0.02; assumed",
    )
    accel_noise: float = Field(
        0.05,
        ge=0,
        le=50,
        description="white, per sample [m/s2]; estimate; the filter does not use it",
    )
    gyro_bias: float = Field(0.003, ge=0, le=1, description="rms over specimens, per axis [rad/s]; assumed")
    accel_bias: float = Field(
        0.2, ge=0, le=10, description="rms over specimens, per axis [m/s2]; estimate, 20 mg"
    )


Probability = Annotated[float, Field(ge=0, le=1)]


class MocapConfig(BaseModel):
    """Cameras, their computer and the network to the ground station."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    period_us: int = Field(
        5000, ge=1000, le=1_000_000, multiple_of=1000, description="between exposures; paper: 200 Hz"
    )
    latency_us: int = Field(
        38_000,
        ge=0,
        le=1_000_000,
        description="exposure to arrival at the ground station; with the radio's 2 ms the paper's 40 ms",
    )
    processing_us: int = Field(
        18_000,
        ge=0,
        le=1_000_000,
        description="of these, in the cameras' computer [us]: the rest is exposure and transfer; assumed",
    )
    position_noise: float = Field(0.0005, ge=0, le=0.1, description="white, per axis [m]; assumed")
    rotation_noise: float = Field(0.004, ge=0, le=0.5, description="white, per axis of B [rad]; assumed")
    dropout: Probability = Field(0.0, description="share of frames in which the body is not tracked")
    outlier: Probability = Field(
        0.0, description="share of frames with a wrong position, e.g. swapped markers"
    )
    outlier_size: float = Field(
        0.3, gt=0, le=5, description="error of a wrong position, random direction [m]; chosen"
    )


class MarkersConfig(BaseModel):
    """Markers one by one, instead of the pose-level noise of `[mocap]`: slower, but losses follow from geometry."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    enabled: bool = Field(
        False,
        description="poses come from markers; `mocap.position_noise` and `rotation_noise` are then unused",
    )
    noise: float = Field(
        0.0011,
        ge=0,
        le=0.1,
        description="of each marker, white, per axis [m]; makes the pose's of assumed",
    )
    cameras: int = Field(5, ge=2, le=64, description="evenly around the tunnel; paper, Motion capture system")
    camera_distance: float = Field(2.5, gt=0.5, le=20, description="from the tunnel's axis [m]; chosen")
    camera_height: float = Field(2.0, ge=-2, le=20, description="z in W [m]; chosen: above the robot")
    min_cameras: int = Field(
        3, ge=2, le=64, description="that must see a marker to place it; chosen: two rays may meet by chance"
    )
    min_markers: int = Field(
        3, ge=3, le=MARKERS, description="that must be placed to track the body; geometry: 3 fix a pose"
    )
    max_error: float = Field(
        0.005,
        gt=0,
        le=1,
        description="mean distance from the fitted body [m]; above, it is not tracked; chosen",
    )
    mislabelled: Annotated[float, Field(ge=0, le=1)] = Field(
        0.0, description="share of frames in which two markers, any two, have each other's label"
    )
    ghosts: int = Field(
        0, ge=0, le=100, description="reflections near the robot that are not markers, per frame"
    )

    @model_validator(mode="after")
    def _enough_cameras(self) -> MarkersConfig:
        if self.min_cameras > self.cameras:
            raise ValueError(f"min_cameras = {self.min_cameras} of {self.cameras} cameras never see anything")
        return self


class SerialConfig(BaseModel):
    """The serial line. Wrong bits and the cable can be changed in flight: see `VirtualSerial`."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    baud: int = Field(
        921_600,
        ge=9600,
        le=3_000_000,
        description="bits on the line, 10 per byte [1/s]; as on PX4's companion ports",
    )
    receive_buffer: int = Field(
        512, ge=128, le=65_536, description="of the board, between interrupt and reader [bytes]; choice"
    )
    transmit_buffer: int = Field(
        1024,
        ge=512,
        le=65_536,
        description="of the board, until on the line [bytes]; choice: 11 ms at 921600",
    )
    interrupt_threshold: int = Field(
        64, ge=1, le=128,
        description="bytes after which a receiver hands over [1]; half of a 128-byte DMA buffer, a USB packet",
    )  # fmt: skip
    host_latency_us: int = Field(
        1000,
        ge=0,
        le=100_000,
        description="between program and line, in each direction [us]; latency timer of FTDI adapters with low_latency",
    )
    uplink_bit_error_rate: float = Field(0.0, ge=0, le=1, description="wrong bits to the board [1]; a fault")
    downlink_bit_error_rate: float = Field(
        0.0, ge=0, le=1, description="wrong bits to the ground [1]; a fault"
    )
