"""The tracker's notices for the user: one line for all events within half a second."""

from dataclasses import dataclass
from math import degrees

GATHER_US = 500_000


@dataclass(slots=True)
class TrackNotices:
    """Collects events until a line is due; times are those of frames."""

    _refused: int = 0
    _distance: float = 0.0  # the largest [m]
    _angle: float = 0.0  # [rad]
    _lost: bool = False
    _gap_us: int | None = None  # before a track that began again
    _due_us: int | None = None

    def refused(self, t_us: int, distance: float, angle: float) -> None:
        """A pose was refused at this distance from the prediction [m, rad]."""
        self._refused += 1
        self._distance = max(self._distance, distance)
        self._angle = max(self._angle, angle)
        self._happened(t_us)

    def lost(self, t_us: int) -> None:
        """The track was lost."""
        self._lost = True
        self._happened(t_us)

    def begun_again(self, t_us: int, gap_us: int) -> None:
        """A new track began `gap_us` after the last good pose."""
        self._gap_us = gap_us
        self._happened(t_us)

    def due(self, t_us: int) -> list[str]:
        """At most one line, by a clock that may jump."""
        if self._due_us is None or 0 < self._due_us - t_us <= GATHER_US:
            return []
        notices = []
        if self._refused:
            poses = "1 pose" if self._refused == 1 else f"{self._refused} poses"
            notices.append(
                f"{poses} refused, up to {self._distance:.2f} m and {degrees(self._angle):.0f} deg from the prediction"
            )
        if self._gap_us is not None:
            notices.append(f"track begun again after {self._gap_us * 1e-6:.1f} s")
        elif self._lost:
            notices.append("track lost")
        self._refused, self._distance, self._angle = 0, 0.0, 0.0
        self._lost, self._gap_us, self._due_us = False, None, None
        return [f"motion capture: {'; '.join(notices)}"]

    def _happened(self, t_us: int) -> None:
        if self._due_us is None:
            self._due_us = t_us + GATHER_US
