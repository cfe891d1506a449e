"""Exported C on other machines, in an emulator: AArch64, and x86-64 with another C library.

The stubs stand for what a method of CPython needs of Python; its `self` is the table of addresses itself.
"""

from collections.abc import Iterable

import numpy as np
from elftools.elf.elffile import ELFFile
from numpy.typing import NDArray
from unicorn import Uc, arm64_const, unicorn_const, x86_const

from firmware_py.export.compilers import compile_texts, zig
from firmware_py.export.kernels import FLAGS
from firmware_py.export.methods import METHOD

STUBS = """
long long answered;
char *PyBytes_AsString(void *object) { return object; }
void *PyLong_FromLongLong(long long value) { answered = value; return &answered; }
long long PyLong_AsLongLong(void *object) { return *(long long *)object; }
void *PyErr_Occurred(void) { return 0; }
int PyErr_BadArgument(void) { return 0; }
void *PyObject_CallNoArgs(void *callable) { return callable; }
void Py_DecRef(void *object) { (void)object; }
char _Py_NoneStruct;
int main(void) { return 0; }
"""
X0, X2, SP, X30 = (getattr(arm64_const, f"UC_ARM64_REG_{name}") for name in ("X0", "X2", "SP", "X30"))
RDI, RDX, RSP = (getattr(x86_const, f"UC_X86_REG_{name}") for name in ("RDI", "RDX", "RSP"))
DATA, STACK, RETURN, ROOM, PAGE = 0x50000000, 0x60000000, 0x70000000, 1 << 22, 0x1000
STACK_END = STACK + ROOM // 2
# Processor, and its registers at a call of a method without arguments. x86-64 finds the place to return to on the stack.
TARGETS = {
    "aarch64-linux-musl": (
        (unicorn_const.UC_ARCH_ARM64, unicorn_const.UC_MODE_ARM),
        {X0: DATA, X2: 0, SP: STACK_END, X30: RETURN},
    ),
    "x86_64-linux-musl": (
        (unicorn_const.UC_ARCH_X86, unicorn_const.UC_MODE_64),
        {RDI: DATA, RDX: 0, RSP: STACK_END - 8},
    ),
}


class OtherMachine:
    """A program with methods in the memory of an emulated processor."""

    def __init__(self, target: str, texts: dict[str, str]) -> None:
        processor, self._registers = TARGETS[target]
        texts = texts | {"stubs.c": STUBS}
        sources = [name for name in texts if name.endswith(".c")]
        flags = (flag for flag in FLAGS if flag not in ("-shared", "-fPIC"))
        linked = ("-target", target, "-static", "-Wl,--no-gc-sections")
        program = compile_texts(texts, (*sources, "-lm"), (*flags, *linked), "program.elf", zig())
        self._cpu = Uc(*processor)
        with program.open("rb") as file:
            elf = ELFFile(file)
            table = elf.get_section_by_name(".symtab")
            self._addresses = {symbol.name: symbol["st_value"] for symbol in table.iter_symbols()}
            pages = set()
            for part in elf.iter_segments("PT_LOAD"):
                start = part["p_vaddr"]
                pages |= set(range(start // PAGE, -(-(start + part["p_memsz"]) // PAGE)))
            for page in pages:
                self._cpu.mem_map(page * PAGE, PAGE)
            for part in elf.iter_segments("PT_LOAD"):
                self._cpu.mem_write(part["p_vaddr"], part.data())
        for place in (DATA, STACK, RETURN):
            self._cpu.mem_map(place, ROOM)
        if processor[0] == unicorn_const.UC_ARCH_ARM64:
            self._cpu.reg_write(arm64_const.UC_ARM64_REG_CPACR_EL1, 3 << 20)  # floating point is allowed

    def call(self, name: str, arrays: Iterable[NDArray[np.generic]]) -> int:
        """Run a method on the memory of arrays; return its answer."""
        arrays = tuple(arrays)
        sizes = [-(-one.nbytes // 64) * 64 for one in arrays]
        places = [DATA + PAGE + sum(sizes[:index]) for index in range(len(sizes))]
        for one, place in zip(arrays, places, strict=True):
            self._cpu.mem_write(place, one.tobytes())
        self._cpu.mem_write(DATA, np.array(places, np.uint64).tobytes())
        self._cpu.mem_write(STACK_END - 8, RETURN.to_bytes(8, "little"))
        for register, value in self._registers.items():
            self._cpu.reg_write(register, value)
        self._cpu.emu_start(self._addresses[METHOD + name], RETURN)
        for one, place in zip(arrays, places, strict=True):
            content = bytes(self._cpu.mem_read(place, one.nbytes))
            one.reshape(-1).view(np.uint8)[:] = np.frombuffer(content, np.uint8)
        answer = bytes(self._cpu.mem_read(self._addresses["answered"], 8))
        return int.from_bytes(answer, "little", signed=True)
