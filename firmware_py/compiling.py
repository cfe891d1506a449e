"""Kernels as C: strict IEEE arithmetic, kept on disk, never older than their sources.

A kernel is a function of the subset (`firmware_py.core.subset`) and stays plain Python. `bound` returns its call on memory
that does not move: as a method of CPython in a C library, or the Python itself where no C compiler works, and with
FLOATY_PURE=1, for debuggers and coverage. `firmware_py/kept_code.py` has the folders of the libraries.
"""

import ctypes
import hashlib
import inspect
import os
import platform
import struct
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from firmware_py.core.subset import Block
from firmware_py.export.errors import CompilerError
from firmware_py.export.methods import METHOD
from firmware_py.kept_code import keep, kept_folder, may_load, report

PLAIN = os.environ.get("FLOATY_PURE", "0") not in ("", "0")
SUFFIX = ".so"
TRANSLATOR = Path(__file__).with_name("export")
FAST_CALL = 0x80  # `METH_FASTCALL`

Function = TypeVar("Function", bound=Callable[..., Any])
Memory = Block[Any] | NDArray[Any]
Functions = tuple[Callable[..., Any], ...]
ctypes.pythonapi.PyCFunction_NewEx.restype = ctypes.py_object
ctypes.pythonapi.PyCFunction_NewEx.argtypes = (ctypes.c_void_p, ctypes.py_object, ctypes.py_object)


def compiler(*sources: Path) -> Callable[[Function], Function]:
    """Return the decorator for kernels that depend only on `sources`, files or folders, and on their own file."""

    def compiled(function: Function) -> Function:
        _SOURCES[function] = (*sources, TRANSLATOR, Path(inspect.getfile(function)))
        return function

    return compiled


_SOURCES: dict[Callable[..., Any], tuple[Path, ...]] = {}


def hash_of(*sources: Path) -> str:
    """Return a hash of the machine, Python, numpy, this module and the present content of files and folders."""
    found = hashlib.sha256(f"{sys.platform} {platform.machine()} {sys.version} {np.__version__}".encode())
    for source in (Path(__file__), *sources):
        for path in sorted(source.glob("*.py")) if source.is_dir() else (source,):
            found.update(_digest(path, os.stat(path).st_mtime_ns))
    return found.hexdigest()


@cache
def _digest(path: Path, _changed_ns: int) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest()


def bound(function: Callable[..., Any], *memory: Memory) -> Callable[..., Any]:
    """Return the call of a kernel on the present memory of blocks and arrays; its integers are the call's arguments.

    An array with gaps, like a column of a matrix, is Python's. Raises `ExportError` for a kernel outside the subset.
    """
    return bound_together((function,), *memory)[0]


def bound_together(functions: Functions, *memory: Memory) -> list[Callable[..., Any]]:
    """Return the calls of kernels that take the same memory, from one library."""
    arrays = tuple(one.memory if isinstance(one, Block) else one for one in memory)
    if not PLAIN and all(one.flags.c_contiguous for one in arrays):
        try:
            library = _library(functions, arrays)
            return [bound_in(library, METHOD + function.__name__, *arrays) for function in functions]
        except (CompilerError, OSError) as error:
            fall_back(str(error))
    taken = [one.fields if isinstance(one, Block) else one for one in memory]
    return [as_python(function, *taken) for function in functions]


def as_python(function: Callable[..., Any], *taken: Any) -> Callable[..., Any]:
    """Return the call of a kernel as plain Python: with infinities and NaN it computes without a warning, as C does."""
    return partial(np.errstate(all="ignore")(function), *taken)


def bound_in(library: Path, method: str, *arrays: NDArray[Any]) -> Callable[..., Any]:
    """Return the call of a method in a library on the present memory of arrays.

    Raises `OSError` in a file system from which nothing may be executed.
    """
    places = struct.pack(f"{len(arrays)}P", *(one.ctypes.data for one in arrays))
    # the unused last argument keeps the memory alive as long as the call
    made = ctypes.pythonapi.PyCFunction_NewEx(ctypes.byref(_method_in(library, method)[0]), places, arrays)
    return cast(Callable[..., Any], made)


@cache
def fall_back(error: str) -> None:
    """Report, once, why no compiled code flies."""
    report(f"flies as plain Python, far slower: {error}")


def kept_library(path: Path, make: Callable[[], Path]) -> Path:
    """Return a library that is kept at `path`, made if it is missing. Raises what `make` raises."""
    if may_load(path):
        return path
    made = make()
    with suppress(OSError):
        keep(path, made.read_bytes())
    return path if path.exists() else made


def flies_as() -> str:
    """Return what flies on this machine: "C", or "plain Python" where nothing compiles."""
    from firmware_py.export.compilers import compilers

    return "C" if not PLAIN and any(compilers()) else "plain Python"


def must_compile(function: Callable[..., Any]) -> bool:
    """Return whether a kernel has not been compiled on this machine yet, and will be."""
    from firmware_py.export.compilers import compilers

    return not PLAIN and not any(_folder((function,)).glob(_name((function,), "*"))) and any(compilers())


class _Method(ctypes.Structure):
    """A `PyMethodDef` of CPython."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("doc", ctypes.c_char_p),
    )


@cache
def _method_in(library: Path, name: str) -> tuple[_Method, Any]:
    """Return a method in a library, and the owner of its machine code, which Python never frees."""
    code = ctypes.CDLL(str(library))
    address = ctypes.cast(code[name], ctypes.c_void_p).value
    return _Method(name.encode(), address, FAST_CALL, None), code


_LIBRARIES: dict[tuple[Functions, str], Path] = {}


def _library(functions: Functions, arrays: tuple[NDArray[Any], ...]) -> Path:
    """Return the library of kernels for memory of these kinds. Raises `ExportError`."""
    kinds = hashlib.sha256(repr([(one.dtype.str, one.shape) for one in arrays]).encode()).hexdigest()[:16]
    key = functions, kinds
    if key not in _LIBRARIES:

        def make() -> Path:
            from firmware_py.export.kernels import library  # not needed where one is kept

            return library(functions, arrays)

        _LIBRARIES[key] = kept_library(_folder(functions) / _name(functions, kinds), make)
    return _LIBRARIES[key]


def _folder(functions: Functions) -> Path:
    names = " ".join(f"{one.__module__}.{one.__name__}" for one in functions)
    sources = dict.fromkeys(source for one in functions for source in _SOURCES[one])
    return kept_folder("kernels", f"{names} {hash_of(*sources)}")


def _name(functions: Functions, kinds: str) -> str:
    return f"{functions[0].__module__}.{functions[0].__name__}-{kinds}{SUFFIX}"
