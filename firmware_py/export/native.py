"""The exported C on this machine: compiled into a shared library and called on the memory of the core's blocks."""

import ctypes
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from firmware_py.core.subset import Block, Struct
from firmware_py.core_runner import CoreBlocks
from firmware_py.export.c99 import Translation
from firmware_py.export.compilers import Compiler, compile_texts, find_compiler
from firmware_py.logic.plugs import ANSWERING

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror", "-fno-math-errno")
LIBRARY_FLAGS = ("-shared", "-fPIC", "-nostdlib")
ZIG_FLAGS = ("-fno-sanitize=all",)  # zig checks for undefined behaviour by default and traps


def build(
    translation: Translation,
    optimisation: str = "-O2",
    compiler: Compiler | None = None,
    flags: tuple[str, ...] = (),
) -> Path:
    """Return the shared library of the core; it is compiled unless it is kept."""
    compiler = compiler or find_compiler()
    no_traps = ZIG_FLAGS if compiler.name == "zig" else ()
    texts = {"floaty_core.h": translation.header, "floaty_core.c": translation.source}
    command = (optimisation, *FLAGS, *LIBRARY_FLAGS, *no_traps, *flags)
    return compile_texts(texts, ("floaty_core.c",), command, "floaty_core.so", compiler)


class NativeRunner:
    """Runs the compiled C on the blocks' own memory."""

    def __init__(self, blocks: CoreBlocks, library: Path) -> None:
        self._blocks = blocks  # keeps the memory alive
        code = ctypes.CDLL(str(library.absolute()))
        places = {name: _address(block) for name, block in blocks.named.items()}

        self._calls: dict[str, Callable[[], Any]] = {}
        for name, taken in blocks.calls.items():
            function = code[f"floaty_core_{name}"]
            function.restype = ctypes.c_int32 if name in ANSWERING else None
            self._calls[name] = partial(function, *(places[block] for block in taken))

    def call(self, name: str) -> int:
        return self._calls[name]() or 0


def _address(block: Block[Struct]) -> ctypes.c_void_p:
    return ctypes.c_void_p(block.memory.ctypes.data)
