"""The exported core as machine code of a Cortex-M4F, hard float, linked alone for the flash of an STM32F405.

The compiler is the clang inside the package `ziglang`. An image that was already built from the same
text, flags and compiler is taken from the build folder.
"""

import hashlib
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from pathlib import Path
from typing import Any

from firmware_py.export.errors import ExportError
from firmware_py.extras import install_command

FLASH = 0x0800_0000
FLASH_SIZE = 0x10_0000
ENTRIES = ("reset", "file_pose", "estimate", "control")
SOURCES = Path(__file__).parent / "arm"
TARGET_FLAGS = (
    "-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m4+vfp4d16sp", "-std=c99", "-ffreestanding",
    "-ffp-contract=off", "-fno-math-errno", "-fno-sanitize=all", "-fno-stack-protector", "-fno-unwind-tables",
    "-ffunction-sections", "-fdata-sections", "-g", "-static", "-nostdlib",
    "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror",
)  # fmt: skip
HOST_FLAGS = ("-O2", "-shared", "-fPIC", "-std=c99", "-fno-sanitize=all", "-Wall", "-Wextra", "-Werror")


@dataclass(frozen=True, slots=True)
class Image:
    """What lies in flash."""

    path: Path
    code: bytes  # from FLASH on
    entries: dict[str, int]  # address of each entry point, bit 0 set as Thumb wants it
    constants: frozenset[int]  # half words of `code` that are not instructions


def build_image(source: str, header: str, folder: Path, optimisation: str = "-Os") -> Image:
    """Compile and link the core, as small as the Crazyflie's firmware is; `folder` keeps it. Raises `ExportError`."""
    texts = {"floaty_core.c": source, "floaty_core.h": header}
    texts.update({name: (SOURCES / name).read_text(encoding="utf-8") for name in ("rt.c", "flash.ld")})
    flags = (*TARGET_FLAGS, optimisation, "-fno-builtin", "-T", "flash.ld")
    return read_image(compile_texts(texts, ("floaty_core.c", "rt.c"), flags, "floaty_core.elf", folder))


def build_meter(folder: Path) -> Path:
    """Compile arm/meter.c into a library for this machine. Raises `ExportError`."""
    text = (SOURCES / "meter.c").read_text(encoding="utf-8")
    return compile_texts({"meter.c": text}, ("meter.c",), HOST_FLAGS, "meter.so", folder)


def read_image(path: Path, alone: bool = True) -> Image:
    """Read a linked image, the core `alone` or in a firmware around it.

    Raises `ExportError` when an entry point is missing, or when the core alone has variables.
    """
    try:
        from elftools.common.exceptions import ELFError
        from elftools.elf.elffile import ELFFile
    except ImportError:
        raise ExportError(f"pyelftools is missing: {install_command('deploy')}") from None
    try:
        stream = path.open("rb")
    except OSError as error:
        raise ExportError(f"{path}: {error.strerror or error}") from None
    with stream:
        try:
            elf: Any = ELFFile(stream)
        except ELFError as error:
            raise ExportError(f"{path}: not an ELF file: {error}") from None
        code = bytearray()
        for section in elf.iter_sections():
            if not section["sh_flags"] & 2 or not section["sh_size"]:  # SHF_ALLOC
                continue
            if section["sh_flags"] & 1:  # SHF_WRITE
                if not alone:
                    continue
                raise ExportError(f"{path}: section {section.name} is variable memory outside the structs")
            end = section["sh_addr"] - FLASH + section["sh_size"]
            if not 0 < end <= FLASH_SIZE - 16:
                raise ExportError(
                    f"{path}: section {section.name} does not lie in the {FLASH_SIZE} bytes of flash"
                )
            code.extend(bytes(max(0, end - len(code))))
            code[end - section["sh_size"] : end] = section.data()
        table = elf.get_section_by_name(".symtab")
        if table is None:
            raise ExportError(f"{path}: it has no symbols")
        symbols = [(symbol["st_value"], symbol.name) for symbol in table.iter_symbols()]
    addresses = {name: address for address, name in symbols}
    try:
        entries = {name: addresses[f"floaty_core_{name}"] | 1 for name in ENTRIES}
    except KeyError as error:
        raise ExportError(f"{path}: there is no function {error.args[0]}") from None
    return Image(path, bytes(code) + bytes(len(code) % 2), entries, constants_of(symbols, len(code)))


def constants_of(symbols: Sequence[tuple[int, str]], size: int) -> frozenset[int]:
    """Return the half words of flash between the mapping symbols $d and $t: address and name of each symbol."""
    marks = sorted(
        (address, name[:2])
        for address, name in symbols
        if name[:2] in ("$d", "$t") and FLASH <= address < FLASH + size
    )
    found: set[int] = set()
    for (begin, kind), (end, _) in pairwise([*marks, (FLASH + size, "$t")]):
        if kind == "$d":
            found.update(range((begin - FLASH) // 2, (end - FLASH + 1) // 2))
    return frozenset(found)


def compile_texts(
    texts: dict[str, str], inputs: Sequence[str], flags: Sequence[str], output: str, folder: Path
) -> Path:
    """Compile texts in a folder of their own, unless that was done before; returns the path of the output."""
    try:
        compiler = version("ziglang")
    except PackageNotFoundError:
        raise ExportError(f"the compiler ziglang is missing: {install_command('deploy')}") from None
    folder = folder.absolute()
    digest = hashlib.sha256(repr((compiler, sys.platform, sorted(texts.items()), inputs, flags)).encode())
    place = folder / digest.hexdigest()[:16]
    result = place / output
    if result.is_file():
        return result
    partial = f"{output}.{os.getpid()}"
    try:
        place.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (place / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ExportError(f"{place}: cannot be written ({error.strerror or error})") from None
    cache = str(folder / "zig")
    done = subprocess.run(
        [sys.executable, "-m", "ziglang", "cc", *flags, "-o", partial, *inputs],
        cwd=place, capture_output=True, text=True, check=False,
        env={**os.environ, "ZIG_LOCAL_CACHE_DIR": cache, "ZIG_GLOBAL_CACHE_DIR": cache},
    )  # fmt: skip
    if done.returncode:
        raise ExportError(f"{place}: {' '.join(done.stderr.split()[:60])}")
    (place / partial).replace(result)
    return result
