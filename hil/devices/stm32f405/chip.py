"""An STM32F405 that executes an image: unicorn for the instructions, `native/` for everything around them.

Time is that of the chip: cycles of 168 MHz since power-on. `run` goes on until an instant or until something outside is to
be done; what is compiled calls no Python. Cycles are those of `firmware_py.export.cycles`, plus three for every jump; flash
is taken to keep up with the core.
"""

from __future__ import annotations

import ctypes
import mmap
from enum import IntFlag
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.export.arm_image import HOST_FLAGS, compile_texts
from firmware_py.export.cortex_m4 import find_emulator
from firmware_py.export.cycles import count
from hil.errors import LabError

CYCLES_PER_US = 168
FLASH, FLASH_SIZE = 0x0800_0000, 0x10_0000
RAM, RAM_SIZE = 0x2000_0000, 0x2_0000
CCM, CCM_SIZE = 0x1000_0000, 0x1_0000
SYSTEM, SYSTEM_SIZE = 0x1FFF_0000, 0x1_0000
OTP, UNIQUE_ID, FLASH_KBYTES = 0x1FFF_7800, 0x1FFF_7A10, 0x1FFF_7A22
WINDOWS = (
    (0x4000_0000, 0x8_0000, "peripheral"), (0x5000_0000, 0x8_0000, "usb"), (0xE000_0000, 0x10_0000, "system"),
)  # fmt: skip
ACCESS = (ctypes.c_void_p, ctypes.c_uint64, ctypes.c_uint)  # engine, offset, size
LINE_BYTES = 4096
WAIT_FOR_INTERRUPT = 0xBF30  # elsewhere than at an instruction it is not looked at
SOURCES = Path(__file__).parent / "native"
POWER_ON, SOFTWARE, WATCHDOG = (
    0x0C00_0000,
    0x1400_0000,
    0x2400_0000,
)  # causes of a reset in RCC_CSR, with the pin's


class Why(IntFlag):
    """Why a run ended before its time."""

    TIME = 0
    SERIAL = 1  # a USART has sent something and is silent now
    COMPARE = 2  # a timer's compare register has changed
    RESET = 4  # software asks for a reset
    WATCHDOG = 8  # the independent watchdog does
    BREAK = 16
    LOCKUP = 32  # a fault inside the handler of a fault
    STEP = 64


class Task(ctypes.Structure):
    """A task of the scheduler in the image, by the address of its control block."""

    _fields_ = (("cycles", ctypes.c_uint64), ("block", ctypes.c_uint32), ("times", ctypes.c_uint32))


class TaskSwitch(ctypes.Structure):
    """A task gets the processor."""

    _fields_ = (("now", ctypes.c_uint64), ("block", ctypes.c_uint32), ("unused", ctypes.c_uint32))


class State(ctypes.Structure):
    """The head of `struct machine`."""

    _fields_ = (
        ("now", ctypes.c_uint64),
        ("instructions", ctypes.c_uint64),
        ("exceptions", ctypes.c_uint64),
        ("sleeping", ctypes.c_uint64),
        ("next_due", ctypes.c_uint64),
        ("pc", ctypes.c_uint32),
        ("why", ctypes.c_uint32),
        ("asleep", ctypes.c_uint32),
        ("watchdog_on", ctypes.c_uint32),
        ("fault_address", ctypes.c_uint32),
        ("unknown_count", ctypes.c_uint32),
        ("unknown", ctypes.c_uint32 * 16),
        ("compare", ctypes.c_uint32 * 4 * 14),
        ("current_place", ctypes.c_uint32),
        ("tracing", ctypes.c_uint32),
        ("task_count", ctypes.c_uint32),
        ("switch_count", ctypes.c_uint32),
        ("running_since", ctypes.c_uint64),
        ("tasks", Task * 32),
        ("running", ctypes.c_uint32),
        ("locked", ctypes.c_uint32),
        ("resume", ctypes.c_uint32),
        ("skip_at", ctypes.c_uint32),
        ("switches", TaskSwitch * 4096),
    )


class _Engine(ctypes.Structure):
    _fields_ = tuple(
        (name, ctypes.c_void_p)
        for name in (
            "uc",
            "reg_read",
            "reg_write",
            "emu_start",
            "emu_stop",
            "mmio_map",
            "hook_add",
            "hook_del",
            "ctl",
        )
    )


def build_machine(folder: Path) -> Path:
    """Compile `native/` for this machine; `folder` keeps it. Raises `ExportError`."""
    texts = {path.name: path.read_text(encoding="utf-8") for path in sorted(SOURCES.glob("*.[ch]"))}
    return compile_texts(
        texts, [name for name in texts if name.endswith(".c")], HOST_FLAGS, "machine.so", folder
    )


