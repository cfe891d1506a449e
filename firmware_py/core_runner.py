"""The memory of the flight core and what executes it.

The tasks call the core through a `CoreRunner` on the memory of `CoreBlocks`: Python (compiled by numba or plain), and
under `firmware_py.export` the same core as C on this machine and as machine code of a Cortex-M4.
"""

from collections.abc import Callable
from typing import Any, ClassVar, Protocol, runtime_checkable

from firmware_py.compiling import bound
from firmware_py.config import CpuConfig
from firmware_py.core import entry
from firmware_py.core.structs import Control, Estimator, Input, Parameters, Report, Sampling, Supervisor
from firmware_py.core.subset import Block, Struct
from firmware_py.export.usage import Usage
from firmware_py.logic.loading import Logic
from firmware_py.logic.plugs import CALLS


class CoreRunner(Protocol):
    """Executes the core on the memory of `CoreBlocks`."""

    def call(self, name: str) -> int:
        """Execute an entry point of `firmware_py.core.entry`; return its result, 0 when it has none."""


@runtime_checkable
class CoreCosts(Protocol):
    """Measures how long the core's next call takes on the board's processor, on the memory as it is now."""

    @property
    def usage(self) -> Usage | None:
        """The core's use of the board so far."""

    def estimate_us(self) -> int:
        """Return the processor time of the estimator's tick."""

    def control_us(self) -> int:
        """Return the processor time of the controller's tick."""


RunnerFactory = Callable[["CoreBlocks"], CoreRunner]


class CoreBlocks:
    """The flight core's memory, shared by the tasks: each block but the parameters has one writer.

    `named` has all blocks in their order, those of own logic last; `calls` lists the blocks of each entry point.
    """

    def __init__(
        self, parameters: Block[Parameters], runner: RunnerFactory, logic: Logic | None = None
    ) -> None:
        self.parameters = parameters
        self.data = Input.allocate()  # by the estimator task; gyro: the sensors task, mode: the stabilizer
        self.estimator = Estimator.allocate()  # by the estimator task; its `now` is the stabilizer's mailbox
        self.control = Control.allocate()  # written by the stabilizer task
        self.sampling = Sampling.allocate()  # by both
        self.supervisor = Supervisor.allocate()  # by the stabilizer task, and by requests
        self.report = Report.allocate()  # by the estimator task
        self.watchdog_fed_us = 0  # by the stabilizer task
        self.logic = logic
        self.calls = CALLS if logic is None else logic.loaded.calls
        own = {} if logic is None else logic.allocate()
        core: dict[str, Block[Struct]] = {
            "parameters": parameters, "data": self.data, "estimator": self.estimator, "control": self.control,
            "sampling": self.sampling, "supervisor": self.supervisor, "report": self.report,
        }  # fmt: skip
        self.named = core | own
        self.run: CoreRunner = runner(self)

    @property
    def inputs(self) -> frozenset[str]:
        """The blocks that code outside the core writes, too."""
        return frozenset(
            name for name in self.named if name in ("parameters", "data") or name.endswith("_own")
        )


class PythonRunner:
    """Runs the Python sources: compiled by numba, or plain with NUMBA_DISABLE_JIT=1."""

    def __init__(self, blocks: CoreBlocks) -> None:
        self._blocks = blocks
        self._calls: dict[str, Callable[[], Any]] = {}

    def call(self, name: str) -> int:
        """Execute an entry point; its first call compiles it."""
        call = self._calls.get(name) or self._bind(name)
        return call() or 0

    def _bind(self, name: str) -> Callable[[], Any]:
        blocks = self._blocks
        module = entry if blocks.logic is None else blocks.logic.loaded.entry
        arguments = (blocks.named[block].arg for block in blocks.calls[name])
        return self._calls.setdefault(name, bound(getattr(module, name), *arguments))


class ConfiguredCosts:
    """The costs in the profile."""

    usage: ClassVar[None] = None

    def __init__(self, cpu: CpuConfig) -> None:
        self._cpu = cpu

    def estimate_us(self) -> int:
        return self._cpu.estimator_us

    def control_us(self) -> int:
        return self._cpu.controller_us


def costs_of(runner: CoreRunner, cpu: CpuConfig) -> CoreCosts:
    """Return the source of the costs: the runner itself if it measures them and the profile allows it."""
    return runner if cpu.measured and isinstance(runner, CoreCosts) else ConfiguredCosts(cpu)
