"""The decorator of the plant's compiled functions, and the care for their cache on disk."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def _drop_stale_cache(folder: Path) -> None:
    """Delete numba's cache of this folder when any source in it changed.

    Numba compares only the file of the function that it loads, not the files whose constants and functions went into it.
    """
    digest = hashlib.sha256()
    for source in sorted(folder.glob("*.py")):
        digest.update(source.read_bytes())
    cache = folder / "__pycache__"
    stamp = cache / "plant.sha256"
    if stamp.is_file() and stamp.read_text() == digest.hexdigest():
        return
    with contextlib.suppress(OSError):  # a read-only installation: numba keeps its cache elsewhere
        for stale in (*cache.glob("*.nbi"), *cache.glob("*.nbc")):
            stale.unlink(missing_ok=True)
        cache.mkdir(exist_ok=True)
        stamp.write_text(digest.hexdigest())


_drop_stale_cache(Path(__file__).parent)


def compiled(function: Function) -> Function:
    """Compile for float64 with IEEE division and without fast maths; kept on disk for the next start."""
    return cast(Function, numba.njit(cache=True, error_model="numpy")(function))
