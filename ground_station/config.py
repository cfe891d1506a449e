"""Every key of the ground station's sections of a profile, with unit and source."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from firmware_py.section import Section, number


class StationConfig(Section):
    """How the ground station uses frames."""

    corrections_hz: float = number(
        50.0, "[1, 200]", "corrections per second [Hz], if there are that many frames; original"
    )
    link_latency_us: int = number(
        1400,
        "[0, 100_000]",
        "from the link's input to the board [us], where it is not measured; mean of VirtualRadio",
    )


class PilotConfig(Section):
    """The flight of a robot with the Crazyflie's own firmware: from the floor to the floor, by the Crazyflie's services."""

    enabled: bool = Field(False, description="true: the board has the Crazyflie's own firmware, an image")
    parameters: dict[str, dict[str, float]] = Field(
        {},
        description="written before the take-off, by group and name; stabilizer.estimator 2 is Kalman, "
        "stabilizer.controller 1 PID, 2 Mellinger, 3 INDI",
    )
    poses: bool = Field(
        True, description="whether the board gets the cameras' poses; false: it flies by its own decks"
    )
    take_off_s: float = number(2.0, "[0.5, 20]", "from the floor to home [s]; cflib's examples")
    settle_s: float = number(2.0, "[0, 60]", "at home before the experiment's trajectory begins [s]; chosen")
    land_s: float = number(2.0, "[0.5, 20]", "from the last goal to the floor [s]; cflib's examples")

    @property
    def values(self) -> dict[str, float]:
        """The parameters by their full names, `group.name`."""
        groups = self.parameters.items()
        return {f"{group}.{name}": value for group, one in groups for name, value in one.items()}


class TrackerConfig(Section):
    """Which poses of the robot the ground station accepts."""

    enabled: bool = Field(True, description="false: frames go to the link as they come, as in the original")
    position_noise: float = number(0.0005, "(0, 0.1]", "of poses, per axis [m]; that of [mocap]")
    rotation_noise: float = number(0.004, "(0, 0.5]", "of poses, per axis [rad]; that of [mocap]")
    acceleration: float = number(
        15.0,
        "(0, 1000]",
        "standard deviation, constant for a frame [m/s^2]; a push of 20 N (59 m/s^2) is 6 standard deviations "
        "of the pose at most",
    )
    angular_acceleration: float = number(
        100.0,
        "(0, 10_000]",
        "standard deviation, constant for a frame [rad/s^2]; a torque of 1 N m (680 rad/s^2) is 7.1 of the pose",
    )
    gate: float = number(
        8.0,
        "[3, 20]",
        "standard deviations by which position or rotation may deviate [1]: 7 mm or 3 deg from frame to frame; "
        "5.2 at most in all experiments",
    )
    reacquire_us: int = number(
        400_000,
        "[50_000, 5_000_000]",
        "without a good pose, then the track begins again [us]; the board's failsafe comes after 500 ms",
    )


System = Literal["optitrack", "vicon", "qualisys", "vrpn"]
Axes = Literal["z-up", "y-up"]


class CaptureConfig(Section):
    """The real motion capture system; the virtual cameras are `[mocap]`, and `mocap.period_us` applies to both."""

    system: System = Field("optitrack", description="optitrack: Motive, also that of `floaty serve`")
    host: str = Field("127.0.0.1", min_length=1, description="where the system's computer is")
    port: int | None = number(
        None,
        "[0, 65534]",
        "default: the system's own; optitrack 1510, vicon 801, qualisys 22222, vrpn 3883; 0: `floaty serve` finds one",
    )
    multicast: bool = Field(
        False,
        description="optitrack: insist on frames by multicast; `floaty serve` sends no others",
    )
    natnet: Literal["3.1", "4.1"] = Field(
        "4.1", description="the version that the Motive of `floaty serve` streams"
    )
    body: str = Field("", description="the rigid body's name in the system; empty: the only one there is")
    axes: Axes | None = Field(
        None,
        description="which axis points up; default: y-up for optitrack, as Motive streams, z-up for others",
    )
    origin: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="the tunnel's centre in the system's frame, axes turned z up [m]"
    )
    yaw: float = number(0.0, "[-7, 7]", "of the tunnel's x axis in the system's frame, about z up [rad]")
    body_offset: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0),
        description="the robot's centre of mass in the rigid body's frame, axes turned z up [m]",
    )
    body_yaw: float = number(
        0.0, "[-7, 7]", "of the robot's x axis in the rigid body's frame, about z up [rad]"
    )
    latency_us: int = number(
        5000,
        "[0, 500_000]",
        "vicon, qualisys, vrpn: exposure to arrival, since their client reports no times [us]; "
        "chosen, to be measured",
    )


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """The settings of links; each back end uses its own."""

    corrections_hz: float
    latency_us: int  # to the board, until it is measured
    baud: int  # for URIs without one
    signing_key: bytes = b""  # 32 bytes; empty: nothing is signed
    signing_start: int = 0  # time stamp of MAVLink's signatures when the clock is 0 [10 us since 2015-01-01]
    # Receives every MAVLink frame, in both directions.
    note_frame: Callable[[int, bytes], object] | None = None


class GroundConfig(Section):
    """All settings of a ground station, from a profile or a separate file."""

    station: StationConfig = Field(default_factory=StationConfig)
    tracker: TrackerConfig = Field(default_factory=TrackerConfig)
    capture: CaptureConfig = Field(default_factory=CaptureConfig)
    frame_period_us: int = number(5_000, "[1000, 1_000_000]", "between two frames of the cameras [us]")
    home: tuple[float, float, float] = Field((0.0, 0.0, 1.15), description="of the goal, W [m]")
    baud: int = number(921_600, "[9600, 3_000_000]", "of a serial line whose address names none")
    signing_key: str = Field(
        "",
        pattern="^([0-9a-fA-F]{64})?$",
        description="MAVLink 2 signing, 32 bytes in hexadecimal; empty: unsigned",
    )

    def links(self, note_frame: Callable[[int, bytes], object] | None = None) -> LinkSettings:
        """Return the settings of links; a link never sends more poses than the cameras deliver."""
        return LinkSettings(
            corrections_hz=min(self.station.corrections_hz, 1e6 / self.frame_period_us),
            latency_us=self.station.link_latency_us,
            baud=self.baud,
            signing_key=bytes.fromhex(self.signing_key),
            note_frame=note_frame,
        )
