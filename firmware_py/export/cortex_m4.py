"""The flight core as ARM machine code, executed instruction by instruction by the emulator unicorn.

An emulated Cortex-M4F has the image in flash and the structs with a stack in RAM. A call copies the structs in,
runs one entry point to its end and copies them out: the result is what the board would compute. Meanwhile
`arm/meter.c` counts instructions and cycles, which become the processor time of the tasks: upper figures of ARM's manual
for every instruction, flash read through a cache that is empty when the call begins, 168 MHz.
"""

import ctypes
import mmap
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.core_runner import CoreBlocks
from firmware_py.export.arm_image import CoreImage
from firmware_py.export.cycles import count
from firmware_py.export.elf import FLASH, FLASH_SIZE
from firmware_py.export.errors import ExportError
from firmware_py.export.usage import CLOCK_MHZ, EntryLoad, Usage
from firmware_py.extras import install_command
from firmware_py.logic.plugs import ANSWERING

RAM = 0x2000_0000
RAM_SIZE = 0x8000
STACK_TOP = RAM + RAM_SIZE  # full descending
STACK_PATTERN = 0xA5
STACK_LEAST = 0x1000
REGISTERS = 4  # that carry arguments
ALIGNMENT = 16
UNDEFINED = b"\xde"  # two of them are UDF: a stray jump into empty flash is stopped
LANDING = FLASH + FLASH_SIZE - 16  # where a call returns to, and stops


def find_emulator() -> Any:
    """Return the package unicorn. Raises `ExportError` when it is missing."""
    try:
        import unicorn
    except ImportError:
        raise ExportError(f"unicorn is missing: {install_command('deploy')}") from None
    return unicorn


