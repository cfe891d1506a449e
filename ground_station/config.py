"""Every key of the ground station's sections of a profile, with unit and source."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class StationConfig(BaseModel):
    """What the ground station does with frames."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    corrections_hz: float = Field(
        50.0, ge=1, le=200, description="corrections per second [Hz], if there are that many frames; original"
    )
    link_latency_us: int = Field(
        1400,
        ge=0,
        le=100_000,
        description="from the link's input to the board [us], where it is not measured; mean of VirtualRadio",
    )


class TrackerConfig(BaseModel):
    """What the ground station accepts as a pose of the robot."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    enabled: bool = Field(True, description="false: frames go to the link as they come, as in the original")
    position_noise: float = Field(0.0005, gt=0, le=0.1, description="of poses, per axis [m]; that of [mocap]")
    rotation_noise: float = Field(
        0.004, gt=0, le=0.5, description="of poses, per axis [rad]; that of [mocap]"
    )
    acceleration: float = Field(
        15.0,
        gt=0,
        le=1000,
        description="standard deviation, constant for a frame [m/s^2]; a push of 20 N (59 m/s^2) is 6 standard deviations "
        "of the pose at most",
    )
    angular_acceleration: float = Field(
        100.0,
        gt=0,
        le=10_000,
        description="standard deviation, constant for a frame [rad/s^2]; a torque of 1 N m (680 rad/s^2) is 7.1 of the pose",
    )
    gate: float = Field(
        8.0,
        ge=3,
        le=20,
        description="standard deviations by which position or rotation may deviate [1]: 7 mm or 3 deg from frame to frame; "
        "5.2 at most in all experiments",
    )
    reacquire_us: int = Field(
        400_000,
        ge=50_000,
        le=5_000_000,
        description="without a good pose, then the track begins again [us]; the board's failsafe comes after 500 ms",
    )


System = Literal["optitrack", "vicon", "qualisys", "vrpn"]


Axes = Literal["z-up", "y-up"]


class CaptureConfig(BaseModel):
    """The real motion capture system; the virtual cameras are `[mocap]`, and `mocap.period_us` is for both."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    system: System = Field("optitrack", description="optitrack: Motive, also that of `floaty serve`")
    host: str = Field("127.0.0.1", min_length=1, description="where the system's computer is")
    port: int | None = Field(
        None,
        ge=1,
        le=65535,
        description="default: the system's own; optitrack 1510, vicon 801, qualisys 22222, vrpn 3883",
    )
    multicast: bool = Field(False, description="optitrack: insist on frames by multicast")
    body: str = Field("", description="the rigid body's name in the system; empty: the only one there is")
    axes: Axes | None = Field(
        None,
        description="which axis points up; default: y-up for optitrack, as Motive streams, z-up for others",
    )
    origin: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="the tunnel's centre in the system's frame, axes turned z up [m]"
    )
    yaw: float = Field(
        0.0, ge=-7, le=7, description="of the tunnel's x axis in the system's frame, about z up [rad]"
    )
    body_offset: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0),
        description="the robot's centre of mass in the rigid body's frame, axes turned z up [m]",
    )
    body_yaw: float = Field(
        0.0, ge=-7, le=7, description="of the robot's x axis in the rigid body's frame, about z up [rad]"
    )
    latency_us: int = Field(
        5000,
        ge=0,
        le=500_000,
        description="vicon, qualisys, vrpn: exposure to arrival, since their client reports no times [us]; "
        "chosen, to be measured",
    )
