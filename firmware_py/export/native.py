"""The exported C on this machine: compiled into a shared library and called on the memory of the core's blocks.

Libraries are cached in a folder by a hash of what they were made from. The compiler is
`ziglang` from PyPI (extra `deploy`) or the system's.
"""

import ctypes
import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from firmware_py.core.subset import Block, Struct
from firmware_py.core_runner import CoreBlocks
from firmware_py.export.c99 import Translation
from firmware_py.export.errors import ExportError
from firmware_py.extras import install_command

SYSTEM_COMPILERS = ("gcc", "clang", "cc")
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror", "-fno-math-errno")
LIBRARY_FLAGS = ("-shared", "-fPIC", "-nostdlib")
ZIG_FLAGS = ("-fno-sanitize=all",)  # zig checks for undefined behaviour by default and traps


@dataclass(frozen=True, slots=True)
class Compiler:
    """A C compiler: its short name, the words of its command, and what it says about its version."""

    name: str
    command: tuple[str, ...]
    version: str


def compilers() -> Iterator[Compiler]:
    """Yield the C compilers of this machine, ziglang first."""
    if importlib.util.find_spec("ziglang"):
        python = (sys.executable, "-m", "ziglang")
        yield Compiler("zig", (*python, "cc"), _version(*python, "version"))
    for name in SYSTEM_COMPILERS:
        path = shutil.which(name)
        if path:
            yield Compiler(name, (path,), _version(path, "--version"))


def find_compiler(name: str = "") -> Compiler:
    """Return the compiler of that name, or the first one; raises `ExportError` if there is none."""
    for compiler in compilers():
        if name in ("", compiler.name):
            return compiler
    raise ExportError(
        f"no C compiler{' ' + name if name else ''} on this machine: {install_command('deploy')}"
    )


def build(
    translation: Translation,
    folder: Path,
    optimisation: str = "-O2",
    compiler: Compiler | None = None,
    flags: tuple[str, ...] = (),
) -> Path:
    """Return the shared library of the core; it is compiled unless the folder has it."""
    compiler = compiler or find_compiler()
    zig = ZIG_FLAGS if compiler.name == "zig" else ()
    command = (*compiler.command, optimisation, *FLAGS, *LIBRARY_FLAGS, *zig, *flags)
    made_from = "\0".join((translation.header, translation.source, compiler.version, *command))
    home = folder / hashlib.sha256(made_from.encode()).hexdigest()[:16]
    library = home / "floaty_core.so"
    if library.is_file():
        return library
    work = home.with_suffix(f".{os.getpid()}")
    work.mkdir(parents=True, exist_ok=True)
    (work / "floaty_core.h").write_text(translation.header, "utf-8")
    (work / "floaty_core.c").write_text(translation.source, "utf-8")
    caches = {
        name: str(folder.absolute() / "zig") for name in ("ZIG_LOCAL_CACHE_DIR", "ZIG_GLOBAL_CACHE_DIR")
    }
    try:
        _output((*command, "-o", str(work / library.name), str(work / "floaty_core.c")), caches)
        if not home.exists():
            work.rename(home)
    except OSError:
        if not library.is_file():  # another process may have been faster
            raise
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return library


@cache
def _version(*command: str) -> str:
    return _output(command, {})


def _output(command: tuple[str, ...], environment: dict[str, str]) -> str:
    """Return the output of a command. Raises `ExportError` with its first complaint."""
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | environment, check=False)
    if done.returncode != 0:
        complaints = [line for line in done.stderr.splitlines() if "error" in line] or [
            f"exit {done.returncode}"
        ]
        raise ExportError(f"{Path(command[0]).name}: {complaints[0]}")
    return done.stdout.strip()


class NativeRunner:
    """Runs the compiled C on the blocks' own memory."""

    __slots__ = ("_blocks", "control", "estimate", "file_pose", "reset")

    def __init__(self, blocks: CoreBlocks, library: Path) -> None:
        self._blocks = blocks  # keeps the memory alive
        code = ctypes.CDLL(str(library.absolute()))
        places = {name: _address(block) for name, block in blocks.named.items()}

        def call(name: str) -> Callable[[], Any]:
            function = code[f"floaty_core_{name}"]
            function.restype = ctypes.c_int32 if name == "file_pose" else None
            return partial(function, *(places[block] for block in blocks.calls[name]))

        self.reset: Callable[[], None] = call("reset")
        self.file_pose: Callable[[], int] = call("file_pose")
        self.estimate: Callable[[], None] = call("estimate")
        self.control: Callable[[], None] = call("control")


def _address(block: Block[Struct]) -> ctypes.c_void_p:
    return ctypes.c_void_p(block.memory.ctypes.data)
