"""The flight core as plain Python, beside the same core compiled: its modules, executed from their texts once more.

There the decorator `kernel` returns the function itself, so that no call inside the core reaches compiled code. Own logic's
modules keep the paths of their files, so that a debugger stops in them.
"""

import builtins
from collections.abc import Mapping, Sequence
from inspect import unwrap
from types import ModuleType, SimpleNamespace
from typing import Any

from firmware_py.core import subset
from firmware_py.export.c99 import NO_PATHS
from firmware_py.export.syntax import OWN, PACKAGE, SUBSET


class PlainModules:
    """Modules by name, executed from their texts when they are first imported; those of others are Python's own."""

    def __init__(self, texts: Mapping[str, str], files: Mapping[str, str] = NO_PATHS) -> None:
        self._texts, self._files = texts, files
        self._modules: dict[str, ModuleType] = {}
        self._builtins = vars(builtins) | {"__import__": self._import}
        plain = {"kernel": lambda function: function, "elapsed": unwrap(subset.elapsed)}
        self._subset = SimpleNamespace(**vars(subset) | plain)

    def load(self, name: str) -> ModuleType:
        """Return a module, executed once."""
        if name not in self._modules:
            module = self._modules[name] = ModuleType(name)
            module.__dict__["__builtins__"] = self._builtins
            file = self._files.get(name, f"{name}.py")
            exec(compile(self._texts[name], file, "exec"), module.__dict__)
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
