"""The world around the board and the bench that connects them: plant, tunnel, sensors, links, harness, experiments.

`hil.api` has the functions for users' programs, which can be imported from here: `from hil import fly`. It is loaded at
first use.
"""

# ruff: noqa: F403, F405 - the names are those of `hil.api`
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.api import *

__all__ = [
    "Along", "Experiment", "Fault", "Goal", "Kind", "Knob", "LabError", "Metric", "Request", "RigidBody", "Run", "column",
    "declare", "fault", "fly", "knob", "load_run", "position_error",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("hil.api"), name)
