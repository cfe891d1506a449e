"""Random use of one part, and what was seen of it."""

from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

import numpy as np

from support.approved import Log


def shown(value: Any, digits: int = 5) -> str:
    """Return any value as text, its numbers to some digits, so that no mathematics library shows in it."""
    again = partial(shown, digits=digits)
    if is_dataclass(value) and not isinstance(value, type):
        content = ", ".join(again(getattr(value, one.name)) for one in fields(value))
        return f"{type(value).__name__}({content})"
    if callable(value):
        return again(value())
    if isinstance(value, np.ndarray):
        return again(value.tolist())
    if isinstance(value, list | tuple):
        return f"[{' '.join(map(again, value))}]"
    if isinstance(value, float):
        return f"{value + 0.0:.{digits}g}"
    return str(value)


def by_seed(
    kinds: Iterable[Any], seeds: Iterable[int], told: Callable[[Any, int], dict[str, str]]
) -> dict[str, Callable[[], dict[str, str]]]:
    """Return a function for every kind and seed, named after both, that uses the kind and returns what was seen."""
    seeds = tuple(seeds)
    return {f"{kind.__name__} {seed}": partial(told, kind, seed) for kind in kinds for seed in seeds}


class Random:
    """Random numbers of a seed, and what was noted."""

    def __init__(self, seed: int) -> None:
        self.rng, self.log = np.random.default_rng(seed), Log()

    def pick(self, *of: Any) -> Any:
        """Return one of the arguments."""
        return of[int(self.rng.integers(len(of)))]

    def below(self, bound: int) -> int:
        """Return a number from 0 on."""
        return int(self.rng.integers(bound))

    def data(self, *sizes: int) -> bytes:
        """Return bytes of one of the sizes."""
        return self.rng.bytes(self.pick(*sizes))


def hash_of(data: bytes | bytearray) -> int:
    """Return a number that differs with the contents."""
    return int(np.frombuffer(bytes(data), np.uint8).astype(np.int64) @ (np.arange(len(data)) % 9973 + 1))
