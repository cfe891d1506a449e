"""Why a pose is not used at the station: the reasons, their counters, and their lines for the user.

Lines are gathered for half a second, so that one has all of them, and a reason is repeated as a `Throttle` admits. The
reasons are also in the documentation: `docs/reference/poses.md`.
"""

from collections import Counter
from enum import Enum
from math import sqrt

from ground_station.throttle import Throttle

GATHER_US = 500_000
MINOR = 0.1  # a reason of a smaller share of the unused poses has no part in the line
VOLUME = 50.0  # [m] sum of the coordinates: no cameras follow a robot further from the tunnel's centre
MILLI = 1000.0


class Reason(Enum):
    """A word for the counter, and the line after the number of poses: its braces are the values seen."""

    TRACK_BEGINS = "track begins", ""  # the first two of three, without a line
    NOT_TRACKED = "not tracked", "missing: the body is not tracked"
    ABSENT = "absent", "missing: the body is not in the frames"
    FROZEN = "frozen", "unusable: the system repeats one pose"
    MISTIMED = "mistimed", "unusable: {:.1f} s old at their arrival: at most 1 s"
    NOT_A_NUMBER = "not a number", "unusable: a coordinate is not a number"
    QUATERNION = "quaternion", "unusable: a quaternion of length {:.2f}, not 1"
    MILLIMETRES = (
        "millimetres",
        f"unusable: at {{:.2f}} {{:.2f}} {{:.2f}} m, outside {VOLUME:g} m: millimetres for metres?",
    )
    OUTSIDE = "outside", f"unusable: at {{:.2f}} {{:.2f}} {{:.2f}} m, out of the volume of {VOLUME:g} m"
    REPEATED = "repeated", "unusable: exposed at {:.3f} s like the one before: does the frames' clock stand?"
    LATE = "late", "unusable: {:.0f} ms behind a newer one"
    DEVIATES = "off the prediction", "refused, up to {:.2f} m and {:.0f} deg from the prediction"
    SCATTERED = (
        "scattered",
        "unusable: up to {:.2f} m and {:.0f} deg from one to the next, too far for a track",
    )
    PLACES = "places alternate", "unusable: places alternate, {:.2f} m and {:.0f} deg apart: two bodies?"
    ORIENTATIONS = (
        "orientations alternate",
        "unusable: orientations alternate, {1:.0f} deg apart: two bodies?",
    )

    def __init__(self, word: str, line: str) -> None:
        self.word = word
        self.line = line


# The largest values of these are shown, the latest of others. The first is reported every half second.
_LARGEST = (Reason.DEVIATES, Reason.SCATTERED, Reason.LATE)

Values = tuple[float, ...]
Unused = tuple[Reason, Values]  # of one frame


class Event(Enum):
    """A change of the track."""

    NONE = 0
    LOST = 1
    RESTARTED = 2


def flaw(p_WB: tuple[float, float, float], q_WB: tuple[float, float, float, float]) -> Unused | None:
    """Return what makes these numbers no pose of the robot, None if they are one."""
    x, y, z = p_WB
    a, b, c, d = q_WB
    place, square = abs(x) + abs(y) + abs(z), a * a + b * b + c * c + d * d
    if place < VOLUME and abs(square - 1.0) < 0.02:
        return None
    if place != place or square != square:
        return Reason.NOT_A_NUMBER, ()
    if place < VOLUME:
        return Reason.QUATERNION, (sqrt(square),)
    return Reason.MILLIMETRES if place < MILLI * VOLUME else Reason.OUTSIDE, p_WB


class UnusedPoses:
    """Takes every frame's reason, or None; the times are of arrivals at the station."""

    def __init__(self) -> None:
        self.counts: Counter[Reason] = Counter()  # in total
        self._gathered: Counter[Reason] = Counter()
        self._values: dict[Reason, Values] = {}
        self._throttle = Throttle()
        self._now_us = 0
        self._due_us: int | None = None
        self._some_used = False  # since the first of those gathered
        self._lost = False
        self._restarted = ""
        self._used_us: tuple[int, int] | None = None  # arrival and exposure of the last used pose

    def note(self, now_us: int, exposed_us: int, unused: Unused | None, event: Event = Event.NONE) -> None:
        """Note a frame that arrives now."""
        self._now_us = now_us
        if event is not Event.NONE:
            self._on_event(event, exposed_us)
        if unused is None:
            self._used_us = now_us, exposed_us
            self._some_used = True
            return
        reason, values = unused
        self.counts[reason] += 1
        if self._due_us is None:
            self._begin()
        before = self._values.get(reason) if reason in _LARGEST and reason in self._gathered else None
        self._values[reason] = values if before is None else tuple(map(max, values, before))
        self._gathered[reason] += 1

    def due(self) -> list[str]:
        """Return at most one line, by the time of the last frame."""
        if self._due_us is None or self._now_us < self._due_us:
            return []
        parts = [*self._reasons(), *([self._restarted] if self._restarted else ["track lost"] * self._lost)]
        self._gathered.clear()
        self._due_us, self._lost, self._restarted = None, False, ""
        return [f"motion capture: {'; '.join(parts)}"] if parts else []

    def summary(self) -> str:
        """Return how many are unusable, and why."""
        reasons = [f"{count} {reason.word}" for reason, count in self.counts.most_common()]
        return f"{self.counts.total()} unusable" + (f": {', '.join(reasons)}" if reasons else "")

    def _begin(self) -> None:
        self._due_us = self._now_us + GATHER_US
        self._some_used = False

    def _on_event(self, event: Event, exposed_us: int) -> None:
        if self._due_us is None:
            self._begin()
        if event is Event.LOST:
            self._lost = True
        elif self._used_us is not None:
            gap_us = self._now_us - self._used_us[0]
            jump_us = exposed_us - self._used_us[1] - gap_us
            self._restarted = f"track restarted after {gap_us * 1e-6:.1f} s"
            if abs(jump_us) > GATHER_US:
                way = "back" if jump_us < 0 else "forward"
                self._restarted += f": the frames' clock jumped {way} by {abs(jump_us) * 1e-6:.1f} s"

    def _reasons(self) -> list[str]:
        """Return the parts of the line for what was gathered."""
        least = MINOR * self._gathered.total()
        parts = []
        for reason, count in self._gathered.most_common():
            ordinary = reason is Reason.NOT_TRACKED and self._some_used
            if not reason.line or count < least or ordinary:
                continue
            if reason is not Reason.DEVIATES and not self._throttle.admits(reason, self._now_us):
                continue
            poses = "1 pose" if count == 1 else f"{count} poses"
            parts.append(f"{poses} {reason.line.format(*self._values[reason])}")
        return parts