class Chip:
    """One microcontroller with an image in flash, in reset; `state` has the clock and what has happened.

    `code` begins with the vector table, which `base` is the address of; `constants` are its half words that are no
    instructions, counted from there. Raises `ExportError` when unicorn is missing.
    """

    def __init__(
        self, code: bytes, base: int, library: Path, constants: frozenset[int] = frozenset()
    ) -> None:
        unicorn = find_emulator()
        from unicorn import arm_const, unicorn_const
        from unicorn.unicorn_py3.unicorn import uclib

        self.flash, self.ram, self.ccm = _memory(FLASH_SIZE), _memory(RAM_SIZE), _memory(CCM_SIZE)
        self.flash[:] = 0xFF
        self.vectors = base
        self.flash[base - FLASH : base - FLASH + len(code)] = np.frombuffer(code, np.uint8)
        self._cpu = unicorn.Uc(
            unicorn_const.UC_ARCH_ARM, unicorn_const.UC_MODE_THUMB | unicorn_const.UC_MODE_MCLASS
        )
        self._cpu.ctl_set_cpu_model(arm_const.UC_CPU_ARM_CORTEX_M4)
        self._numbers = _register_numbers(arm_const)
        self._map(unicorn_const)
        self._sums = _sums(code, base, constants)
        self._library: Any = ctypes.CDLL(str(library))
        self._library.machine_size.restype = ctypes.c_uint64
        self._memory = np.zeros(self._library.machine_size() // 8 + 1, np.uint64)
        self._machine = ctypes.c_void_p(self._memory.ctypes.data)
        self.state = State.from_address(self._memory.ctypes.data)
        names = [f"uc_{field[0]}" for field in _Engine._fields_[1:]]
        calls = [ctypes.cast(getattr(uclib, name), ctypes.c_void_p) for name in names]
        self._engine = _Engine(self._cpu._uch, *calls)
        pointers: tuple[NDArray[Any], ...] = (self.flash, self.ram, self.ccm, *self._sums)
        if self._library.machine_attach(
            self._machine,
            ctypes.byref(self._engine),
            *(ctypes.c_void_p(array.ctypes.data) for array in pointers),
        ):
            raise LabError("unicorn refuses the machine's hooks")
        for index in np.flatnonzero(np.frombuffer(code[: len(code) & ~1], "<u2") == WAIT_FOR_INTERRUPT):
            self._library.machine_sleeps_at(self._machine, base + 2 * int(index))
        self._run = self._library.machine_run
        self._run.argtypes = (ctypes.c_void_p, ctypes.c_uint64)
        self._registers = [self._window(*window) for window in WINDOWS]
        self._sent = ctypes.create_string_buffer(LINE_BYTES)
        self._kept: list[NDArray[np.uint8]] = []  # memory of devices
        self.breakpoints: set[int] = set()  # addresses before whose instructions a run stops
        self._planted: set[int] = set()
        self.reset(POWER_ON)

    def _map(self, const: Any) -> None:
        """Map flash (also at 0, where it is seen after a start), RAM, CCM and the system's memory."""
        read, write, execute = const.UC_PROT_READ, const.UC_PROT_WRITE, const.UC_PROT_EXEC
        self._system = _memory(SYSTEM_SIZE)
        self._system[:] = 0xFF
        for place, array, rights in (
            (FLASH, self.flash, read | execute),
            (0, self.flash, read | execute),
            (RAM, self.ram, read | write | execute),
            (CCM, self.ccm, read | write),
            (SYSTEM, self._system, read),
        ):
            self._cpu.mem_map_ptr(place, array.size, rights, array.ctypes.data)
        self.set_system(UNIQUE_ID, bytes(range(1, 13)))
        self.set_system(FLASH_KBYTES, (FLASH_SIZE // 1024).to_bytes(2, "little"))

    def _window(self, base: int, size: int, name: str) -> tuple[int, int, Any, Any]:
        """Return where registers lie, and what reads and writes them."""
        read, write = getattr(self._library, f"{name}_read"), getattr(self._library, f"{name}_write")
        read.restype, read.argtypes = ctypes.c_uint64, (*ACCESS, ctypes.c_void_p)
        write.restype, write.argtypes = None, (*ACCESS, ctypes.c_uint64, ctypes.c_void_p)
        return base, base + size, read, write

    # Time

    @property
    def in_block(self) -> bool:
        """Whether it stands where it would not have stood by itself, in the middle of a block of instructions."""
        return bool(self.state.resume == self.state.pc)

    @property
    def now_us(self) -> int:
        """Microseconds since power-on."""
        return int(self.state.now) // CYCLES_PER_US

    def run(self, until_cycles: int) -> Why:
        """Run up to an instant, or until something outside is to be done."""
        if self.breakpoints != self._planted:
            self._plant()
        why = self._run(self._machine, until_cycles)
        return Why(why) if why else Why.TIME

    def step(self) -> Why:
        """Execute one instruction."""
        self._cpu.ctl_flush_tb()  # hooks act on what is translated after them, and until it is forgotten
        why = Why(self._library.machine_step(self._machine))
        self._cpu.ctl_flush_tb()
        return why

    def reset(self, cause: int) -> None:
        """Reset the processor: memory stays, time goes on."""
        self._library.machine_reset(self._machine, self.vectors, cause)

    # Pins

    def pin(self, port: str, number: int, high: bool) -> None:
        """Give a pin a level from outside."""
        self._library.machine_pin(self._machine, ord(port) - ord("A"), number, int(high))

    def output(self, port: str) -> int:
        """Return what a port's pins are set to."""
        return int(self._library.machine_output(self._machine, ord(port) - ord("A")))

    def feed(self, usart: int, data: bytes) -> int:
        """Let bytes arrive at USART 1..6, from now on; returns how many found room on the line."""
        return int(self._library.usart_feed(self._machine, usart - 1, data, len(data)))

    def sent(self, usart: int) -> bytes:
        """Return what USART 1..6 has sent since the last time."""
        size = self._library.machine_sent(self._machine, usart - 1, self._sent)
        return self._sent.raw[:size]

    def add_device(self, bus: int, address: int, memory: NDArray[np.uint8], address_bytes: int = 1) -> None:
        """Put memory behind a 7-bit address on I2C 1..3."""
        self._kept.append(memory)
        place = ctypes.c_void_p(memory.ctypes.data)
        if not self._library.machine_device(
            self._machine, bus - 1, address, place, memory.size, address_bytes
        ):
            raise LabError("more I2C devices than there is room for")

    def set_system(self, address: int, contents: bytes) -> None:
        """Write what stands in the chip's own memory: OTP, unique id."""
        begin = address - SYSTEM
        self._system[begin : begin + len(contents)] = np.frombuffer(contents, np.uint8)

    # Debugging

    def read(self, address: int, size: int) -> bytes:
        """Return memory, or registers as the core would read them. Raises `LabError` where there is neither."""
        for base, end, read, _ in self._registers:
            if base <= address and address + size <= end:
                words = range(address & ~3, address + size, 4)
                found = b"".join(
                    read(None, at - base, 4, self._machine).to_bytes(8, "little")[:4] for at in words
                )
                return found[address & 3 :][:size]
        return self.view(address, size).tobytes()

    def view(self, address: int, size: int) -> NDArray[np.uint8]:
        """Return memory that goes on to change. Raises `LabError` where there is none."""
        array, begin = self._place(address, size)
        return array[begin : begin + size]

    def write(self, address: int, data: bytes) -> None:
        """Change memory, code too, or registers. Raises `LabError` where there is none."""
        for base, end, _, write in self._registers:
            if base <= address and address + len(data) <= end:
                for at in range(0, len(data), 4):
                    word = data[at : at + 4]
                    write(None, address + at - base, len(word), int.from_bytes(word, "little"), self._machine)
                return
        self.view(address, len(data))[:] = np.frombuffer(data, np.uint8)
        if FLASH <= address < FLASH + FLASH_SIZE:
            self._cpu.ctl_flush_tb()

    def _place(self, address: int, size: int) -> tuple[NDArray[np.uint8], int]:
        for base, array in (
            (RAM, self.ram), (CCM, self.ccm), (FLASH, self.flash), (0, self.flash), (SYSTEM, self._system)
        ):  # fmt: skip
            if base <= address and address + size <= base + array.size:
                return array, address - base
        raise LabError(f"0x{address:08x}, {size} bytes: no memory there")

    def registers(self) -> list[int]:
        """Return r0 to r12, sp, lr, pc and xpsr."""
        return [self.register(name) for name in (*(f"r{i}" for i in range(13)), "sp", "lr", "pc", "xpsr")]

    def register(self, name: str) -> int:
        """Return a register: r0..r12, sp, lr, pc, xpsr, msp, psp, primask, basepri, control, s0..s31, d0..d15, fpscr."""
        return int(self.state.pc) if name == "pc" else int(self._cpu.reg_read(self._numbers[name]))

    def set_register(self, name: str, value: int) -> None:
        """Change a register."""
        if name == "pc":
            self.state.pc = value & ~1
        else:
            self._cpu.reg_write(self._numbers[name], value)

    def _plant(self) -> None:
        """Tell the machine of the breakpoints."""
        for address in self.breakpoints ^ self._planted:
            if not self._library.machine_break(self._machine, address, int(address in self.breakpoints)):
                raise LabError("more breakpoints than there is room for")
        self._planted = set(self.breakpoints)
        self._cpu.ctl_flush_tb()  # hooks act on what is translated after them


def _memory(size: int) -> NDArray[np.uint8]:
    """Return zeroed memory that begins at a page of this machine."""
    return np.frombuffer(mmap.mmap(-1, size), np.uint8)


def _sums(code: bytes, base: int, constants: frozenset[int]) -> list[NDArray[np.uint32]]:
    """Return how many instructions and cycles begin before each half word of flash."""
    before = (base - FLASH) // 2
    counted = count(code, constants)
    after = FLASH_SIZE // 2 + 1 - before - counted.cycles.size
    return [np.pad(sums, (before, after), "edge") for sums in (counted.instructions, counted.cycles)]


def _register_numbers(arm_const: Any) -> dict[str, int]:
    names = (
        *(f"r{i}" for i in range(13)), *(f"s{i}" for i in range(32)), *(f"d{i}" for i in range(16)),
        "sp", "lr", "xpsr", "msp", "psp", "primask", "basepri", "faultmask", "control", "fpscr",
    )  # fmt: skip
    return {name: getattr(arm_const, f"UC_ARM_REG_{name.upper()}") for name in names}
