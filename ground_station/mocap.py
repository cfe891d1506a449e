"""What a motion capture system says about the robot."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class MocapFrame:
    """The body's pose in the world at one exposure of the cameras, and when it passed where; None: not told.

    All instants are of the ground station's clock.
    """

    t_us: int  # the exposure
    p_WB: tuple[float, float, float]  # [m]
    q_WB: tuple[float, float, float, float]  # w x y z
    valid: bool  # False: the body was not tracked, the pose means nothing
    received_us: int | None = None  # the motion capture computer has the images
    transmitted_us: int | None = None  # the pose leaves it
    arrived_us: int | None = None  # the ground station has it


def is_pose(p: Sequence[float], q: Sequence[float]) -> bool:
    """Whether numbers of a motion capture system are a place and a rotation."""
    return abs(math.hypot(*q) - 1.0) < 0.01 and all(map(math.isfinite, p))  # the former is false for NaN


class MocapSource(Protocol):
    """A motion capture system in real time; time stamps are of `ground_station.clock.clock_us`."""

    def open(self) -> None:
        """Connect; raises `MocapError`."""
        ...

    def receive(self, timeout_s: float) -> MocapFrame | None:
        """The next frame, None when none comes in time."""
        ...

    def notices(self) -> list[str]:
        """Lines for the user since the last call."""
        ...

    def summary(self) -> str:
        """A few words on how it does."""
        ...

    def close(self) -> None:
        """Disconnect."""
        ...
