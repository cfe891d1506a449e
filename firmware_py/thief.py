"""A task that takes processor time from all others: a test load, no part of a flight."""

from collections.abc import Generator

from firmware_py.rtos import TICK_US, Kernel

PRIORITY = 6  # above every task, like interrupts that do not end


class Thief:
    """How much of every tick the thief takes, 0..1; may change while it runs."""

    __slots__ = ("share",)

    def __init__(self) -> None:
        self.share = 0.0


def thief_task(kernel: Kernel, thief: Thief) -> Generator[int, None, None]:
    """Take a share of every tick before all others."""
    wake_tick = kernel.tick_count
    while True:
        wake_tick += 1
        yield from kernel.delay_until(wake_tick)
        yield from kernel.work(round(thief.share * TICK_US))
