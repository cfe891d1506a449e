"""Tests of user logic with pytest: the fixture `floaty`, a board without a world, and faults and paths for Hypothesis.

`docs/howto/tests.md` has examples. pytest finds the plugin by itself; `faults` and `trajectories` need Hypothesis and are
loaded at first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.testing.flights import Flights
    from hil.testing.strategies import Waypoints, faults, trajectories

__all__ = ["Flights", "Waypoints", "faults", "trajectories"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    file = "flights" if name == "Flights" else "strategies"
    return getattr(import_module(f"hil.testing.{file}"), name)
