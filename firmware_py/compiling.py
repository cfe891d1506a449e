"""Compilation by numba: IEEE arithmetic as it is written, kept on disk, and never older than its sources.

Without fast maths LLVM neither reorders nor fuses, so every processor computes the same bits. Numba decides by the file of
the function alone whether its cached code is current, not by the files of what was inlined; here the content of all
sources counts, wherever the cache lies (`__pycache__`, `NUMBA_CACHE_DIR`). Stale code is overwritten.
"""

import hashlib
import inspect
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

# Numba would load the BLAS of scipy, which takes longer than all the rest of it; nothing that is compiled here uses one.
if hide_scipy := "scipy" not in sys.modules:
    sys.modules["scipy"] = None  # type: ignore[assignment] # an import fails
import numba
import numba.np.arraymath  # which looks for it, when the first function is compiled or loaded

if hide_scipy:
    del sys.modules["scipy"]

PLAIN = bool(getattr(numba.config, "DISABLE_JIT"))  # noqa: B009 - set by numba at run time

Function = TypeVar("Function", bound=Callable[..., Any])


def compiler(*sources: Path) -> Callable[[Function], Function]:
    """Return the decorator of functions that depend on nothing but `sources`, files or folders, and their own file."""
    shared = hashlib.sha256(f"{np.__version__} {sys.version}".encode())
    for source in (Path(__file__), *sources):
        for path in sorted(source.glob("*.py")) if source.is_dir() else (source,):
            shared.update(path.read_bytes())

    def compiled(function: Function) -> Function:
        dispatcher: Any = numba.njit(cache=True, error_model="numpy", fastmath=False)(function)
        if not PLAIN:
            stamp = shared.copy()
            stamp.update(Path(inspect.getfile(function)).read_bytes())
            _kept(dispatcher)._source_stamp = stamp.hexdigest()
        return cast(Function, dispatcher)

    return compiled


def typed(function: Callable[..., Any], *examples: Any) -> Callable[..., Any]:
    """Return a function for arguments of the types of these: a compiled one then looks at types no more."""
    compiled = getattr(function, "compile", None)
    return (
        function
        if compiled is None
        else cast(Callable[..., Any], compiled(tuple(map(numba.typeof, examples))))
    )


def bound(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    """Return the call of a function on these arguments."""
    return partial(typed(function, *arguments), *arguments)


def is_kept(function: Callable[..., Any]) -> bool:
    """Return whether a function has been compiled on this machine already."""
    return PLAIN or bool(_kept(function)._load_index())


def _kept(dispatcher: Any) -> Any:
    """Return numba's index of the cached code of a function."""
    return dispatcher._cache._cache_file
