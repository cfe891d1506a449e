"""Random use of one part, and what was seen of it."""

from typing import Any

import numpy as np

from support.approved import Log


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
