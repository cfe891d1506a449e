"""The world around the board and the bench that connects them: plant, tunnel, sensors, links, harness, experiments.

`hil.api` has the functions for users' programs, which can be imported from here: `from hil import fly`. It is loaded at
first use.
"""

# ruff: noqa: F403, F405 - the names are those of `hil.api`
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.api import *

__all__ = [
    "Along", "Experiment", "Fault", "Goal", "Kind", "Knob", "LabError", "Metric", "Request", "RigidBody", "Run", "Swarm",
    "column", "declare", "fault", "fly", "fly_swarm", "knob", "load_run", "position_error",
]  # fmt: skip


MOVED = {  # former rooms by the wing where they are now
    "board": ("devices", "clock"),
    "emulator": ("stm32f405", "crazyflie", "events"),
    "laboratory": ("arguments", "bodies", "experiments"),
    "laboratory.files": ("installation", "own_files", "whole_files"),
    "pictures": ("exports",),
    "pictures.exports": ("demonstrations",),
    "research": ("campaigns", "design", "identify", "learn", "studies"),
    "world": ("floaty", "scene"),
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("hil.api"), name)


def __dir__() -> list[str]:
    return sorted(__all__)


class _Moved:
    """Refuses the import of a module that has moved, and names its new place."""

    @staticmethod
    def find_spec(name: str, _path: object = None, _target: object = None) -> None:
        if not name.startswith("hil."):  # asked for every import of the process
            return
        room, _, rest = name.removeprefix("hil.").partition(".")
        for wing, rooms in MOVED.items():
            if room in rooms:
                now = ".".join(filter(None, ("hil", wing, room * (room != "devices"), rest)))
                raise ModuleNotFoundError(f"{name} is {now} now", name=name)


sys.meta_path.insert(0, _Moved)  # first: a room that was left empty would be found as a package
