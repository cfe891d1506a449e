"""FreeRTOS without symbols, in a memory that holds its structures and little else."""

from struct import pack, unpack_from
from types import SimpleNamespace as Made

import pytest

pytest.importorskip("unicorn")

from firmware_py.export.elf import MEMORIES
from hil.emulator.stm32f405.unnamed_freertos import UnnamedFreeRtos
from hil.errors import LabError

RAM, CCM, FLASH = 0x2000_0000, 0x1000_0000, 0x0800_0000
CURRENT, READY, DELAYED, WAITING, TASKS, STACKS = (
    RAM + at for at in (0x40, 0x100, 0x800, 0x840, 0x1000, 0x8000)
)


class Memory:
    """RAM and CCM; lists and tasks as FreeRTOS V10 lays them out."""

    def __init__(self, priorities: int) -> None:
        self.bytes = {base: bytearray(size) for _, base, size in MEMORIES}
        for number in range(priorities):
            self.empty_list(READY + 20 * number)
        self.delayed = READY + 20 * priorities
        for place in (self.delayed, WAITING):
            self.empty_list(place)
        self.tasks: list[int] = []

    def read(self, address: int, size: int) -> bytes:
        for base, memory in self.bytes.items():
            if base <= address and address + size <= base + len(memory):
                return bytes(memory[address - base :][:size])
        raise LabError("nothing there")

    def word(self, address: int) -> int:
        return int(unpack_from("<I", self.read(address, 4))[0])

    def write(self, address: int, *words: int) -> None:
        base = RAM if address >= RAM else CCM
        self.bytes[base][address - base : address - base + 4 * len(words)] = pack(f"<{len(words)}I", *words)

    def empty_list(self, at: int) -> None:
        self.write(at, 0, at + 8, 0xFFFF_FFFF, at + 8, at + 8)

    def insert(self, at: int, item: int, owner: int) -> None:
        last = self.word(at + 16)
        self.write(item, 1, at + 8, last, owner, at)
        self.write(last + 4, item)
        self.write(at + 16, item)
        self.write(at, self.word(at) + 1)

    def task(self, name: bytes, priority: int, at: int, unused: int) -> int:
        """Create a task in a list; so many bytes of its stack were never used."""
        block, stack = TASKS + 0x80 * len(self.tasks), STACKS + 0x200 * len(self.tasks)
        self.tasks.append(block)
        self.insert(at, block + 4, block)
        self.write(block + 24, 0, 0, 0, block, 0)
        self.write(block + 44, priority, stack)
        base = self.bytes[RAM]
        base[block - RAM + 52 : block - RAM + 68] = name.ljust(16, b"\0")
        base[stack - RAM : stack - RAM + 0x200] = b"\xa5" * unused + bytes(0x200 - unused)
        return block


def image_of(handler: list[int], literal: int = CURRENT) -> Made:
    """An image whose PendSV handler has these half words, 64 bytes before its literals."""
    code = bytearray(256)
    code[56:60] = pack("<I", (FLASH + 0x80) | 1)
    code[0x80 : 0x80 + 2 * len(handler)] = pack(f"<{len(handler)}H", *handler)
    code[0xC0:0xC4] = pack("<I", literal)
    return Made(code=bytes(code), base=FLASH)


@pytest.mark.parametrize("at", [0, 1, 2, 15, 16])
@pytest.mark.parametrize("literal", [CURRENT, CURRENT + 2, CCM + 8, 0x0800_0040])
def test_the_pointer_to_the_running_task_is_the_first_literal_that_the_handler_loads(
    at: int, literal: int
) -> None:
    load = 0x4B00 | (0xC0 - (0x80 + 2 * at + 4 & ~3)) // 4
    found = UnnamedFreeRtos.of(image_of([0xBF00] * at + [load, 0x4A00], literal), lambda *place: b"")  # type: ignore[arg-type]
    known = at < 16 and literal in (CURRENT, CCM + 8)
    assert (found is not None) == known
    assert found is None or found._current == literal


