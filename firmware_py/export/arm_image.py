"""The exported core as machine code of a Cortex-M4F, hard float, linked alone for the flash of an STM32F405.

The compiler is the clang inside the package `ziglang`. An image that was already built from the same
text, flags and compiler is not built again.
"""

from dataclasses import dataclass
from pathlib import Path

from firmware_py.export.compilers import compile_texts, zig
from firmware_py.export.elf import FLASH, Elf
from firmware_py.export.errors import ExportError
from firmware_py.logic.plugs import CALLS

SOURCES = Path(__file__).parent / "arm"
TARGET_FLAGS = (
    "-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m4+vfp4d16sp", "-std=c99", "-ffreestanding",
    "-ffp-contract=off", "-fno-math-errno", "-fno-sanitize=all", "-fno-stack-protector", "-fno-unwind-tables",
    "-ffunction-sections", "-fdata-sections", "-g", "-static", "-nostdlib",
    "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror",
    "-Wno-self-assign", "-Wno-tautological-compare",  # own logic may have x = x and n == n
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class CoreImage:
    """The content of flash."""

    path: Path
    code: bytes  # from FLASH on
    entries: dict[str, int]  # address of each entry point, bit 0 set for Thumb
    constants: frozenset[int]  # half words of `code` that are not instructions


def build_image(source: str, header: str, optimisation: str = "-Os") -> CoreImage:
    """Compile and link the core for size, like the Crazyflie's firmware. Raises `ExportError`."""
    texts = {"floaty_core.c": source, "floaty_core.h": header}
    texts.update({name: (SOURCES / name).read_text(encoding="utf-8") for name in ("rt.c", "flash.ld")})
    flags = (*TARGET_FLAGS, optimisation, "-fno-builtin", "-T", "flash.ld")
    return read_image(compile_texts(texts, ("floaty_core.c", "rt.c"), flags, "floaty_core.elf", zig()))


def read_image(path: Path, alone: bool = True) -> CoreImage:
    """Read a linked image, the core `alone` or in a firmware around it.

    Raises `ExportError` when an entry point is missing, or when the core alone has variables.
    """
    elf = Elf(path)
    if alone and any(segment.writable and segment.size for segment in elf.segments):
        raise ExportError(f"{path}: it has variable memory outside the structs")
    code = bytes(elf.base - FLASH) + elf.code
    code += bytes(len(code) % 2)
    addresses = {symbol.name: symbol.address for symbol in elf.symbols}
    try:
        entries = {name: addresses[f"floaty_core_{name}"] | 1 for name in CALLS}
    except KeyError as error:
        raise ExportError(f"{path}: there is no function {error.args[0]}: it lacks Floaty's core") from None
    return CoreImage(path, code, entries, elf.constants(FLASH, len(code)))
