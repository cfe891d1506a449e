"""What the tracker tells the user: one line for all that happened within half a second."""

from dataclasses import dataclass
from math import degrees

GATHER_US = 500_000


@dataclass(slots=True)
class TrackNotices:
    """Collects what happened until it is due; times are those of frames."""

    _refused: int = 0
    _distance: float = 0.0  # the largest [m]
    _angle: float = 0.0  # [rad]
    _lost: bool = False
    _gap_us: int | None = None  # before a track that begun anew
    _due_us: int | None = None

    def refused(self, t_us: int, distance: float, angle: float) -> None:
        """A pose was so far from the prediction [m, rad]."""
        self._refused += 1
        self._distance = max(self._distance, distance)
        self._angle = max(self._angle, angle)
        self._happened(t_us)

    def lost(self, t_us: int) -> None:
        """There is no track any more."""
        self._lost = True
        self._happened(t_us)

    def begun_anew(self, t_us: int, gap_us: int) -> None:
        """There is one again, `gap_us` after the last good pose."""
        self._gap_us = gap_us
        self._happened(t_us)

    def due(self, t_us: int) -> list[str]:
        """At most one line, by a clock that may jump."""
        if self._due_us is None or 0 < self._due_us - t_us <= GATHER_US:
            return []
        told = []
        if self._refused:
            poses = "1 pose" if self._refused == 1 else f"{self._refused} poses"
            told.append(
                f"{poses} refused, up to {self._distance:.2f} m and {degrees(self._angle):.0f} deg off"
            )
        if self._gap_us is not None:
            told.append(f"track begun anew after {self._gap_us * 1e-6:.1f} s")
        elif self._lost:
            told.append("track lost")
        self._refused, self._distance, self._angle = 0, 0.0, 0.0
        self._lost, self._gap_us, self._due_us = False, None, None
        return [f"motion capture: {'; '.join(told)}"]

    def _happened(self, t_us: int) -> None:
        if self._due_us is None:
            self._due_us = t_us + GATHER_US
