"""Which motion capture system there is, and how its frame and its rigid body lie to the tunnel and the robot."""

from collections.abc import Sequence
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from ground_station.errors import MocapError

System = Literal["virtual", "optitrack", "vicon", "qualisys", "vrpn"]
Axes = Literal["z-up", "y-up"]


class CaptureConfig(BaseModel):
    """The real motion capture system; the virtual cameras are `[mocap]`, and `mocap.period_us` is for both."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    system: System = Field("virtual", description="virtual: poses of `floaty board serve`, in W already")
    host: str = Field("127.0.0.1", min_length=1, description="where the system's computer is")
    port: int | None = Field(
        None,
        ge=1,
        le=65535,
        description="default: the system's own; virtual 19870, optitrack 1510, vicon 801, qualisys 22222, vrpn 3883",
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
        description="vicon, qualisys, vrpn: exposure to arrival, since their client says no times [us]; "
        "chosen, to be measured",
    )


def choose_body(wanted: str, names: Sequence[str]) -> str:
    """The name of the body to follow, out of those there are; `MocapError` when it is not clear which."""
    if wanted in names:
        return wanted
    if not wanted and len(names) == 1:
        return names[0]
    what = f"no body {wanted!r}" if wanted else "body=NAME is missing"
    raise MocapError(f"{what}; there are: {', '.join(names) or 'none'}")
