"""A load on the processor: what takes a share of every tick before all tasks, like interrupts that do not end."""

from firmware_py.rtos import TICK_US


class Thief:
    """How much of every tick it takes, 0..1; may change at any time."""

    __slots__ = ("share",)

    def __init__(self) -> None:
        self.share = 0.0

    def taken_us(self) -> int:
        """Return what it takes of the present tick."""
        return round(self.share * TICK_US)