class CortexM4Runner:
    """A `CoreRunner` and a `CoreCosts`; `load` counts by entry point, `instructions` those of the last call.

    `blocks` must have the layout for which the image was exported; `meter` is what `build_meter` returned.
    Raises `ExportError` when unicorn is missing, or the blocks are too large for the RAM.
    """

    def __init__(self, blocks: CoreBlocks, image: CoreImage, meter: Path) -> None:
        unicorn = find_emulator()
        from unicorn import arm_const, unicorn_const

        self.image = image
        self.load = {name: EntryLoad() for name in image.entries}
        self._fault = unicorn.UcError
        self._result, self._pc = arm_const.UC_ARM_REG_R0, arm_const.UC_ARM_REG_PC
        self._cpu = unicorn.Uc(unicorn_const.UC_ARCH_ARM, unicorn_const.UC_MODE_THUMB)
        self._cpu.ctl_set_cpu_model(arm_const.UC_CPU_ARM_CORTEX_M4)  # UC_MODE_MCLASS would make it an M33
        self._cpu.mem_map(FLASH, FLASH_SIZE, unicorn_const.UC_PROT_READ | unicorn_const.UC_PROT_EXEC)
        self._cpu.mem_write(FLASH, image.code.ljust(FLASH_SIZE, UNDEFINED))
        self._ram = np.frombuffer(mmap.mmap(-1, RAM_SIZE), np.uint8)
        self._ram[:] = STACK_PATTERN
        ram = self._ram.ctypes.data
        self._cpu.mem_map_ptr(RAM, RAM_SIZE, unicorn_const.UC_PROT_READ | unicorn_const.UC_PROT_WRITE, ram)
        here = {name: block.memory.view(np.uint8) for name, block in blocks.named.items()}
        sizes = [-(-memory.size // ALIGNMENT) * ALIGNMENT for memory in here.values()]
        places = [sum(sizes[:index]) for index in range(len(sizes) + 1)]
        self._stack_end = places[-1]
        if self._stack_end > RAM_SIZE - STACK_LEAST:
            raise ExportError(
                f"the core's memory is {self._stack_end} bytes: at most {RAM_SIZE - STACK_LEAST} fit"
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
        r0, sp, lr = self._result, arm_const.UC_ARM_REG_SP, arm_const.UC_ARM_REG_LR
        self._registers = {}
        self._stacked: dict[str, NDArray[np.uint32]] = {}  # the arguments after the fourth
        for name, listed in blocks.calls.items():
            given = [addresses[block] for block in listed]
            self._stacked[name] = np.array(given[REGISTERS:], np.uint32)
            top = STACK_TOP - -(-self._stacked[name].nbytes // 8) * 8
            registers = ((r0 + i, place) for i, place in enumerate(given[:REGISTERS]))
            self._registers[name] = ((sp, top), (lr, LANDING | 1), *registers)
        self._meter = Meter(image, meter, self._cpu)
        self._filed_cycles = 0  # for poses since the last step of the estimator
        self._ahead: tuple[str, bytes] | None = None  # the call whose results RAM holds, and its inputs

    def call(self, name: str) -> int:
        """Execute an entry point; results computed ahead from the same inputs are reused."""
        if self._ahead is None or self._ahead != (name, self._inputs(name)):
            self._execute(name)
        self._ahead = None
        for here, there in self._memories[name]:
            here[:] = there
        self.load[name].add(self._meter.instructions, self._meter.cycles)
        if name == "file_pose":
            self._filed_cycles += self._meter.cycles
        elif name == "estimate":
            self._filed_cycles = 0
        return ctypes.c_int32(self._cpu.reg_read(self._result)).value if name in ANSWERING else 0

    def estimate_us(self) -> int:
        """Return the processor time of the estimator's next call, with that of the poses filed since the last one."""
        return _microseconds(self._filed_cycles + self._look_ahead("estimate"))

    def control_us(self) -> int:
        """Return the processor time of the controller's next call."""
        return _microseconds(self._look_ahead("control"))

    @property
    def instructions(self) -> int:
        """How many instructions the last call took."""
        return self._meter.instructions

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
        return self._meter.cycles

    def _inputs(self, name: str) -> bytes:
        return b"".join([here.tobytes() for here, _ in self._memories[name]])

    def _execute(self, name: str) -> None:
        for here, there in self._memories[name]:
            there[:] = here
        self._cpu.reg_write_batch(self._registers[name])
        stacked = self._stacked[name].view(np.uint8)
        if stacked.size:
            top = self._registers[name][0][1] - RAM
            self._ram[top : top + stacked.size] = stacked
        self._meter.start()
        try:
            self._cpu.emu_start(self.image.entries[name], LANDING)
        except self._fault as error:
            place = self._cpu.reg_read(self._pc)
            raise ExportError(f"{self.image.path}: {name} stopped at 0x{place:08x}: {error}") from None


class Meter:
    """Counts the instructions and cycles of a call; see arm/meter.c."""

    def __init__(self, image: CoreImage, library: Path, cpu: Any) -> None:
        self._library = ctypes.CDLL(str(library))
        self._library.meter_size.restype = ctypes.c_uint64
        half_words = FLASH_SIZE // 2
        code = count(image.code, image.constants)
        self._sums = [  # to the end of flash, because the landing counts as a block
            np.pad(sums, (0, half_words + 1 - sums.size), "edge") for sums in (code.instructions, code.cycles)
        ]
        size = self._library.meter_size()
        self._state = np.zeros(size // 8, np.uint64)
        self._state[:3] = *(sums.ctypes.data for sums in self._sums), FLASH
        self._address = ctypes.c_void_p(self._state.ctypes.data)
        self._library.meter_start.argtypes = (ctypes.c_void_p,)
        self._attach(cpu)

    def start(self) -> None:
        """Begin a call with an empty cache."""
        self._library.meter_start(self._address)

    @property
    def instructions(self) -> int:
        """Instructions since the start."""
        return int(self._state[4])

    @property
    def cycles(self) -> int:
        """Cycles since the start."""
        return int(self._state[5])

    def _attach(self, cpu: Any) -> None:
        """Have the library called for every block; a callback in Python would cost a hundred times more."""
        from unicorn import UC_HOOK_BLOCK
        from unicorn.unicorn_py3.unicorn import uclib

        hook = ctypes.c_size_t()
        block = ctypes.cast(self._library.meter_block, ctypes.c_void_p)
        everywhere = ctypes.c_uint64(1), ctypes.c_uint64(0)
        if uclib.uc_hook_add(cpu._uch, ctypes.byref(hook), UC_HOOK_BLOCK, block, self._address, *everywhere):
            raise ExportError("unicorn refuses to count")


def _microseconds(cycles: int) -> int:
    return -(-cycles // CLOCK_MHZ)
