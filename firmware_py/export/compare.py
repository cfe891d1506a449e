"""Memory of the flight core, compared bit for bit: the words of a struct in which two targets differ.

Every field of the structs is a float32 or an int32 without gaps between them. All NaN patterns count as equal, because
processors choose their payloads; everything else, the sign of zero included, has to agree in all 32 bits.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.core.subset import f32, i32

WORD = np.dtype(np.uint32)


@dataclass(frozen=True, slots=True)
class Difference:
    """One word of a struct that differs between two memories."""

    field: str  # with its element, like P[3,4]
    values: tuple[float, float]
    patterns: tuple[int, int]

    @property
    def bits(self) -> int:
        """How many bits differ."""
        return (self.patterns[0] ^ self.patterns[1]).bit_count()

    def __str__(self) -> str:
        values = " | ".join(
            f"{value!r} {pattern:08x}" for value, pattern in zip(self.values, self.patterns, strict=True)
        )
        return f"{self.field}: {values} ({self.bits} bits)"


def differing_bits(first: bytes, second: bytes, dtype: np.dtype[Any]) -> tuple[Difference, ...]:
    """Return the words in which two memories of one struct differ, in the order of the memory; empty: none.

    `dtype` is the struct's, as in `firmware_py.core.structs`. Memories of another size raise `ValueError`.
    """
    if not len(first) == len(second) == dtype.itemsize:
        raise ValueError(f"{len(first)} and {len(second)} bytes: expected twice {dtype.itemsize}")
    if first == second:
        return ()
    names, floats = _words(dtype)
    a, b = (np.frombuffer(memory, WORD) for memory in (first, second))
    unlike = (a != b) & ~(floats & _nan(a) & _nan(b))
    return tuple(
        Difference(names[index], (_value(a, index, floats), _value(b, index, floats)), (int(a[index]), int(b[index])))
        for index in np.flatnonzero(unlike)
    )  # fmt: skip


def _nan(words: NDArray[np.uint32]) -> NDArray[np.bool_]:
    return np.isnan(words.view(f32))


def _value(words: NDArray[np.uint32], index: np.intp, floats: NDArray[np.bool_]) -> float:
    word = words[index : index + 1]
    return float(str(word.view(f32)[0])) if floats[index] else int(word.view(i32)[0])


@lru_cache(maxsize=16)
def _words(dtype: np.dtype[Any]) -> tuple[tuple[str, ...], NDArray[np.bool_]]:
    """Return name and kind (is it a float32?) of every word of a struct."""
    names: list[str] = []
    floats: list[bool] = []
    for name in dtype.names or ():
        field = dtype.fields[name][0]  # type: ignore[index]
        if field.base not in (f32, i32) or dtype.fields[name][1] != len(names) * WORD.itemsize:  # type: ignore[index]
            raise ValueError(f"{name}: {field.base} behind {len(names)} words; expected 32 bits without gaps")
        for element in np.ndindex(field.shape):
            names.append(f"{name}[{','.join(map(str, element))}]" if element else name)
            floats.append(field.base == f32)
    return tuple(names), np.array(floats)
