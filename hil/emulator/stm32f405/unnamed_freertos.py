"""Finds FreeRTOS in the memory of an image without symbols, by the shape of its structures.

The pointer to the running task is the literal that the handler of PendSV loads (FreeRTOS's ports to Cortex-M3 and M4F).
The places of members are those of FreeRTOS V10 with its usual configuration; they are believed of a task whose list items
point back to it. All lists in memory, the kernel's and those of queues, lead to the tasks. Names of queues and kinds of
waits stay unknown.
"""

from __future__ import annotations

from collections.abc import Iterator
from struct import unpack, unpack_from

import numpy as np

from firmware_py.export.elf import MEMORIES
from hil.emulator.stm32f405.debug_info import Member, Structure
from hil.emulator.stm32f405.freertos import MOST_TASKS, FreeRtos, Read, TaskView, Wait
from hil.emulator.stm32f405.image import Image
from hil.errors import LabError

PENDSV = 14  # its place in the vector table
LITERAL_WITHIN = 16  # half words from the handler's start
ITEM, LIST = 20, 20  # sizes of ListItem_t and List_t
LIST_END = 0xFFFF_FFFF  # the value of a list's end
NAME_SIZE = 16
MOST_PRIORITIES = 32


def _task_structure() -> Structure:
    members = {"pxTopOfStack": 0, "uxPriority": 44, "pxStack": 48}
    for item, at in (("xStateListItem", 4), ("xEventListItem", 24)):
        members |= {f"{item}.xItemValue": at, f"{item}.pvOwner": at + 12, f"{item}.pvContainer": at + 16}
    found = {name: Member(offset, 4) for name, offset in members.items()}
    return Structure("tskTaskControlBlock", 0, {**found, "pcTaskName": Member(52, NAME_SIZE)})


class UnnamedFreeRtos(FreeRtos):
    """The kernel of an image without names; before its first task runs, nothing of it is known."""

    def __init__(self, read: Read, current: int) -> None:
        self._read, self._current, self._task = read, current, _task_structure()
        self._container = "pvContainer"
        self._ready = (0, 0)  # begin and end of the lists of ready tasks

    @classmethod
    def of(cls, image: Image, read: Read) -> UnnamedFreeRtos | None:
        """Return the kernel of an image whose handler of PendSV is FreeRTOS's."""
        current = _current_place(image)
        return cls(read, current) if current else None

    @property
    def places(self) -> tuple[int, int, int, int, int]:
        if not self._ready[1]:
            self._find_lists()
        stack, container = (self._task[name].offset for name in ("pxStack", "xStateListItem.pvContainer"))
        return (self._current if self._ready[1] else 0, stack, container, *self._ready)

    @property
    def running(self) -> bool:
        return self.places[0] != 0 and self._is_task(self.current_block)

    @property
    def heap_bytes(self) -> tuple[None, None]:
        return None, None

    def tasks(self) -> list[TaskView]:
        running, (begin, end) = self.current_block if self.running else 0, self._ready
        views = []
        for task in self._all_tasks():
            container = self._word(task + self._task["xStateListItem.pvContainer"].offset)
            state = "ready" if begin <= container < end else "blocked"
            views.append(self.task(task, "running" if task == running else state))
        return sorted(views, key=lambda view: (-view.priority, view.name))

    def endless_wait(self, task: int) -> Wait | None:
        """Return None: what a task waits for has no name."""
        return None

    def _find_lists(self) -> None:
        """Find the kernel's lists around that of the running task, which is ready."""
        task = self.current_block
        if not self._is_task(task):
            return
        container = self._word(task + self._task["xStateListItem.pvContainer"].offset)
        priority = self._word(task + self._task["uxPriority"].offset)
        begin = container - LIST * priority
        if priority >= MOST_PRIORITIES or not self._is_list(container) or not self._is_list(begin):
            return
        highest = max(self._word(one + self._task["uxPriority"].offset) for one in {task, *self._all_tasks()})
        self._ready = (begin, begin + LIST * (highest + 1))

    def _all_tasks(self) -> set[int]:
        """Return the tasks in all lists in memory."""
        tasks: set[int] = set()
        for _, base, size in MEMORIES:
            words = np.frombuffer(self._read(base, size), "<u4")
            ends = base + 4 * np.flatnonzero(words[2:-2] == LIST_END)  # of lists that begin there
            for at in ends.tolist():
                if self._is_list(at):
                    tasks.update(self._members_at(at))
        return tasks

    def _members_at(self, at: int) -> Iterator[int]:
        """Yield the tasks in the list at an address."""
        count, _, _, item, _ = unpack("<5I", self._read(at, LIST))
        for _ in range(min(count, MOST_TASKS)):
            if not _in_memory(item):
                return
            _, following, _, owner, _ = unpack("<5I", self._read(item, ITEM))
            if self._is_task(owner):
                yield owner
            item = following

    def _is_list(self, at: int) -> bool:
        try:
            count, index, end, following, before = unpack("<5I", self._read(at, LIST))
        except LabError:
            return False
        empty = following == before == at + 8
        places = (index, following, before)
        return (
            end == LIST_END and (count == 0) == empty and count < MOST_TASKS and all(map(_in_memory, places))
        )

    def _is_task(self, block: int) -> bool:
        """Return whether both list items of a control block point back to it, and its name can be read."""
        if not _in_memory(block):
            return False
        try:
            owners = {
                self._word(block + self._task[f"{item}.pvOwner"].offset)
                for item in ("xStateListItem", "xEventListItem")
            }
            name = self._read(block + self._task["pcTaskName"].offset, NAME_SIZE).partition(b"\0")[0]
        except LabError:
            return False
        return owners == {block} and name.isascii() and name.decode("ascii").isprintable() and bool(name)


def _in_memory(address: int) -> bool:
    return not address & 3 and any(base <= address < base + size for _, base, size in MEMORIES)


def _current_place(image: Image) -> int:
    """Return the address of the pointer to the running task, 0 if it cannot be found."""
    handler = int.from_bytes(image.code[4 * PENDSV :][:4], "little") & ~1
    begin = handler - image.base
    if not 0 <= begin <= len(image.code) - 2 * LITERAL_WITHIN:
        return 0
    for index, half_word in enumerate(unpack_from(f"<{LITERAL_WITHIN}H", image.code, begin)):
        if half_word >> 11 == 0b01001:  # LDR (literal), encoding T1
            at = ((handler + 2 * index + 4) & ~3) + 4 * (half_word & 0xFF) - image.base
            word = int.from_bytes(image.code[at : at + 4], "little")
            return word if _in_memory(word) else 0
    return 0
