"""Normal noise with the same bits on every processor."""

import numpy as np
from numpy.typing import NDArray

STEPS = 65536.0  # per standard deviation


def normal(rng: np.random.Generator, shape: int | tuple[int, ...]) -> NDArray[np.float64]:
    """Return numbers of the standard normal distribution, rounded to 1 / `STEPS`.

    Beyond 3.65, numpy takes a logarithm of the C library, which differs in its last bit; rounding removes that.
    """
    return np.asarray(np.rint(rng.standard_normal(shape) * STEPS) / STEPS)
