"""A robustness study: one axis of sizes, several variants, and the expected outcome of each.

Sizes are listed from harmless to harmful; "up to" and "from" refer to that order.
"""

from collections.abc import Callable
from dataclasses import dataclass

from hil.config import DEFAULT_PROFILE


@dataclass(frozen=True, slots=True)
class Change:
    """The change for a size: settings `section.key=value` and faults, as on the command line."""

    settings: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Expected:
    """The expected outcome of a variant, by size; None: not stated."""

    holds_to: float | None = None  # every seed holds the experiment's limits up to this size
    flies_to: float | None = None  # no seed is lost up to this size
    # From this size on the supervisor opens the loop or the robot is lost.
    failsafe_from: float | None = None
    lost_from: float | None = None  # every seed is lost from this size on

    def text(self, unit: str) -> str:
        """Return the expectation as a sentence."""
        parts = (
            ("holds the limits up to", self.holds_to),
            ("is not lost up to", self.flies_to),
            ("is stopped by the supervisor from", self.failsafe_from),
            ("is lost from", self.lost_from),
        )
        return ", ".join(f"{words} {size:g} {unit}".strip() for words, size in parts if size is not None)


@dataclass(frozen=True, slots=True)
class Variant:
    name: str
    change: Callable[[float], Change]
    expected: Expected
    profile: str = DEFAULT_PROFILE
    settings: tuple[str, ...] = ()  # besides those of the size


@dataclass(frozen=True, slots=True)
class Study:
    """One axis, several variants."""

    name: str
    question: str
    axis: str  # meaning of the sizes
    unit: str
    sizes: tuple[float, ...]
    variants: tuple[Variant, ...]
    duration_s: float = 8.0
    experiment: str = "hover"
    remark: str = ""  # explains the picture
