"""What the pins of the board offer to the firmware: raw counts and bytes, nothing in SI."""

from collections.abc import Sequence
from typing import Protocol

ImuCounts = tuple[int, int, int, int, int, int]  # gyro x y z, accelerometer x y z, int16, sensor frame


class Board(Protocol):
    """The hardware below the drivers."""

    def read_imu(self) -> ImuCounts:
        """Return the registers of the BMI088 as they are now."""
        ...

    def write_compare(self, counts: Sequence[int]) -> None:
        """Load the four servo compare registers [timer counts of 1/21 us]; they act from the next PWM period on."""
        ...

    def radio_send(self, data: bytes) -> bool:
        """Hand a packet to the radio chip; False when its queue is full."""
        ...

    def debug_write(self, text: str) -> None:
        """Write a line to the debug console."""
        ...
