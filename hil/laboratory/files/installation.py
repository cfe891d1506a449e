"""Describes the installation: version, what flies, commit, packages of the extras, and programs that are called or
recommended.

A clone asks git for its commit. A wheel or an sdist has it in a file, written by `tools/build_hook.py`: git would report
the repository around the installed package.
"""

import platform
import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from firmware_py.extras import PROJECT, packages_of_extras

COMMIT = Path(__file__).parents[2] / "commit.txt"
ROOT = Path(__file__).parents[3]
COMPUTING = ("numpy", "pyarrow")  # packages whose versions could affect the bits of a flight
DEVELOPMENT = ("bench", "docs", "test", "clients")  # extras of the Makefile: no command asks for them
# Git reports the commit, the C compilers build `--board c`, the last two are for exported and emulated images.
PROGRAMS = ("git", "gcc", "clang", "arm-none-eabi-gcc", "gdb-multiarch")
PROGRAM_TIMEOUT_S = 2.0


def commit() -> str:
    """Return the git commit of the sources, with `+` when they were changed; empty if unknown."""
    if COMMIT.is_file():
        return COMMIT.read_text(encoding="utf-8").strip()
    if not (ROOT / ".git").exists():
        return ""
    # `git describe --dirty` would write the index, and leave its lock on a full disk.
    status = ("status", "--porcelain=v2", "--branch", "--no-ahead-behind", "--untracked-files=no")
    shown = _output("git", "--no-optional-locks", "-C", str(ROOT), *status, timeout_s=10.0)
    if (head := re.search(r"^# branch\.oid ([0-9a-f]{12})", shown, re.MULTILINE)) is None:
        return ""
    return head[1] + "+" * bool(re.search("^[^#]", shown, re.MULTILINE))


def has_git() -> bool:
    """Whether there is a repository, and git to ask for its commit."""
    return (ROOT / ".git").exists() and shutil.which("git") is not None


def versions() -> dict[str, str]:
    """Return the versions of the packages that compute a flight."""
    return {"python": platform.python_version()} | {name: _version(name) for name in (PROJECT, *COMPUTING)}


def describe() -> str:
    """Return the lines of `floaty --version`; the first one is `floaty, version VERSION, WHAT FLIES` in every release."""
    from firmware_py.compiling import flies_as  # numpy, slow to load

    rows = list(_rows())
    width = max(len(name) for name, _ in rows)
    lines = [f"{name:{width}}  {text}" for name, text in rows]
    return "\n".join((f"floaty, version {_version(PROJECT)}, {flies_as()}", *lines))


def _rows() -> Iterator[tuple[str, str]]:
    yield "commit", commit() or "unknown"
    yield "python", platform.python_version()
    yield "packages", _found(COMPUTING)
    for extra, packages in packages_of_extras().items():
        if extra not in DEVELOPMENT:
            yield (
                f"extra {extra}",
                _found(re.split(r"[^\w.-]", package, maxsplit=1)[0] for package in packages),
            )
    for program in PROGRAMS:
        yield f"program {program}", _version_of_program(program)


def _found(packages: Iterable[str]) -> str:
    return ", ".join(f"{package} {_version(package)}" for package in packages)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _version_of_program(name: str) -> str:
    """Return a program's version, without the packager's in brackets."""
    if shutil.which(name) is None:
        return "not found"
    first_line = _output(name, "--version", timeout_s=PROGRAM_TIMEOUT_S).partition("\n")[0]
    number = re.search(r"\d+(\.\d+)+", re.sub(r"\(.*?\)", "", first_line))
    return number[0] if number else "found, of unknown version"


def _output(*command: str, timeout_s: float) -> str:
    """Return a program's output; empty when it is missing, fails or takes longer."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()
