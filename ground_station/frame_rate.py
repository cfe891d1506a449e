"""Whether motion capture delivers frames as often as the profile says, on which the rate of corrections depends."""

from itertools import pairwise
from statistics import median

WINDOW_US = 4_000_000  # in which it is measured: longer than a stall and the burst behind it
TOLERANCE = 0.1


class FrameRate:
    """Measures the usual period between exposures, once; sans I/O."""

    def __init__(self, period_us: int) -> None:
        self._period_us = period_us
        self._exposures_us: list[int] = []
        self._measured = False

    def on_frame(self, t_us: int) -> str:
        """Take an exposure; a line for the user, empty almost always."""
        if self._measured:
            return ""
        exposures_us = self._exposures_us
        exposures_us.append(t_us)
        if t_us - exposures_us[0] < WINDOW_US:
            return ""
        self._measured = True
        period_us = median(later - earlier for earlier, later in pairwise(exposures_us))
        if abs(period_us - self._period_us) <= TOLERANCE * self._period_us:
            return ""
        return (
            f"motion capture: a frame every {period_us * 1e-3:.1f} ms, not every {self._period_us * 1e-3:.1f} ms as "
            "mocap.period_us says: corrections leave at another rate"
        )
