"""The memory of the flight core and what executes it.

The tasks call the core through a `CoreRunner` on the memory of `CoreBlocks`: Python (compiled by numba or plain), and
under `firmware_py.export` the same core as C on this machine and as machine code of a Cortex-M4.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from firmware_py.config import CpuConfig
from firmware_py.core import entry
from firmware_py.core.structs import Control, Estimator, Input, Parameters
from firmware_py.core.subset import Block, Struct
from firmware_py.logic.plugs import CALLS

if TYPE_CHECKING:
    from firmware_py.core.guard import Guard
    from firmware_py.logic.loading import Logic


class CoreRunner(Protocol):
    """Executes the core's entry points on the memory of `CoreBlocks`."""

    def reset(self) -> None:
        """Start the estimator."""

    def file_pose(self) -> int:
        """File the input's pose; returns POSE_ON_TIME, POSE_TOO_OLD or POSE_INVALID."""

    def estimate(self) -> None:
        """Run one tick of the estimator."""

    def control(self) -> None:
        """Run one tick of the controller, down to the timer counts."""


@runtime_checkable
class CoreCosts(Protocol):
    """States how long the core's next call takes on the board's processor, on the memory as it is now."""

    def estimate_us(self) -> int:
        """Return the processor time of the estimator's tick."""

    def control_us(self) -> int:
        """Return the processor time of the controller's tick."""


RunnerFactory = Callable[["CoreBlocks"], CoreRunner]


class CoreBlocks:
    """The memory of the flight core, as the tasks share it: each block has one writer but the parameters.

    `named` has all blocks in their order, those of own logic last; `calls` says which of them each entry point takes.
    """

    __slots__ = (
        "calls",
        "control",
        "data",
        "estimator",
        "guard",
        "logic",
        "named",
        "parameters",
        "run",
        "watchdog_fed_us",
    )

    def __init__(
        self, parameters: Block[Parameters], runner: RunnerFactory, logic: "Logic | None" = None
    ) -> None:
        self.parameters = parameters
        self.data = Input.allocate()  # written by the estimator task, but for the mode: the stabilizer
        self.estimator = Estimator.allocate()  # by the estimator task; its `now` is the stabilizer's mailbox
        self.control = Control.allocate()  # written by the stabilizer task
        self.watchdog_fed_us = 0  # by the stabilizer task
        self.logic = logic
        self.calls = CALLS if logic is None else logic.loaded.calls
        own = {} if logic is None else logic.allocate()
        self.guard: Guard | None = own["guard"].fields if own else None  # type: ignore[assignment]
        core: dict[str, Block[Struct]] = {
            "parameters": parameters, "data": self.data, "estimator": self.estimator, "control": self.control,
        }  # fmt: skip
        self.named = core | own
        self.run: CoreRunner = runner(self)

    @property
    def inputs(self) -> tuple[Block[Struct], ...]:
        """The blocks that the core only reads."""
        return tuple(
            block
            for name, block in self.named.items()
            if name in ("parameters", "data") or name.endswith("_own")
        )


class PythonRunner:
    """Runs the Python sources: compiled by numba, or plain with NUMBA_DISABLE_JIT=1."""

    __slots__ = ("_arguments", "_entry")

    def __init__(self, blocks: CoreBlocks) -> None:
        self._entry: Any = entry if blocks.logic is None else blocks.logic.loaded.entry
        self._arguments = {
            call: tuple(blocks.named[name].arg for name in names) for call, names in blocks.calls.items()
        }

    def reset(self) -> None:
        """Start the estimator."""
        self._entry.reset(*self._arguments["reset"])

    def file_pose(self) -> int:
        """File the input's pose."""
        return int(self._entry.file_pose(*self._arguments["file_pose"]))

    def estimate(self) -> None:
        """Run one tick of the estimator."""
        self._entry.estimate(*self._arguments["estimate"])

    def control(self) -> None:
        """Run one tick of the controller."""
        self._entry.control(*self._arguments["control"])


class ConfiguredCosts:
    """What the profile states."""

    __slots__ = ("_cpu",)

    def __init__(self, cpu: CpuConfig) -> None:
        self._cpu = cpu

    def estimate_us(self) -> int:
        """Return the estimator's figure."""
        return self._cpu.estimator_us

    def control_us(self) -> int:
        """Return the controller's figure."""
        return self._cpu.controller_us


def costs_of(runner: CoreRunner, cpu: CpuConfig) -> CoreCosts:
    """Return the source of the costs: the runner itself if it measures them and the profile allows it."""
    return runner if cpu.measured and isinstance(runner, CoreCosts) else ConfiguredCosts(cpu)
