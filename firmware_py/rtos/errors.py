"""What can go wrong in the scheduler. Full queues and timeouts are results, not errors."""

from firmware_py.errors import FirmwareError


class KernelError(FirmwareError):
    """The kernel was used in a way that FreeRTOS asserts against."""


class TaskError(KernelError):
    """A task raised; `task` and `time_us` are which and when, `__cause__` is what."""

    def __init__(self, task: str, time_us: int, what: str) -> None:
        super().__init__(f"task {task} at {time_us / 1000:.3f} ms: {what}")
        self.task = task
        self.time_us = time_us


class StuckTaskError(TaskError):
    """A task keeps calling the kernel while no time passes, so that simulated time cannot go on."""


class WatchdogError(TaskError):
    """The watchdog was not fed in time; `task` is the one that had the processor."""
