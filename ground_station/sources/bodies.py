"""Which of the bodies that a motion capture system sees is the robot."""

from collections.abc import Sequence

from ground_station.errors import MocapError


def choose_body(wanted: str, names: Sequence[str]) -> str:
    """The name of the body to follow, out of those there are; `MocapError` when it is not clear which."""
    if wanted in names:
        return wanted
    if not wanted and len(names) == 1:
        return names[0]
    what = f"no body {wanted!r}" if wanted else "body=NAME is missing"
    raise MocapError(f"{what}; there are: {', '.join(names) or 'none'}")
