"""An STM32F405 that executes an image: unicorn for the instructions, `native/` for everything around them.

Time counts in cycles of 168 MHz since power-on. `run` continues until a given time or until the caller must act; compiled
code calls no Python. Cycles are those of `firmware_py.export.cycles`, plus three for every jump; flash is assumed to keep
up with the core, unless `empty_flash_cache` is called.
"""

import mmap
from collections.abc import Callable, Sequence
from enum import IntEnum
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.export.compilers import HOST_FLAGS, compile_texts, zig
from firmware_py.export.cycles import count
from firmware_py.export.elf import CCM, CCM_SIZE, FLASH, FLASH_SIZE, RAM, RAM_SIZE
from firmware_py.export.errors import ExportError
from firmware_py.extras import install_command
from hil.errors import LabError

CYCLES_PER_US = 168
SECOND = 1_000_000 * CYCLES_PER_US
SYSTEM, SYSTEM_SIZE = 0x1FFF_0000, 0x1_0000
OTP, UNIQUE_ID, FLASH_KBYTES = 0x1FFF_7800, 0x1FFF_7A10, 0x1FFF_7A22
WINDOWS = (
    (0x4000_0000, 0x8_0000, "peripheral"), (0x5000_0000, 0x8_0000, "usb"), (0xE000_0000, 0x10_0000, "system"),
)  # fmt: skip
STATE_REGISTERS = ("pc", "basepri", "faultmask")  # all others are unicorn's
SOURCES = Path(__file__).parent / "native"
NOWHERE = 0xFF  # no address on I2C
# What unicorn (2.1.3, 2.1.4) knows of a Cortex-M4, by the bits of its `enum arm_features`.
CORTEX_M4_FEATURES, MAIN_EXTENSION = 0x54_0102_C2E8, 1 << 38
# Causes of a reset in RCC_CSR, with the pin's.
POWER_ON, SOFTWARE, WATCHDOG = 0x0C00_0000, 0x1400_0000, 0x2400_0000


class StopReason(IntEnum):
    """Reasons why a run ended early: `STOP_...` of machine.h."""

    TIME = 0
    SERIAL = 1  # a USART has sent something and is silent now
    COMPARE = 2  # a timer's compare register has changed
    RESET = 4  # software requests a reset
    WATCHDOG = 8  # the independent watchdog resets
    BREAK = 16
    LOCKUP = 32  # a fault inside the handler of a fault
    STEP = 64
    OVERFLOW = 128  # a task has written below its stack
    LOW_READ = 256  # the first read near address 0
    DIVISION = 512  # the first integer division by zero
    WATCHPOINT = 1024  # an access that the debugger watches, at most a block of instructions ago
    LOW_WRITE = 2048  # the first write of an instruction near address 0
    DEVICE = 4096  # a device was written to that acts on it


def find_emulator() -> Any:
    """Return the package unicorn. Raises `ExportError` when it is missing."""
    try:
        import unicorn
    except ImportError:
        raise ExportError(f"unicorn is missing: {install_command('deploy')}") from None
    return unicorn


def build_machine() -> Path:
    """Return the library of `native/`, compiled for this machine. Raises `ExportError`, also when a chip lacks a package."""
    find_emulator()
    declared()
    texts = {path.name: path.read_text(encoding="utf-8") for path in sorted(SOURCES.glob("*.[ch]"))}
    return compile_texts(
        texts, [name for name in texts if name.endswith(".c")], HOST_FLAGS, "machine.so", zig()
    )


@cache
def declared() -> Any:
    """Return the declarations of machine.h for cffi. Raises `ExportError` when cffi is missing."""
    try:
        from cffi import FFI
    except ImportError:
        raise ExportError(f"cffi is missing: {install_command('deploy')}") from None
    lines = (SOURCES / "machine.h").read_text(encoding="utf-8").splitlines()
    ffi = FFI()
    ffi.cdef("\n".join(line for line in lines if not line.startswith("#")))
    ffi.cdef("".join(f"void uc_{name}();" for name, _ in ffi.typeof("struct engine").fields[1:]))
    return ffi


