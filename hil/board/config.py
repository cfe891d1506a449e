"""Every key of the devices' sections of a profile, with unit and source."""

from __future__ import annotations

from math import pi, sqrt
from typing import Annotated

from pydantic import Field, model_validator

from firmware_py.section import Section, number

MARKERS = 8  # on the robot
S_AZIMUTH = -pi / 4  # then p = (gx + gy)/sqrt2, q = (gy - gx)/sqrt2, r = gz


class ImuConfig(Section):
    """How the sensor is mounted, and the errors of this specimen."""

    azimuth: float = number(S_AZIMUTH, f"[{-pi}, {pi}]", "of its x axis in B [rad]; original firmware")
    gyro_bandwidth: float = number(116.0, "(1, 500)", "-3 dB [Hz]; original firmware, BMI088 at 1 kHz")
    accel_bandwidth: float = number(145.0, "(1, 500)", "-3 dB [Hz]; estimate for 1600 Hz OSR4")
    gyro_noise: float = number(0.02 * sqrt(10), "[0, 5]", "white, per sample [rad/s]: 0.02 in ten; assumed")
    accel_noise: float = number(0.05, "[0, 50]", "white, per sample [m/s2]; estimate; the filter ignores it")
    gyro_bias: float = number(0.003, "[0, 1]", "rms over specimens, per axis [rad/s]; assumed")
    accel_bias: float = number(0.2, "[0, 10]", "rms over specimens, per axis [m/s2]; estimate, 20 mg")


Probability = Annotated[float, Field(ge=0, le=1)]


class SensorConfig(Section):
    """A sensor of your own robot (`floaty docs your-own-robot`): the errors of its samples at 100 Hz."""

    noise: float = number(0.0, "[0, 1e6]", "white, per number [the sensor's unit]")
    delay_us: int = number(0, "[0, 1_000_000]", "from the measurement to the board [us]")
    dropout: Probability = Field(0.0, description="share of samples that are missing")


class MocapConfig(Section):
    """Cameras, their computer and the network to the ground station."""

    period_us: int = Field(
        5000, ge=1000, le=1_000_000, multiple_of=1000, description="between exposures; paper: 200 Hz"
    )
    latency_us: int = number(38_000, "[0, 1_000_000]", "exposure to arrival [us]; paper: 40 ms with radio")
    processing_us: int = number(18_000, "[0, 1_000_000]", "of these, in the cameras' computer [us]; assumed")
    position_noise: float = number(0.0005, "[0, 0.1]", "white, per axis [m]; assumed")
    rotation_noise: float = number(0.004, "[0, 0.5]", "white, per axis of B [rad]; assumed")
    dropout: Probability = Field(0.0, description="share of frames in which the body is not tracked")
    outlier: Probability = Field(0.0, description="share of frames with a wrong position: swapped markers")
    outlier_size: float = number(0.3, "(0, 5]", "error of a wrong position, random direction [m]; chosen")


class MarkersConfig(Section):
    """Individual markers instead of the pose noise of `[mocap]`: slower, but geometry determines the losses."""

    enabled: bool = Field(False, description="poses come from markers, without the noise of [mocap]")
    noise: float = number(0.0011, "[0, 0.1]", "of each, white, per axis [m]; gives the pose noise of [mocap]")
    cameras: int = number(5, "[2, 64]", "evenly around the tunnel; paper, Motion capture system")
    camera_distance: float = number(2.5, "(0.5, 20]", "from the tunnel's axis [m]; chosen")
    camera_height: float = number(2.0, "[-2, 20]", "z in W [m]; chosen: above the robot")
    min_cameras: int = number(3, "[2, 64]", "that must see a marker; chosen: two rays may meet by chance")
    min_markers: int = number(3, f"[3, {MARKERS}]", "to be placed for a pose; geometry: three fix one")
    max_error: float = number(0.005, "(0, 1]", "mean distance from the fit [m]; above, no pose; chosen")
    mislabelled: Probability = Field(
        0.0, description="share of frames in which two markers, any two, have each other's label"
    )
    ghosts: int = number(0, "[0, 100]", "reflections near the robot that are not markers, per frame")

    @model_validator(mode="after")
    def _enough_cameras(self) -> MarkersConfig:
        if self.min_cameras > self.cameras:
            raise ValueError(f"min_cameras = {self.min_cameras} of {self.cameras} cameras never see anything")
        return self


class SerialConfig(Section):
    """The serial line. Bit errors and the cable can change in flight: see `VirtualSerial`."""

    baud: int = number(921_600, "[9600, 3_000_000]", "bits, 10 per byte [1/s]; as on PX4's companion ports")
    receive_buffer: int = number(512, "[128, 65_536]", "of the board, until read [bytes]; choice")
    transmit_buffer: int = number(1024, "[512, 65_536]", "of the board [bytes]; choice: 11 ms at 921600")
    interrupt_threshold: int = number(64, "[1, 128]", "bytes for an interrupt; half of a 128-byte DMA buffer")
    host_latency_us: int = number(1000, "[0, 100_000]", "program to line, each way [us]; FTDI, low_latency")
    uplink_bit_error_rate: float = number(0.0, "[0, 1]", "wrong bits to the board [1]; a fault")
    downlink_bit_error_rate: float = number(0.0, "[0, 1]", "wrong bits to the ground [1]; a fault")
