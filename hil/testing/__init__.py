"""Tests of user logic with pytest: the fixture `floaty`, a board without a world, and faults and paths for Hypothesis.

`floaty docs tests` shows examples. pytest finds the plugin by itself; `faults` and `trajectories` need Hypothesis and are
loaded at first use.
"""

import sys
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from hil.errors import LabError

if TYPE_CHECKING:
    from hil.testing.flights import Flights
    from hil.testing.strategies import Waypoints, faults, trajectories

__all__ = ["Flights", "Waypoints", "faults", "trajectories"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    file = "flights" if name == "Flights" else "strategies"
    if file == "strategies" and find_spec("hypothesis") is None:
        raise LabError(
            f"hil.testing.{name}: hypothesis is missing: {sys.executable} -m pip install hypothesis"
        )
    return getattr(import_module(f"hil.testing.{file}"), name)