class Chip:
    """One microcontroller with an image in flash, in reset; `state` has the clock and the machine's state.

    `code` begins with the vector table at address `base`; `constants` are the half words without instructions, counted
    from there. `build_machine` has looked for the packages that it needs.
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
        self._cpu = unicorn.Uc(unicorn_const.UC_ARCH_ARM, unicorn_const.UC_MODE_THUMB)
        self._cpu.ctl_set_cpu_model(arm_const.UC_CPU_ARM_CORTEX_M4)  # UC_MODE_MCLASS would make it an M33
        let_unaligned_trap(self._cpu)
        self._cpu.ctl_set_tlb_mode(unicorn_const.UC_TLB_VIRTUAL)  # machine.c decides what is executable
        self._numbers = _register_numbers(arm_const)
        self._map(unicorn_const)
        self._ffi = declared()
        self._library: Any = self._ffi.dlopen(str(library))
        self.state: Any = self._ffi.new("struct machine *")
        if self._ffi.sizeof(self.state[0]) != self._library.machine_size():
            raise LabError(f"{library} was not compiled from the machine.h that lies here")
        self._before = _sums_before(code, base, constants, self._library.SUM_INSTRUCTIONS)
        arrays: tuple[NDArray[Any], ...] = (self.flash, self.ram, self.ccm, self._before)
        memories = [self._pointer(array) for array in arrays]
        if self._library.machine_attach(self.state, self._engine(uclib), *memories):
            raise LabError("unicorn refuses the machine's hooks")
        get = partial(getattr, self._library)
        self._registers = [
            (base, base + size, get(f"{name}_read"), get(f"{name}_write")) for base, size, name in WINDOWS
        ]
        self._sent = self._ffi.new("uint8_t[]", self._library.LINE_BYTES)
        self._profile: Any = None
        self._passages = np.zeros((0, 3), np.uint64)
        self._kept: list[NDArray[Any]] = []  # of devices, speeds of motors, and what is counted
        self._acts: dict[int, Callable[[], object]] = {}  # of devices that act on what is written
        self.breakpoints: set[int] = set()  # of a debugger: a run stops before these instructions
        self.crash_points: set[int] = set()  # of the crash reports
        self._planted: set[int] = set()
        self.resets = 0
        self.reset(POWER_ON)

    def _map(self, const: Any) -> None:
        """Map flash, RAM, CCM and the system's memory. The alias of flash at 0 is mapped at its first use (`_after`)."""
        read, write, execute = const.UC_PROT_READ, const.UC_PROT_WRITE, const.UC_PROT_EXEC
        self._readable = read | execute
        self._system = _memory(SYSTEM_SIZE)
        self._system[:] = 0xFF
        for place, array, rights in (
            (FLASH, self.flash, self._readable),
            (RAM, self.ram, read | write | execute),
            (CCM, self.ccm, read | write),
            (SYSTEM, self._system, read),
        ):
            self._cpu.mem_map_ptr(place, array.size, rights, array.ctypes.data)
        self.set_system(UNIQUE_ID, bytes(range(1, 13)))
        self.set_system(FLASH_KBYTES, (FLASH_SIZE // 1024).to_bytes(2, "little"))

    def _engine(self, loaded: Any) -> Any:
        """Return unicorn's functions from the library that its package has loaded."""
        engine = self._ffi.new("struct engine *", {"uc": self._ffi.cast("uc_engine *", self._cpu._uch.value)})
        unicorn = self._ffi.dlopen(loaded._name)
        for name, field in self._ffi.typeof(engine[0]).fields[1:]:
            setattr(engine, name, self._ffi.cast(field.type, getattr(unicorn, f"uc_{name}")))
        return engine

    def _pointer(self, array: NDArray[Any]) -> Any:
        """Return the address of an array, which must live as long as the chip."""
        return self._ffi.from_buffer(f"uint{8 * array.itemsize}_t[]", array)

    # Time

    @property
    def now_us(self) -> int:
        """Microseconds since power-on."""
        return int(self.state.now) // CYCLES_PER_US

    def run(self, until_cycles: int) -> int:
        """Run up to a time, or until the caller must act; return why it ended, a sum of `StopReason`."""
        self._plant(self.breakpoints | self.crash_points)
        return self._after(self._library.machine_run(self.state, until_cycles))

    def _after(self, reason: int) -> int:
        """Map flash at 0 as well, as after a normal start, when it is first read there."""
        if reason & StopReason.LOW_READ:
            self._cpu.mem_map_ptr(0, self.flash.size, self._readable, self.flash.ctypes.data)
        return reason

    def step(self, until_cycles: int | None = None) -> int:
        """Execute one instruction, or sleep until a time, at most a second; only an instruction is `StopReason.STEP`."""
        until = self.state.now + SECOND if until_cycles is None else until_cycles
        self._plant(self.breakpoints | self.crash_points)
        self._cpu.ctl_flush_tb()  # hooks act on code translated after them, until it is flushed
        reason = self._after(self._library.machine_step(self.state, until))
        self._cpu.ctl_flush_tb()
        return reason

    def reset(self, cause: int) -> None:
        """Reset the processor: memory is kept, time continues."""
        self.resets += 1
        self._library.machine_reset(self.state, self.vectors, cause)

    def empty_flash_cache(self) -> None:
        """Begin as after a jump, with an empty cache before the flash; from now on its misses wait."""
        if not self.state.flash_cache:
            self._flash_cache = self._ffi.new("struct flash_cache *")
            self.state.flash_cache = self._flash_cache
        self._library.flash_empty(self.state)

    def record(self) -> None:
        """Count the executed blocks from now on, unless that is done already."""
        if self.state.recorded:
            return
        self._passages = np.zeros((FLASH_SIZE // 2 + 1, 3), np.uint64)
        self._kept.append(self._passages)
        self.state.recorded = 1
        self.state.passages = self._ffi.from_buffer("struct passage[]", self._passages)

    def profile(self, functions: Sequence[tuple[int, int]]) -> None:
        """Charge every cycle from now on to functions: begin and end of each, from number 1 on."""
        self._profile = self._ffi.new("struct profile *")
        numbers = np.frombuffer(self._ffi.buffer(self._profile.functions), np.uint16)
        for number, (begin, end) in enumerate(functions, 1):
            numbers[(begin - FLASH) // 2 : (end - FLASH) // 2] = number
            numbers[(begin - FLASH) // 2] = number | 1 << 15
        self._profile.nodes = 1
        self._kept.append(np.frombuffer(self._ffi.buffer(self._profile), np.uint8))
        self.record()
        self.state.profile = self._profile
        self._library.profile_reset(self.state)

    def cycles_of_code(self) -> NDArray[np.int64]:
        """Return the cycles of the instruction that begins at each half word of flash, without refills."""
        cycles = (self._before & np.uint64((1 << self._library.SUM_INSTRUCTIONS) - 1)).astype(np.int64)
        return np.diff(cycles)

    def buffer(self, member: Any) -> Any:
        """Return the memory of an array in the machine."""
        return self._ffi.buffer(member)

    def profiled(self) -> Any:
        """Return the `struct profile` of machine.h up to now."""
        self._library.profile_settle(self.state)
        return self._profile

    @property
    def passages(self) -> NDArray[np.uint64]:
        """Return the counts of the blocks since `record`, by half word of flash, (FLASH_SIZE / 2 + 1, 3).

        Blocks that begin there; blocks that end before it and go on there; blocks that end before it and go on elsewhere.
        """
        counts, state = self._passages.copy(), self.state
        if state.block_begin != state.block_end:  # asleep
            counts[state.block_end // 2, 2] += 1
        return counts

    def save(self) -> tuple[Any, ...]:
        """Return the whole state of processor, memories and devices, for `restore`."""
        memories = [memory.copy() for memory in (self.ram, self.ccm, *self._kept)]
        return bytes(self._ffi.buffer(self.state)), memories, self._cpu.context_save(), self.resets

    def restore(self, saved: tuple[Any, ...]) -> None:
        """Set the state that `save` returned; breakpoints and watchpoints stay."""
        state, memories, context, self.resets = saved
        before = self._ffi.new("struct machine *", self.state[0])
        self._ffi.buffer(self.state)[:] = state
        for name in ("break_hook", "break_address", "watchpoint", "float_hook"):  # of unicorn now
            setattr(self.state, name, getattr(before, name))
        for memory, contents in zip((self.ram, self.ccm, *self._kept), memories, strict=True):
            memory[:] = contents
        self._cpu.context_restore(context)
        self._cpu.ctl_flush_tb()

    # Pins

    def pin(self, port: str, number: int, high: bool) -> None:
        """Set a pin's level from outside."""
        self._library.machine_pin(self.state, ord(port) - ord("A"), number, int(high))

    def feed(self, usart: int, data: bytes) -> int:
        """Let bytes arrive at USART 1..6, from now on; return how many the line accepted."""
        return int(self._library.usart_feed(self.state, usart - 1, data, len(data)))

    def sent(self, usart: int) -> bytes:
        """Return the bytes sent by USART 1..6 since the last call."""
        size = self._library.machine_sent(self.state, usart - 1, self._sent)
        return bytes(self._ffi.buffer(self._sent, size)) if size else b""

    def add_device(
        self, bus: int, address: int, memory: NDArray[np.uint8], address_bytes: int = 1, pairs: bool = False
    ) -> int:
        """Add memory at a 7-bit address on I2C 1..3, return its number. `pairs`: every byte follows its own address."""
        self._kept.append(memory)
        at = bus - 1, address, self._pointer(memory), memory.size, address_bytes, pairs
        device: int = self._library.machine_device(self.state, *at)
        if not device:
            raise LabError("more devices on buses than there is room for")
        return device - 1

    def add_selected(self, bus: int, select: tuple[str, int], memory: NDArray[np.uint8]) -> int:
        """Put memory on SPI 1..3 behind a pin that selects it when low; returns the device's number."""
        port, number = select
        return self.add_device(bus + self._library.BUSES, (ord(port) - ord("A")) * 16 + number, memory)

    def add_esc(self, timer: int, channel: int, rpm: NDArray[np.float64], poles: int) -> None:
        """Connect an ESC for DSHOT to an output, both from 0; `rpm` (1,) is the speed of its motor, of so many poles.

        `state.compare` there is the throttle that it has taken: 0, or 48 to 2047.
        """
        self._kept.append(rpm)
        if not self._library.machine_esc(
            self.state, timer, channel, self._ffi.from_buffer("double[]", rpm), poles
        ):
            raise LabError("more ESCs than there is room for")

    def on_write(self, device: int, act: Callable[[], object]) -> None:
        """Call `act` (by `tell_devices`) whenever a transfer to a device has ended: a write on I2C, any on SPI."""
        self.state.device[device].watched = 1
        self._acts[device] = act

    def move_device(self, device: int, address: int) -> None:
        """Let a device on I2C answer to another address, to none if it is `NOWHERE`."""
        self.state.device[device].address = address

    def first_byte(self, device: int) -> int:
        """Return the byte that the last transfer with a device on SPI began with."""
        return int(self.state.device[device].first)

    def tell_devices(self) -> None:
        """Let the devices act that were written to: a run that ended so has `StopReason.DEVICE`."""
        touched, self.state.touched = int(self.state.touched), 0
        for device, act in self._acts.items():
            if touched >> device & 1:
                act()

    def set_system(self, address: int, contents: bytes) -> None:
        """Write the chip's own memory: OTP, unique id."""
        begin = address - SYSTEM
        self._system[begin : begin + len(contents)] = np.frombuffer(contents, np.uint8)

    # Debugging

    def read(self, address: int, size: int) -> bytes:
        """Return memory, or registers as the core reads them. Raises `LabError` at any other address."""
        for base, end, read, _ in self._registers:
            if base <= address and address + size <= end:
                places = range((address & ~3) - base, address + size - base, 4)
                words = [read(self._ffi.NULL, place, 4, self.state) & 0xFFFF_FFFF for place in places]
                return np.array(words, np.uint32).tobytes()[address & 3 :][:size]
        return self.view(address, size).tobytes()

    def view(self, address: int, size: int) -> NDArray[np.uint8]:
        """Return a live view of memory. Raises `LabError` at any other address."""
        for base, array in (
            (RAM, self.ram), (CCM, self.ccm), (FLASH, self.flash), (0, self.flash), (SYSTEM, self._system)
        ):  # fmt: skip
            begin = address - base
            if 0 <= begin <= array.size - size:
                return array[begin : begin + size]
        raise LabError(f"0x{address:08x}, {size} bytes: no memory there")

    def write(self, address: int, data: bytes) -> None:
        for base, end, _, write in self._registers:
            if base <= address and address + len(data) <= end:
                for at in range(0, len(data), 4):
                    word = data[at : at + 4]
                    number = int.from_bytes(word, "little")
                    write(self._ffi.NULL, address + at - base, len(word), number, self.state)
                return
        self.view(address, len(data))[:] = np.frombuffer(data, np.uint8)
        if FLASH <= address < FLASH + FLASH_SIZE:
            self._cpu.ctl_flush_tb()

    def register(self, name: str) -> int:
        """Return a register: r0..r12, sp, lr, pc, xpsr, msp, psp, primask, basepri, control, s0..s31, d0..d15, fpscr."""
        if name in STATE_REGISTERS:
            return int(getattr(self.state, name))
        return int(self._cpu.reg_read(self._numbers[name]))

    def set_register(self, name: str, value: int) -> None:
        if name in STATE_REGISTERS:
            setattr(self.state, name, value & ~1 if name == "pc" else value)
        else:
            self._cpu.reg_write(self._numbers[name], value)

    def watch(self, kind: int, address: int, size: int, on: bool) -> None:
        if not self._library.machine_watch(self.state, kind, address, size, int(on)):
            raise LabError("more watchpoints than there is room for, or none there")
        self._cpu.ctl_flush_tb()

    def _plant(self, addresses: set[int]) -> None:
        """Set the machine's breakpoints."""
        if addresses == self._planted:
            return
        for address in addresses ^ self._planted:
            if not self._library.machine_break(self.state, address, int(address in addresses)):
                raise LabError("more breakpoints than there is room for")
        self._planted = addresses
        self._cpu.ctl_flush_tb()  # hooks act on code translated after them


def let_unaligned_trap(cpu: Any) -> None:
    """Let unicorn stop before every unaligned access of a word or half word, which alignment.c then judges.

    Only cores without the Main Extension do so. Among the features of the core, in the context that unicorn saves and
    restores, one bit makes it such a core. Raises `LabError` when this unicorn keeps them in another form.
    """
    context = cpu.context_save()
    saved, features = bytes(context), CORTEX_M4_FEATURES.to_bytes(8, "little")
    if saved.count(features) != 1:
        raise LabError("this version of unicorn is unknown here: install unicorn 2.1.3 or 2.1.4")
    changed = saved.replace(features, (CORTEX_M4_FEATURES & ~MAIN_EXTENSION).to_bytes(8, "little"))
    context.__setstate__((changed, *context.__getstate__()[1:]))
    cpu.context_restore(context)


def _memory(size: int) -> NDArray[np.uint8]:
    """Return zeroed memory, aligned to a page of this machine."""
    return np.frombuffer(mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS), np.uint8)


def _sums_before(code: bytes, base: int, constants: frozenset[int], first_bit: int) -> NDArray[np.uint64]:
    """Return the sums of cycles and, from a bit on, instructions before each half word of flash."""
    before = (base - FLASH) // 2
    counted = count(code, constants)
    sums = counted.cycles + (counted.instructions.astype(np.uint64) << np.uint64(first_bit))
    return np.pad(sums, (before, FLASH_SIZE // 2 + 1 - before - sums.size), "edge")


def _register_numbers(arm_const: Any) -> dict[str, int]:
    names = (
        *(f"r{i}" for i in range(13)), *(f"s{i}" for i in range(32)), *(f"d{i}" for i in range(16)),
        "sp", "lr", "xpsr", "msp", "psp", "primask", "control", "fpscr",
    )  # fmt: skip
    return {name: getattr(arm_const, f"UC_ARM_REG_{name.upper()}") for name in names}
