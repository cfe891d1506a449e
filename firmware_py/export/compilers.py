"""The C compilers of this machine, and their outputs, which are kept by a hash of all inputs."""

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from firmware_py.export.errors import CompilerError
from firmware_py.extras import install_command
from firmware_py.kept_code import keep, kept_folder, may_load

SYSTEM_COMPILERS = ("gcc", "clang", "cc")
LIBRARY_FLAGS = (
    "-shared",
    "-fPIC",
    "-std=c99",
    "-fno-sanitize=all",
)  # zig traps undefined behaviour by default
HOST_FLAGS = (
    "-O2", *LIBRARY_FLAGS, "-Wall", "-Wextra", "-Wno-unused-parameter", "-Werror",  # callbacks take what unicorn gives
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Compiler:
    """A C compiler: its short name, the words of its command, and its version text."""

    name: str
    command: tuple[str, ...]
    version: str


def zig() -> Compiler:
    """Return the clang inside the package `ziglang`. Raises `CompilerError` when that is missing."""
    try:
        return Compiler("zig", (sys.executable, "-m", "ziglang", "cc"), version("ziglang"))
    except PackageNotFoundError:
        raise CompilerError(f"the compiler ziglang is missing: {install_command('deploy')}") from None


def compilers() -> Iterator[Compiler]:
    """Yield the C compilers of this machine, ziglang first."""
    if importlib.util.find_spec("ziglang"):
        yield zig()
    for name in SYSTEM_COMPILERS:
        path = shutil.which(name)
        if path:
            yield Compiler(name, (path,), _version(path))


def find_compiler(name: str = "") -> Compiler:
    """Return the compiler of that name, or the first one; raises `CompilerError` if there is none."""
    for compiler in compilers():
        if name in ("", compiler.name):
            return compiler
    raise _no_compiler(f" {name}" if name else "")


def _no_compiler(name: str) -> CompilerError:
    return CompilerError(f"no C compiler{name} on this machine: {install_command('compiler')}")


def by_first_that_works(make: Callable[[Compiler], Path]) -> Path:
    """Return what the first compiler makes that can, the system's before ziglang, which takes several times as long.

    Raises `CompilerError` with the first complaint.
    """
    first: CompilerError | None = None
    for compiler in sorted(compilers(), key=lambda one: one.name == "zig"):
        try:
            return make(compiler)
        except CompilerError as error:
            first = first or error
    raise first or _no_compiler("")


def compile_texts(
    texts: dict[str, str], inputs: Sequence[str], flags: Sequence[str], output: str, compiler: Compiler
) -> Path:
    """Compile texts in a separate folder, unless that was done before; return the path of the output.

    Raises `CompilerError` with the compiler's first complaint.
    """
    command = (*compiler.command, *flags)
    place = kept_folder("c", repr((compiler.version, sys.platform, command, sorted(texts.items()), inputs)))
    result = place / output
    if may_load(result):
        return result
    partial = f"{output}.{os.getpid()}"  # another process may write it, too
    try:
        for name, text in texts.items():
            keep(place / name, text.encode())  # the compiler of another process may have the old file mapped
    except OSError as error:
        raise CompilerError(f"{place}: cannot be written ({error.strerror or error})") from None
    caches = {name: str(kept_folder("zig")) for name in ("ZIG_LOCAL_CACHE_DIR", "ZIG_GLOBAL_CACHE_DIR")}
    done = _run((*command, "-o", partial, *inputs), cwd=place, env=os.environ | caches)
    if done.returncode:
        complaints = [line for line in done.stderr.splitlines() if "error" in line]
        raise CompilerError(f"{compiler.name}: {(complaints or [f'exit {done.returncode}'])[0]}")
    (place / partial).chmod(0o700)
    (place / partial).replace(result)
    return result


@cache
def _version(path: str) -> str:
    return _run((path, "--version")).stdout.strip()


def _run(command: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)
