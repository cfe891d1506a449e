"""A motion capture system's reports on the robot."""

from dataclasses import dataclass, replace
from typing import Protocol

from ground_station.unused import Reason, Unused, flaw

FROZEN_FRAMES = 3  # with exactly the same pose: the system repeats the last one


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
    unused: Unused = (Reason.NOT_TRACKED, ())  # why it is not valid; without meaning for a valid one


def judged(frame: MocapFrame) -> MocapFrame:
    """Return a frame from any source, valid only if its numbers are a position and a rotation."""
    if not frame.valid or (unused := flaw(frame.p_WB, frame.q_WB)) is None:
        return frame
    return replace(frame, valid=False, unused=unused)


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
