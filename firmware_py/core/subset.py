"""The typed subset of Python in which the flight core is written, and its two ways to run.

Subset: module constants `f32(..)`, `i32(..)` and plain ints; state structs (`class Name(Struct)` with `f32`, `i32` or
`Annotated[F32s, ...]` annotations); functions marked `@kernel` with annotated scalars and structs; `for` over `range`,
`if`/`elif`/`else`; `+ - * /` on float32, `+ - * // %` on small non-negative int32; comparisons, `and`/`or`/`not`; calls of
other kernels; `abs`, `sqrt`. Floats never meet ints without `f32(..)`, and every constant is explicitly float32: numba
would otherwise compute in double where CPython and C do not.

A struct is one block of memory with the layout of the C struct (naturally aligned), so that plain Python, numba and the
microcontroller can be compared byte by byte. Kernels are compiled by numba and cached beside this file; with
NUMBA_DISABLE_JIT=1 they stay plain Python that a debugger can step through.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, TypeAlias, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

f32 = np.float32
i32 = np.int32
sqrt = np.sqrt  # correctly rounded on every target: sqrtss on x86, VSQRT.F32 on the Cortex-M4

PLAIN = bool(getattr(numba.config, "DISABLE_JIT"))  # noqa: B009 - set by numba at run time

_Function = TypeVar("_Function", bound=Callable[..., Any])


def _drop_stale_cache() -> None:
    """Delete numba's cache files of this package when any of its sources changed.

    Numba looks only at the file of the function that it loads, not at the files of the functions that were inlined.
    """
    folder = Path(__file__).parent
    digest = hashlib.sha256(f"{numba.__version__} {np.__version__} {sys.version}".encode())
    for source in sorted(folder.glob("*.py")):
        digest.update(source.read_bytes())
    stamp = folder / "__pycache__" / "kernels.sha256"
    if stamp.is_file() and stamp.read_text() == digest.hexdigest():
        return
    for pattern in ("*.nbi", "*.nbc"):
        for stale in stamp.parent.glob(pattern):
            stale.unlink(missing_ok=True)
    try:
        stamp.parent.mkdir(exist_ok=True)
        partial = stamp.with_suffix(f".{os.getpid()}")
        partial.write_text(digest.hexdigest())
        partial.replace(stamp)
    except OSError:  # a read-only installation: numba then keeps its cache elsewhere
        return


if not PLAIN:
    _drop_stale_cache()


def kernel(function: _Function) -> _Function:
    """Compile a function of the subset; the same function in plain Python when numba is switched off."""
    compiled: Any = numba.njit(cache=True, error_model="numpy", fastmath=False)(function)
    return cast(_Function, compiled)


F32s: TypeAlias = NDArray[np.float32]
I32s: TypeAlias = NDArray[np.int32]
Integer: TypeAlias = int | np.int32
Memory: TypeAlias = Any  # a one-element array of structs: what an entry kernel takes


class Block:
    """The memory of one struct instance.

    `memory` is a structured array of shape (1,), `fields` gives attribute access to it from outside the core
    (array fields are views), `arg` is what an entry kernel takes: the memory, or the fields when nothing is compiled.
    """

    __slots__ = ("arg", "fields", "memory")

    def __init__(self, dtype: np.dtype[Any], view: type[Any]) -> None:
        self.memory: NDArray[Any] = np.zeros(1, dtype)
        self.fields: Any = view(self.memory)
        self.arg: Any = [self.fields] if PLAIN else self.memory

    def bytes(self) -> bytes:
        """Return the struct as the bytes that lie in memory."""
        return self.memory.tobytes()


def _scalar_property(name: str) -> property:
    slot = "_" + name

    def get(view: Any) -> Any:
        return getattr(view, slot)[0]

    def put(view: Any, value: Any) -> None:
        getattr(view, slot)[0] = value

    return property(get, put)


class Struct:
    """Base of the state structs; annotations are the fields in the order of the C struct.

    Array fields are written `Annotated[F32s, 16, 16]` or `Annotated[I32s, 3]`.
    """

    dtype: ClassVar[np.dtype[Any]]
    _view: ClassVar[type[Any]]

    def __init_subclass__(cls) -> None:
        columns: list[Any] = []
        for name, kind in cls.__annotations__.items():
            shape = getattr(kind, "__metadata__", ())
            element = kind if not shape else f32 if kind.__origin__ == F32s else i32
            columns.append((name, element, shape) if shape else (name, element))
        cls.dtype = np.dtype(columns, align=True)
        scalars = tuple(column[0] for column in columns if len(column) == 2)
        arrays = tuple(column[0] for column in columns if len(column) == 3)

        def bind(view: Any, memory: NDArray[Any]) -> None:
            for name in scalars:
                setattr(view, "_" + name, memory[name])
            for name in arrays:
                setattr(view, name, memory[name][0])

        body: dict[str, Any] = {name: _scalar_property(name) for name in scalars}
        body["__slots__"] = (*("_" + name for name in scalars), *arrays)
        body["__init__"] = bind
        cls._view = type(cls.__name__ + "View", (), body)

    @classmethod
    def allocate(cls) -> Block:
        """Return a zeroed instance."""
        return Block(cls.dtype, cls._view)
