"""The implementations of the flight core that `floaty deploy check` can put beside the one that flies."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from firmware_py.core_runner import CoreBlocks, CoreRunner, RunnerFactory
from firmware_py.export.plain import PlainRunner
from hil.errors import LabError

PLAIN, C_O0, C_O2, CORTEX_M4 = TARGETS = ("plain", "c-O0", "c-O2", "cortex-m4")


def target_names(text: str | None) -> tuple[str, ...]:
    """Return the targets that a comma-separated text names; None: all. Raises `LabError`."""
    if text is None:
        return TARGETS
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in names:
        if name not in TARGETS:
            raise LabError(f"--targets {text}: {name!r} is none of {', '.join(TARGETS)}")
    return names


class Toolbox:
    """Builds what targets need, once; `source` replaces the exported C."""

    def __init__(self, names: Sequence[str], source: Path | None) -> None:
        self._names = names

    def factories(self, stack: ExitStack) -> dict[str, RunnerFactory]:
        """Return how to make the targets' runners, which end with the stack."""

        def plain(blocks: CoreBlocks) -> CoreRunner:
            runner = PlainRunner(blocks)
            stack.callback(runner.close)
            return runner

        factories: dict[str, RunnerFactory] = {}
        if PLAIN in self._names:
            factories[PLAIN] = plain
        return factories
