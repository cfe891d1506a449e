"""The gyro's zero: found at start, in counts, while the robot is held still."""

from firmware_py.board import ImuCounts

SAMPLES = 512  # original firmware
VARIANCE_LIMIT = (
    10_000.0  # [counts^2] 0.1 rad/s rms: more than sensor noise in the flow, less than a moving robot
)


class GyroZero:
    """Averages 512 samples; a window in which the robot moved is thrown away and the next one begins."""

    def __init__(self) -> None:
        self.bias: tuple[float, float, float] | None = None  # [counts] sensor frame; None while searching
        self.windows_refused = 0
        self._window: list[ImuCounts] = []

    def add(self, counts: ImuCounts) -> bool:
        """Take a sample; True when the zero has just been found."""
        self._window.append(counts)
        if len(self._window) < SAMPLES:
            return False
        window, self._window = self._window, []
        sums = [sum(sample[axis] for sample in window) for axis in range(3)]
        squares = [sum(sample[axis] ** 2 for sample in window) for axis in range(3)]
        for total, square in zip(sums, squares, strict=True):
            if square * SAMPLES - total * total > VARIANCE_LIMIT * SAMPLES * SAMPLES:
                self.windows_refused += 1
                return False
        self.bias = (sums[0] / SAMPLES, sums[1] / SAMPLES, sums[2] / SAMPLES)
        return True
