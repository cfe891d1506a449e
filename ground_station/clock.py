"""The clock of a ground station that works in real time: microseconds, the same in all processes of a computer."""

import time


def clock_us() -> int:
    """The time since some instant in the past [us]; it never goes back."""
    return time.monotonic_ns() // 1000
