"""Checks that motion capture delivers frames at the profile's rate, and often enough for the corrections."""

from itertools import pairwise
from statistics import median

WINDOW_US = 4_000_000  # of the measurement: longer than a stall and the burst after it
TOLERANCE = 0.1


class FrameRate:
    """Measures the usual period between exposures, once; sans I/O."""

    def __init__(self, period_us: int, corrections_hz: float, longest_us: int) -> None:
        """`longest_us`: frames that are further apart make no track."""
        self._longest_us = longest_us
        self._period_us = period_us
        self._corrections_hz = corrections_hz
        self._exposures_us: list[int] = []
        self._measured = False

    def on_frame(self, t_us: int) -> str:
        """Take an exposure; return a line for the user, nearly always empty."""
        if self._measured:
            return ""
        exposures_us = self._exposures_us
        exposures_us.append(t_us)
        if t_us - exposures_us[0] < WINDOW_US:
            return ""
        self._measured = True
        period_us = median(later - earlier for earlier, later in pairwise(exposures_us))
        rate_hz = 1e6 / period_us
        as_configured = abs(period_us - self._period_us) <= TOLERANCE * self._period_us
        slow = rate_hz < (1.0 - TOLERANCE) * self._corrections_hz
        if as_configured and not slow:
            return ""
        expected = (
            "" if as_configured else f", not every {self._period_us * 1e-3:.1f} ms as set by mocap.period_us"
        )
        leaving = f"{rate_hz:.0f}, not {self._corrections_hz:g}" if slow else f"{self._corrections_hz:g}"
        effect = f"{leaving} corrections leave per second"
        if period_us >= self._longest_us:
            effect = f"no corrections leave, see tracker.reacquire_us = {self._longest_us}"
        return f"motion capture: a frame every {period_us * 1e-3:.1f} ms{expected}: {effect}"
