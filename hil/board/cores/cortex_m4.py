"""The flight core as ARM machine code, executed instruction by instruction by the emulated STM32F405.

The image is in flash, the structs and a stack are in RAM. A call copies the structs in, runs one entry point to its end
and copies them out: the result is what the board would compute. Instructions and cycles become the processor time of the
tasks: upper figures of ARM's manual, and flash read through a cache that is empty when the call begins.
"""

import ctypes
from pathlib import Path

import numpy as np

from firmware_py.core_runner import CoreBlocks
from firmware_py.export.arm_image import CoreImage
from firmware_py.export.elf import FLASH, FLASH_SIZE, RAM
from firmware_py.export.errors import ExportError
from firmware_py.export.usage import CLOCK_MHZ, EntryLoad, Usage
from firmware_py.logic.plugs import ANSWERING
from hil.emulator.stm32f405.chip import SECOND, Chip, StopReason
from hil.emulator.stm32f405.crash import fault_reasons

ROOM = 0x8000  # of the RAM, for structs and stack
STACK_TOP = RAM + ROOM  # full descending
STACK_PATTERN = 0xA5
STACK_LEAST = 0x1000
REGISTERS = 4  # that carry arguments
ALIGNMENT = 16
EXCEPTIONS = 16  # of the processor itself
LANDING = FLASH + FLASH_SIZE - 16  # where a call returns to, and stops
FAULT = LANDING - 16  # where a fault stops
VECTORS = FAULT - 4 * EXCEPTIONS
COPROCESSORS, FLOATS = 0xE000_ED88, (0xF << 20).to_bytes(4, "little")  # CPACR: with the floating-point unit

STOPS: dict[int, str] = {
    StopReason.TIME: "it has run for a second", StopReason.LOW_READ: "read near address 0",
    StopReason.LOW_WRITE: "write near address 0",
}  # fmt: skip


class CortexM4Runner:
    """A `CoreRunner` and a `CoreCosts`; `load` counts by entry point, `instructions` and `cycles` are of the last call.

    `blocks` must have the layout for which the image was exported; `machine` is what `build_machine` returned.
    Raises `ExportError` when the blocks are too large for the RAM.
    """

    def __init__(self, blocks: CoreBlocks, image: CoreImage, machine: Path) -> None:
        self.image = image
        self.load = {name: EntryLoad() for name in image.entries}
        self.instructions = self.cycles = 0
        self._chip = Chip(image.code, FLASH, machine, image.constants)
        self._chip.write(VECTORS, (FAULT | 1).to_bytes(4, "little") * EXCEPTIONS)
        self._chip.write(COPROCESSORS, FLOATS)
        self._chip.state.vtor = VECTORS
        self._chip.breakpoints = {LANDING, FAULT}
        self._ram = self._chip.ram[:ROOM]
        self._ram[:] = STACK_PATTERN
        here = {name: block.memory.view(np.uint8) for name, block in blocks.named.items()}
        sizes = [-(-memory.size // ALIGNMENT) * ALIGNMENT for memory in here.values()]
        places = [sum(sizes[:index]) for index in range(len(sizes) + 1)]
        self._stack_end = places[-1]
        if self._stack_end > ROOM - STACK_LEAST:
            raise ExportError(
                f"the core's memory is {self._stack_end} bytes: at most {ROOM - STACK_LEAST} fit"
            )
        self.ram_bytes = sum(memory.size for memory in here.values())  # the memory of the structs
        there = {
            name: self._ram[place : place + memory.size]
            for place, (name, memory) in zip(places[:-1], here.items(), strict=True)
        }
        # of each call: the memory that it takes, here and in the RAM
        self._memories = {
            name: [(here[block], there[block]) for block in taken] for name, taken in blocks.calls.items()
        }
        addresses = dict(zip(blocks.named, (RAM + place for place in places), strict=False))
        self._registers: dict[str, dict[str, int]] = {}
        self._stacked: dict[str, bytes] = {}  # the arguments after the fourth
        for name, listed in blocks.calls.items():
            given = [addresses[block] for block in listed]
            self._stacked[name] = np.array(given[REGISTERS:], np.uint32).tobytes()
            top = STACK_TOP - -(-len(self._stacked[name]) // 8) * 8
            registers = {f"r{i}": place for i, place in enumerate(given[:REGISTERS])}
            self._registers[name] = {"pc": image.entries[name], "sp": top, "lr": LANDING | 1, **registers}
        self._filed_cycles = 0  # for poses since the last step of the estimator
        self._ahead: tuple[str, bytes] | None = None  # the call whose results RAM holds, and its inputs

    def call(self, name: str) -> int:
        """Execute an entry point; results computed ahead from the same inputs are reused."""
        if self._ahead is None or self._ahead != (name, self._inputs(name)):
            self._execute(name)
        self._ahead = None
        for here, there in self._memories[name]:
            here[:] = there
        self.load[name].add(self.instructions, self.cycles)
        if name == "file_pose":
            self._filed_cycles += self.cycles
        elif name == "estimate":
            self._filed_cycles = 0
        return ctypes.c_int32(self._chip.register("r0")).value if name in ANSWERING else 0

    def estimate_us(self) -> int:
        """Return the processor time of the estimator's next call, with that of the poses filed since the last one."""
        return _microseconds(self._filed_cycles + self._look_ahead("estimate"))

    def control_us(self) -> int:
        """Return the processor time of the controller's next call."""
        return _microseconds(self._look_ahead("control"))

    @property
    def stack_bytes(self) -> int:
        """How many bytes of stack were used at most so far."""
        touched = self._ram[self._stack_end :] != STACK_PATTERN
        return int(touched.size - touched.argmax()) if touched.any() else 0

    @property
    def usage(self) -> Usage:
        return Usage(len(self.image.code), self.ram_bytes, self.stack_bytes, self.load)

    def _look_ahead(self, name: str) -> int:
        """Run an entry point without copying its results out; return its cycles."""
        self._execute(name)
        self._ahead = name, self._inputs(name)
        return self.cycles

    def _inputs(self, name: str) -> bytes:
        return b"".join([here.tobytes() for here, _ in self._memories[name]])

    def _execute(self, name: str) -> None:
        chip, registers = self._chip, self._registers[name]
        for here, there in self._memories[name]:
            there[:] = here
        if stacked := self._stacked[name]:
            chip.write(registers["sp"], stacked)
        for register, value in registers.items():
            chip.set_register(register, value)
        chip.empty_flash_cache()
        begun, instructions = chip.state.now, chip.state.instructions
        reason = chip.run(begun + SECOND)
        while reason == StopReason.DIVISION:  # by zero is 0
            reason = chip.run(begun + SECOND)
        if reason != StopReason.BREAK or chip.state.pc != LANDING:
            raise ExportError(f"{self.image.path}: {name} stopped at {self._stop(reason)}")
        self.instructions = chip.state.instructions - instructions
        self.cycles = chip.state.begun_at - begun  # before the landing

    def _stop(self, reason: int) -> str:
        """Return the place and reason of a stop that is not the landing."""
        chip, place = self._chip, self._chip.state.pc
        if place == FAULT:
            place = int.from_bytes(chip.read(chip.register("sp") + 24, 4), "little")  # stacked, B1.5.6
        return f"0x{place:08x}: {STOPS.get(reason) or fault_reasons(chip)}"


def _microseconds(cycles: int) -> int:
    return -(-cycles // CLOCK_MHZ)
