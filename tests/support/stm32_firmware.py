"""The tests' own firmware for the STM32F405 (tests/firmware_stm32), built by clang or GCC, once for the same sources."""

import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from firmware_py.export.elf import Symbol
from hil.emulator.stm32f405.image import Image
from support.paths import ROOT, TESTS

PLACE = 0x2001_0000  # in RAM, which the tests' firmware does not use
SOURCES = TESTS / "firmware_stm32"
BUILD = ROOT / "runs" / "build"
FILES = ("firmware.c", "exceptions.c", "measured.c")
SCRIPT = "stm32f405.ld"
COMMON = (
    "-std=gnu11", "-O2", "-ffreestanding", "-nostdlib", "-static", "-Wall", "-Wextra", "-Werror",
    "-Wl,--entry=Reset_Handler",
)  # fmt: skip
CLANG = (
    sys.executable, "-m", "ziglang", "cc", "-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m4+vfp4d16sp",
    "-fno-sanitize=all", "-fno-stack-protector",
)  # fmt: skip
GCC = ("arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")


def build(
    compiler: str = "clang", flags: Sequence[str] = ("-g",), script: tuple[str, str] = ("", "")
) -> Path:
    """Return the linked firmware; `script` replaces a text of the linker script. Skips the test without the compiler."""
    if compiler == "clang" and importlib.util.find_spec("ziglang") is None:
        pytest.skip("ziglang is not installed: the tests' firmware cannot be built")
    if compiler == "gcc" and shutil.which(GCC[0]) is None:
        pytest.skip("arm-none-eabi-gcc is not installed: the tests' firmware cannot be built by it")
    texts = {path.name: path.read_text(encoding="utf-8") for path in sorted(SOURCES.iterdir())}
    texts[SCRIPT] = texts[SCRIPT].replace(*script)
    command = (*(CLANG if compiler == "clang" else GCC), *COMMON, *flags, "-T", SCRIPT, *FILES)
    digest = hashlib.sha256(repr((sorted(texts.items()), command)).encode()).hexdigest()[:16]
    place = BUILD / f"firmware_stm32-{digest}"
    result = place / "firmware.elf"
    if result.is_file():
        return result
    place.mkdir(parents=True, exist_ok=True)
    # Replaced, not written over: the compiler of another process may have the old file mapped.
    for name, text in texts.items():
        fresh = place / f"{name}.{os.getpid()}"
        fresh.write_text(text, encoding="utf-8")
        fresh.replace(place / name)
    partial = f"firmware.{os.getpid()}"
    cache = {"ZIG_LOCAL_CACHE_DIR": str(BUILD / "zig"), "ZIG_GLOBAL_CACHE_DIR": str(BUILD / "zig")}
    ran = subprocess.run(
        (*command, "-o", partial),
        cwd=place,
        env={**os.environ, **cache},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr[-4000:]
    (place / partial).replace(result)
    return result


def flash_binary(elf: Path) -> bytes:
    """Return what lies in flash, from the vector table on, as `objcopy -O binary` writes it."""
    content = elf.read_bytes()
    (programs,) = (int.from_bytes(content[28:32], "little"),)
    size, count = (int.from_bytes(content[at : at + 2], "little") for at in (42, 44))
    pieces = []
    for index in range(count):
        at = programs + index * size
        _, offset, _, load, length = (
            int.from_bytes(content[at + 4 * field : at + 4 * field + 4], "little") for field in range(5)
        )
        if length:
            pieces.append((load, content[offset : offset + length]))
    base = min(load for load, _ in pieces)
    binary = bytearray(max(load + len(data) for load, data in pieces) - base)
    for load, data in pieces:
        binary[load - base : load - base + len(data)] = data
    return bytes(binary)


def image_with(**sizes: int) -> Image:
    """Return the tests' image with variables of these sizes, one after the other."""
    image, place = Image(build()), PLACE
    for name, size in sizes.items():
        image._variables[name] = [Symbol(name, place, size, False, True)]
        place += (size + 7) // 8 * 8
    return image
