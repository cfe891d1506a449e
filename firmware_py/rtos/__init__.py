"""The scheduler: FreeRTOS V10.4.1's behaviour, event for event, with tasks written as generators.

`Kernel` makes everything else (tasks, queues, semaphores, mutexes, timers) and owns the processor's time. Names are
FreeRTOS's words in Python spelling; ticks are 1 ms, instants are integer microseconds.
"""

from firmware_py.rtos.errors import KernelError, StuckTaskError, TaskError, WatchdogError
from firmware_py.rtos.kernel import Kernel
from firmware_py.rtos.memory import FOREVER, TICK_US
from firmware_py.rtos.queue import Queue
from firmware_py.rtos.semaphore import Mutex, Semaphore
from firmware_py.rtos.statistics import Statistics, TaskReport
from firmware_py.rtos.task import Task
from firmware_py.rtos.timer import Timer

__all__ = [
    "FOREVER",
    "TICK_US",
    "Kernel",
    "KernelError",
    "Mutex",
    "Queue",
    "Semaphore",
    "Statistics",
    "StuckTaskError",
    "Task",
    "TaskError",
    "TaskReport",
    "Timer",
    "WatchdogError",
]