@pytest.mark.parametrize(("missing", "known"), [(0, True), (1, False), (8, False)])
def test_a_handler_at_the_end_of_an_image_is_read_whole_or_not_at_all(missing: int, known: bool) -> None:
    image = image_of([0x4B05])  # ldr r3, [pc, #20]
    code = bytearray(image.code[: 0x80 + 32 - missing])
    code[0x80 + 24 : 0x80 + 28] = pack("<I", CURRENT)
    image = Made(code=bytes(code[: 0x80 + 32 - missing]), base=FLASH)
    assert (UnnamedFreeRtos.of(image, lambda *place: b"") is not None) == known  # type: ignore[arg-type]


@pytest.mark.parametrize(("highest", "own"), [(1, 0), (5, 2), (5, 5), (31, 31), (32, 31), (32, 32), (40, 33)])
def test_tasks_are_found_at_each_priority(highest: int, own: int) -> None:
    memory = Memory(highest + 1)
    low = memory.task(b"LOW", own, READY + 20 * own, 64)
    other = memory.task(b"another", highest, READY + 20 * highest, 65)
    sleeper = memory.task(b"SLEEP-16-letters", 1, memory.delayed, 130)
    waiting = memory.task(b"WAIT", 0, WAITING, 0)
    kernel = UnnamedFreeRtos(memory.read, CURRENT)
    assert (kernel.places[0], kernel.running, kernel.heap_bytes) == (0, False, (None, None))
    memory.write(CURRENT, low)
    if own >= 32:
        assert kernel.places == (0, 48, 20, 0, 0)
        return
    assert kernel.places == (CURRENT, 48, 20, READY, READY + 20 * (highest + 1))
    assert kernel.running
    views = [(one.name, one.state, one.priority, one.stack_free_bytes, one.block) for one in kernel.tasks()]
    expected = [
        ("another", "ready", highest, 65, other), ("LOW", "running", own, 64, low),
        ("SLEEP-16-letters", "blocked", 1, 130, sleeper), ("WAIT", "blocked", 0, 0, waiting),
    ]  # fmt: skip
    assert views == sorted(expected, key=lambda one: (-one[2], one[0]))
    assert kernel.endless_wait(sleeper) is None


SPOILT = {  # offset in the running task's block, and the word there
    "state item's owner": (16, 0), "event item's owner": (36, TASKS + 0x80), "no name": (52, 0), "no letter": (52, 0x07),
    "no ASCII": (52, 0x0000_C3C4), "list elsewhere": (20, RAM + 0x4000), "list nowhere": (20, 0x3000_0000),
    "other priority": (44, 1),
}  # fmt: skip


@pytest.mark.parametrize(("at", "word"), SPOILT.values(), ids=SPOILT)
def test_what_does_not_fit_together_is_no_kernel(at: int, word: int) -> None:
    memory = Memory(1)
    block = memory.task(b"TASK", 0, READY, 64)
    memory.write(CURRENT, block)
    assert UnnamedFreeRtos(memory.read, CURRENT).places[0] == CURRENT
    memory.write(block + at, word)
    kernel = UnnamedFreeRtos(memory.read, CURRENT)
    assert (kernel.places[0], kernel.running) == (0, False)


LISTS = {  # words of a list around a task
    "an end of another value": (8, 0xFFFF_FFFE), "more than it has": (0, 256), "empty with an item": (0, 0),
    "an index in no memory": (4, 0x3000_0000), "an odd index": (4, RAM + 0x102), "a place in no memory": (16, 0x3000_0000),
}  # fmt: skip


@pytest.mark.parametrize(("at", "word"), LISTS.values(), ids=LISTS)
def test_a_list_that_does_not_fit_together_leads_to_no_task(at: int, word: int) -> None:
    memory = Memory(3)
    memory.write(CURRENT, memory.task(b"TASK", 0, READY, 64))
    memory.task(b"HIDDEN", 2, memory.delayed, 64)
    memory.write(memory.delayed + at, word)
    kernel = UnnamedFreeRtos(memory.read, CURRENT)
    assert kernel.places[-1] == READY + 20
    assert [one.name for one in kernel.tasks()] == ["TASK"]
