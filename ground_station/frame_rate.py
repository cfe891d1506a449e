"""Whether motion capture delivers frames as often as the profile says, on which the rate of corrections depends."""

from statistics import median

FRAMES = 200  # over which it is measured
TOLERANCE = 0.1


class FrameRate:
    """Measures the period between the exposures of the first frames; sans I/O."""

    def __init__(self, period_us: int) -> None:
        self._period_us = period_us
        self._last_us: int | None = None
        self._periods_us: list[int] = []

    def on_frame(self, t_us: int) -> str:
        """Take an exposure; a line for the user, empty almost always."""
        last_us, self._last_us = self._last_us, t_us
        if last_us is None or len(self._periods_us) == FRAMES:
            return ""
        self._periods_us.append(t_us - last_us)
        if len(self._periods_us) < FRAMES:
            return ""
        period_us = median(self._periods_us)
        if abs(period_us - self._period_us) <= TOLERANCE * self._period_us:
            return ""
        return (
            f"motion capture: a frame every {period_us * 1e-3:.1f} ms, not every {self._period_us * 1e-3:.1f} ms as "
            "mocap.period_us says: corrections leave at another rate"
        )
