"""The clock of a ground station in real time: microseconds, the same in all processes of a computer."""

import select
import selectors
import time
from collections.abc import Collection
from typing import IO, TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from _typeshed import FileDescriptorLike

F = TypeVar("F", bound="FileDescriptorLike")

_YEAR_2015_US = 1_420_070_400_000_000  # 2015-01-01 00:00 UTC since 1970


def clock_us() -> int:
    """Return the time since some instant in the past [us]; it never goes back."""
    return time.monotonic_ns() // 1000


def wait(duration_s: float) -> None:
    """Sleep."""
    time.sleep(duration_s)


def readable(files: Collection[F], timeout_s: float) -> list[F]:
    """Return those of sockets, pipes and descriptors that have input; wait for the first one at most `timeout_s`.

    `select` waits to the microsecond, but takes only descriptors below 1024; `poll` takes all and waits to the millisecond.
    """
    try:
        return select.select(files, (), (), timeout_s)[0]
    except ValueError:
        with selectors.PollSelector() as selector:
            for each in files:
                selector.register(each, selectors.EVENT_READ)
            return [key.fileobj for key, _ in selector.select(timeout_s)]  # type: ignore[misc]


def is_writable(file: IO[str]) -> bool:
    """Return whether a write to an open file would not wait for its reader; True where the system cannot tell."""
    try:
        output = select.poll()
        output.register(file.fileno(), select.POLLOUT)
    except (AttributeError, OSError, ValueError):  # no file, or no such call on this system
        return True
    return bool(output.poll(0))


def epoch_us() -> int:
    """Return the time since 1970 when `clock_us` was 0 [us]."""
    return time.time_ns() // 1000 - clock_us()


def signing_start() -> int:
    """Return the time stamp of MAVLink's signatures when `clock_us` was 0 [10 us since 2015-01-01]; may be negative."""
    return (epoch_us() - _YEAR_2015_US) // 10
