"""Reads FreeRTOS in the memory of a running image: tasks, stacks and heap, by symbols and debugging information.

The names are those of FreeRTOS V10 (tasks.c, list.h, heap_4.c); the places of members are read from the image, because
they depend on its configuration. A read during a critical section sees the kernel's temporary state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from struct import unpack

from hil.emulator.stm32f405.image import Image

Read = Callable[[int, int], bytes]  # (address, size)

NO_FLOATS = 1 << 4  # in EXC_RETURN
FRAME, FLOATS, PADDED = 0x20, 0x48, 1 << 9  # of an exception, ARMv7-M Architecture Reference Manual, B1.5.7
UNUSED = b"\xa5"  # fills a new stack
WAITING_FOR_NOTIFICATION = 1
STACK_CHUNK, MOST_TASKS = 64, 256
LONGEST_DELAY_MS = 3_600_000  # of a task that will run again
LONGEST_QUEUE, LARGEST_ITEM = 1 << 16, 1 << 12  # of a plausible queue
QUEUE_CODE = "xQueueGenericSend"  # in queue.c
RUNNING_TASK = "pxCurrentTCB"
SWITCH = "vTaskSwitchContext"
HEAP, HEAP_LEAST = "xFreeBytesRemaining", "xMinimumEverFreeBytesRemaining"  # of heap_4


@dataclass(frozen=True, slots=True)
class TaskView:
    """One task; `stack_free_bytes` were never used since its creation."""

    name: str
    state: str  # running, ready, blocked, suspended or deleted
    priority: int
    base_priority: int  # without a priority inherited through a mutex
    stack_free_bytes: int
    block: int  # address of its control block


@dataclass(frozen=True, slots=True)
class Wait:
    """What a task waits for without a time-out; `for_messages`: its senders may just have nothing to send."""

    reason: str
    for_messages: bool = False


class FreeRtos:
    """The kernel of an image; `read` reads the machine's memory. Raises `LabError` for an image without FreeRTOS."""

    def __init__(self, image: Image, read: Read) -> None:
        self._image, self._read = image, read
        kernel = image.symbol(SWITCH).address
        self._task = image.debug.structure("tskTaskControlBlock", kernel)
        self._list = image.debug.structure("xLIST", kernel)
        self._item = image.debug.structure("xLIST_ITEM", kernel)
        self._container = "pvContainer" if "pvContainer" in self._item.members else "pxContainer"
        self._current = image.symbol(RUNNING_TASK).address
        self._queue = (
            image.debug.structure("QueueDefinition", image.symbol(QUEUE_CODE).address)
            if image.has(QUEUE_CODE)
            else None
        )

    @classmethod
    def of(cls, image: Image, read: Read) -> FreeRtos | None:
        """Return the kernel of an image that has one."""
        return cls(image, read) if image.has(RUNNING_TASK) else None

    @property
    def places(self) -> tuple[int, int, int, int, int]:
        """Return the places of the current task's pointer, of a task's stack and list, and of the ready lists."""
        ready = self._image.symbol("pxReadyTasksLists")
        stack, container = self._task["pxStack"], self._task[f"xStateListItem.{self._container}"]
        return (self._current, stack.offset, container.offset, ready.address, ready.address + ready.size)

    @property
    def running(self) -> bool:
        return self._word(self._image.symbol("xSchedulerRunning").address) != 0

    @property
    def heap_bytes(self) -> tuple[int, int] | tuple[None, None]:
        """Return the free bytes of heap_4 now and when it was fullest; None for another heap."""
        if not (self._image.has(HEAP) and self._image.has(HEAP_LEAST)):
            return None, None
        return self._word(self._image.symbol(HEAP).address), self._word(
            self._image.symbol(HEAP_LEAST).address
        )

    def tasks(self) -> list[TaskView]:
        """Return all tasks, by priority and name."""
        states: dict[int, str] = {}
        for name, state in (
            ("xDelayedTaskList1", "blocked"), ("xDelayedTaskList2", "blocked"), ("xSuspendedTaskList", "suspended"),
            ("xTasksWaitingTermination", "deleted"), ("pxReadyTasksLists", "ready"), ("xPendingReadyList", "ready"),
        ):  # fmt: skip
            for task in self._members(name) if self._image.has(name) else ():
                states[task] = "blocked" if state == "suspended" and self._waits(task) else state
        if self.current_block:
            states[self.current_block] = "running"
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
        """Return whether a task waits for an event without a time-out; FreeRTOS lists it as suspended."""
        event = self._word(task + self._task[f"xEventListItem.{self._container}"].offset)
        notified = self._read(task + self._task["ucNotifyState"].offset, 1)[0]
        return event != 0 or notified == WAITING_FOR_NOTIFICATION

    def endless_wait(self, task: int) -> Wait | None:
        """Return what a task waits for that no time-out ends; None for a task that runs, is ready or will wake up."""
        item = self._task["xStateListItem.xItemValue"].offset
        container = self._word(task + self._task[f"xStateListItem.{self._container}"].offset)
        where = self._image.variable_at(container) if container else "xTasksWaitingTermination"
        if where == "xTasksWaitingTermination":
            return Wait("it was deleted")
        if where.startswith("xDelayedTaskList"):
            ticks = self._word(task + item) - self._word(self._image.symbol("xTickCount").address)
            return Wait("it is delayed for ever") if ticks % (1 << 32) > LONGEST_DELAY_MS else None
        if where != "xSuspendedTaskList":
            return None
        if event := self._word(task + self._task[f"xEventListItem.{self._container}"].offset):
            return self._wait_in(event)
        return Wait("it waits for a notification" if self._waits(task) else "it is suspended")

    def _wait_in(self, event: int) -> Wait:
        """Return the wait of a task in a list of waiting tasks: a queue's, or that of another object."""
        for member, full in (("xTasksWaitingToReceive", False), ("xTasksWaitingToSend", True)):
            if self._queue is None:
                break
            queue = event - self._queue[member].offset
            head, length, waiting, size = (
                self._word(queue + self._queue[name].offset)
                for name in ("pcHead", "uxLength", "uxMessagesWaiting", "uxItemSize")
            )
            if not (
                0 < length < LONGEST_QUEUE and size < LARGEST_ITEM and waiting == (length if full else 0)
            ):
                continue
            name = self._image.name_of(queue, self._word)
            if full:
                return Wait(f"it waits for room in queue {name}")
            if size:
                return Wait(f"it waits for an item of queue {name}", for_messages=True)
            holder = self._word(queue + self._queue["u.xSemaphore.xMutexHolder"].offset)
            if head == 0 and holder:
                return Wait(f"it waits for mutex {name}, which task {self.name(holder)} holds")
            return Wait(f"it waits for {'semaphore' if head else 'mutex'} {name}")
        return Wait(f"it waits at {self._image.name_of(event, self._word)}")

    def task(self, task: int, state: str) -> TaskView:
        """Return the task with the control block at an address."""
        own, base = (
            self._word(task + self._task[name if name in self._task.members else "uxPriority"].offset)
            for name in ("uxPriority", "uxBasePriority")
        )
        return TaskView(self.name(task), state, own, base, self._unused(self.stack_begin(task)), task)

    def name(self, task: int) -> str:
        """Return the name of the task with the control block at an address."""
        name = self._task["pcTaskName"]
        return self._read(task + name.offset, name.size).partition(b"\0")[0].decode(errors="replace")

    @property
    def current_block(self) -> int:
        """Return the address of the running task's control block, 0 before the first one runs."""
        return self._word(self._current)

    def stack_begin(self, task: int) -> int:
        """Return the lowest address of a task's stack."""
        return self._word(task + self._task["pxStack"].offset)

    def saved_registers(self, task: int) -> dict[str, int]:
        """Return the registers that the Cortex-M4F port saved on the stack of a task that is not running."""
        place = self._word(task + self._task["pxTopOfStack"].offset)
        *saved, exc_return = unpack("<9I", self._read(place, 36))
        place += 36 + (0 if exc_return & NO_FLOATS else 64)
        registers = stacked_registers(self._read, place, exc_return)
        return registers | {f"r{4 + number}": value for number, value in enumerate(saved)}

    def _unused(self, stack: int) -> int:
        """Return how many bytes at the far end of a stack were never written."""
        end = stack
        while not (used := self._read(end, STACK_CHUNK).lstrip(UNUSED)):
            end += STACK_CHUNK
        return end - stack + STACK_CHUNK - len(used)

    def _word(self, address: int) -> int:
        return int(unpack("<I", self._read(address, 4))[0])


def stacked_registers(read: Read, frame: int, exc_return: int) -> dict[str, int]:
    """Return the registers that an exception stacked, and the previous stack pointer; raises `LabError` without memory."""
    stacked = unpack("<8I", read(frame, FRAME))
    size = FRAME + (0 if exc_return & NO_FLOATS else FLOATS) + (4 if stacked[7] & PADDED else 0)
    names = ("r0", "r1", "r2", "r3", "r12", "lr", "pc", "xpsr")
    return dict(zip(names, stacked, strict=True)) | {"sp": frame + size}
