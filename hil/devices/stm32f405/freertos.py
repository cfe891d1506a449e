"""FreeRTOS as it stands in the memory of a running image: tasks, stacks and heap, by symbols and debugging information.

The names are those of FreeRTOS V10 (tasks.c, list.h, heap_4.c); where its members lie is read from the image, because that
depends on its configuration. A look in the middle of a critical section sees what the kernel sees there.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from struct import unpack

from hil.devices.stm32f405.image import Image
from hil.errors import LabError

Read = Callable[[int, int], bytes]  # (address, size)

UNUSED = 0xA5  # what a stack is filled with
WAITING_FOR_NOTIFICATION = 1
STACK_CHUNK, MOST_TASKS = 64, 256
SWITCH = "vTaskSwitchContext"
HEAP, HEAP_LEAST = "xFreeBytesRemaining", "xMinimumEverFreeBytesRemaining"  # of heap_4


@dataclass(frozen=True, slots=True)
class TaskView:
    """One task; `stack_free_bytes` were never used since it was created."""

    name: str
    state: str  # running, ready, blocked, suspended or deleted
    priority: int
    base_priority: int  # without what it inherits of a mutex
    stack_free_bytes: int


class FreeRtos:
    """The kernel of an image; `read` reads the machine's memory. Raises `LabError` for an image without FreeRTOS."""

    def __init__(self, image: Image, read: Read) -> None:
        self._image, self._read = image, read
        kernel = image.symbol(SWITCH).address
        self._task = image.debug.structure("tskTaskControlBlock", kernel)
        self._list = image.debug.structure("xLIST", kernel)
        self._item = image.debug.structure("xLIST_ITEM", kernel)
        self._container = "pvContainer" if "pvContainer" in self._item.members else "pxContainer"
        self._current = image.symbol("pxCurrentTCB").address

    @property
    def tick_count(self) -> int:
        """Return the ticks since the scheduler started."""
        return self._word(self._image.symbol("xTickCount").address)

    @property
    def running(self) -> bool:
        """Return whether the scheduler was started."""
        return self._word(self._image.symbol("xSchedulerRunning").address) != 0

    @property
    def heap_free_bytes(self) -> int:
        """Return what heap_4 has left."""
        return self._word(self._image.symbol(HEAP).address)

    @property
    def heap_least_free_bytes(self) -> int:
        """Return what it had left when it was fullest."""
        return self._word(self._image.symbol(HEAP_LEAST).address)

    def current(self) -> TaskView:
        """Return the task that has the processor. Raises `LabError` before the first one has it."""
        task = self._word(self._current)
        if not task:
            raise LabError(f"{self._image.path}: no task has run yet")
        return self.task(task, "running")

    def tasks(self) -> list[TaskView]:
        """Return all tasks, by priority and name."""
        states: dict[int, str] = {}
        for name, state in (
            ("xDelayedTaskList1", "blocked"), ("xDelayedTaskList2", "blocked"), ("xSuspendedTaskList", "suspended"),
            ("xTasksWaitingTermination", "deleted"), ("pxReadyTasksLists", "ready"), ("xPendingReadyList", "ready"),
        ):  # fmt: skip
            if self._image.has(name):
                states |= dict.fromkeys(self._members(name), state)
        states = {
            task: "blocked" if state == "suspended" and self._waits(task) else state
            for task, state in states.items()
        }
        states |= {task: "running" for task in (self._word(self._current),) if task}
        views = [self.task(task, state) for task, state in states.items()]
        return sorted(views, key=lambda view: (-view.priority, view.name))

    def _members(self, name: str) -> Iterator[int]:
        """Yield the tasks in a list, or in an array of lists."""
        symbol = self._image.symbol(name)
        for address in range(symbol.address, symbol.address + symbol.size, self._list.size):
            item = self._word(address + self._list["xListEnd.pxNext"].offset)
            count = self._word(address + self._list["uxNumberOfItems"].offset)
            for _ in range(min(count, MOST_TASKS)):
                yield self._word(item + self._item["pvOwner"].offset)
                item = self._word(item + self._item["pxNext"].offset)

    def _waits(self, task: int) -> bool:
        """Return whether a task without a time-out waits for an event; FreeRTOS has it in the list of the suspended."""
        event = self._word(task + self._task[f"xEventListItem.{self._container}"].offset)
        notified = self._read(task + self._task["ucNotifyState"].offset, 1)[0]
        return event != 0 or notified == WAITING_FOR_NOTIFICATION

    def task(self, task: int, state: str) -> TaskView:
        """Return the task with the control block at an address."""
        name = self._task["pcTaskName"]
        text = self._read(task + name.offset, name.size).partition(b"\0")[0].decode(errors="replace")
        priority = self._word(task + self._task["uxPriority"].offset)
        base = (
            self._word(task + self._task["uxBasePriority"].offset)
            if "uxBasePriority" in self._task.members
            else priority
        )
        stack = self._word(task + self._task["pxStack"].offset)
        return TaskView(text, state, priority, base, self._unused(stack))

    def _unused(self, stack: int) -> int:
        """Return how many bytes from the far end of a stack on were never written."""
        unused = 0
        while True:
            chunk = self._read(stack + unused, STACK_CHUNK)
            used = len(chunk.lstrip(bytes((UNUSED,))))
            unused += len(chunk) - used
            if used:
                return unused

    def _word(self, address: int) -> int:
        return int(unpack("<I", self._read(address, 4))[0])
