"""The flight core as plain Python, beside the same core compiled: its modules, executed from their texts once more.

There the decorator `kernel` returns the function itself, so that no call inside the core reaches numba.
"""

import builtins
from collections.abc import Mapping, Sequence
from functools import partial
from inspect import unwrap
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from firmware_py.core import subset
from firmware_py.core_runner import CoreBlocks
from firmware_py.export.c99 import core_texts
from firmware_py.export.syntax import ENTRY, OWN, PACKAGE, SUBSET


class PlainRunner:
    """Runs the core's Python sources without numba."""

    def __init__(self, blocks: CoreBlocks) -> None:
        entry = PlainModules(core_texts() if blocks.logic is None else blocks.logic.loaded.texts).load(ENTRY)
        self._calls = {
            name: partial(getattr(entry, name), *(blocks.named[block].fields for block in taken))
            for name, taken in blocks.calls.items()
        }

    def call(self, name: str) -> int:
        """Execute an entry point."""
        with np.errstate(all="ignore"):  # the comparison deals with infinities and NaN
            return int(self._calls[name]() or 0)


class PlainModules:
    """Modules by name, executed from their texts when they are first imported; those of others are Python's own."""

    def __init__(self, texts: Mapping[str, str]) -> None:
        self._texts = texts
        self._modules: dict[str, ModuleType] = {}
        self._builtins = vars(builtins) | {"__import__": self._import}
        plain = {"kernel": lambda function: function, "elapsed": unwrap(subset.elapsed)}
        self._subset = SimpleNamespace(**vars(subset) | plain)

    def load(self, name: str) -> ModuleType:
        """Return a module, executed once."""
        if name not in self._modules:
            module = self._modules[name] = ModuleType(name)
            module.__dict__["__builtins__"] = self._builtins
            exec(compile(self._texts[name], f"{name}.py", "exec"), module.__dict__)
        return self._modules[name]

    def _import(self, name: str, scope: Any, local: Any, wanted: Sequence[str], level: int) -> Any:
        """Do what `from name import wanted` needs."""
        if name == SUBSET:
            return self._subset
        if name in (PACKAGE, OWN):
            return SimpleNamespace(**{module: self.load(module) for module in wanted})
        if name.startswith(f"{PACKAGE}."):
            return self.load(name.removeprefix(f"{PACKAGE}."))
        return __import__(name, scope, local, wanted, level)
