"""A motion capture system's reports on the robot."""

from dataclasses import dataclass, replace
from typing import Protocol

from firmware_py.wire.crtp import FAR


@dataclass(slots=True)
class MocapFrame:
    """The body's pose in the world at one exposure of the cameras, and the instants of its stages; None: not reported.

    All instants are on the ground station's clock.
    """

    t_us: int  # the exposure
    p_WB: tuple[float, float, float]  # [m]
    q_WB: tuple[float, float, float, float]  # w x y z
    valid: bool  # False: not tracked, the pose is meaningless; True is unchecked until `judged`
    received_us: int | None = None  # arrival of the images at the motion capture computer
    transmitted_us: int | None = None  # departure of the pose from it
    arrived_us: int | None = None  # arrival at the ground station


def judged(frame: MocapFrame) -> MocapFrame:
    """Return a frame from any source, valid only if its numbers are a position and a rotation.

    The comparisons are false for NaN and infinity, too.
    """
    x, y, z = frame.p_WB
    a, b, c, d = frame.q_WB
    is_pose = abs(x) + abs(y) + abs(z) < FAR and abs(a * a + b * b + c * c + d * d - 1.0) < 0.02
    return frame if is_pose or not frame.valid else replace(frame, valid=False)


class MocapSource(Protocol):
    """A motion capture system in real time; time stamps are of `ground_station.clock.clock_us`."""

    def open(self) -> None:
        """Connect; raises `MocapError`."""

    def receive(self, timeout_s: float) -> MocapFrame | None:
        """Return the next frame, None when none comes in time."""

    def notices(self) -> list[str]:
        """Return lines for the user since the last call."""

    def summary(self) -> str:
        """Return a few words on the state."""

    def close(self) -> None:
        """Disconnect."""
