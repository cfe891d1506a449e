"""The clock of a ground station in real time: microseconds, the same in all processes of a computer."""

import time

_YEAR_2015_US = 1_420_070_400_000_000  # 2015-01-01 00:00 UTC since 1970


def clock_us() -> int:
    """Return the time since some instant in the past [us]; it never goes back."""
    return time.monotonic_ns() // 1000


def wait(duration_s: float) -> None:
    """Sleep."""
    time.sleep(duration_s)


def epoch_us() -> int:
    """Return the time since 1970 when `clock_us` was 0 [us]."""
    return time.time_ns() // 1000 - clock_us()


def signing_start() -> int:
    """Return the time stamp of MAVLink's signatures when `clock_us` was 0 [10 us since 2015-01-01]; may be negative."""
    return (epoch_us() - _YEAR_2015_US) // 10
