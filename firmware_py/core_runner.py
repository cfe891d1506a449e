"""The memory of the flight core and what executes it.

The tasks call the core through a `CoreRunner` on the memory of `CoreBlocks`: the C that is flashed, compiled for this
machine; under `firmware_py.export` also its plain Python, and machine code of a Cortex-M4.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol, runtime_checkable

from firmware_py import core, export, logic
from firmware_py.compiling import PLAIN, SUFFIX, as_python, bound_in, fall_back, hash_of, kept_library
from firmware_py.config import CpuConfig
from firmware_py.core import entry
from firmware_py.core.structs import Control, Estimator, Input, Parameters, Report, Sampling, Supervisor
from firmware_py.core.subset import Block, F32s, Struct
from firmware_py.export.errors import CompilerError
from firmware_py.export.methods import METHOD
from firmware_py.export.usage import Usage
from firmware_py.kept_code import kept_folder, report
from firmware_py.logic.loading import Logic, sensed_by
from firmware_py.logic.plugs import CALLS

if TYPE_CHECKING:
    from firmware_py.export.compilers import Compiler

SOURCES = tuple(Path(package.__path__[0]) for package in (core, export, logic))


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
        self.logic = logic
        self.calls = CALLS if logic is None else logic.loaded.calls
        own = {} if logic is None else logic.allocate()
        core: dict[str, Block[Struct]] = {
            "parameters": parameters, "data": self.data, "estimator": self.estimator, "control": self.control,
            "sampling": self.sampling, "supervisor": self.supervisor, "report": self.report,
        }  # fmt: skip
        self.named = core | own
        self.sensed: Mapping[str, F32s] = {}  # what own logic sees of the robot's own sensors, by name
        self._fields = [(own[field.block].memory[field.name], field.name) for field in sensed_by(logic)]
        self.run: CoreRunner = runner(self)

    def entry(self, name: str) -> Callable[[], int]:
        """Return the call of an entry point."""
        return self.run.calls[name] if type(self.run) is NativeRunner else partial(self.run.call, name)

    @property
    def inputs(self) -> frozenset[str]:
        """The blocks that code outside the core writes, too."""
        return frozenset(
            name
            for name in self.named
            if name in ("parameters", "data") or name.endswith(("_own", "_sensed"))
        )

    def sense(self, samples: Mapping[str, F32s]) -> None:
        """Let own logic see these samples of the robot's own sensors."""
        self.sensed = {name: sample.copy() for name, sample in samples.items()}
        for memory, name in self._fields:
            memory[:] = samples[name]


class NativeRunner:
    """Runs the core as C on the blocks' memory.

    `library` is one of `firmware_py.export.native.build`; None: that of all flights. Raises `CompilerError` where no C
    compiler works.
    """

    def __init__(self, blocks: CoreBlocks, library: Path | None = None) -> None:
        library = library or core_library(blocks.logic)
        self.calls = {
            name: bound_in(library, METHOD + name, *(blocks.named[block].memory for block in taken))
            for name, taken in blocks.calls.items()
        }

    def call(self, name: str) -> int:
        return self.calls[name]()  # type: ignore[no-any-return]


class PlainRunner:
    """Runs the core's Python sources."""

    def __init__(self, blocks: CoreBlocks) -> None:
        module = entry if blocks.logic is None else blocks.logic.loaded.entry
        self._calls = {
            name: as_python(getattr(module, name), *(blocks.named[block].fields for block in taken))
            for name, taken in blocks.calls.items()
        }

    def call(self, name: str) -> int:
        """Execute an entry point."""
        return int(self._calls[name]() or 0)


def default_runner(blocks: CoreBlocks) -> CoreRunner:
    """Return the runner of all flights: the C; plain Python for a debugger, and where no C compiler works."""
    if not PLAIN:
        try:
            return NativeRunner(blocks)
        except (CompilerError, OSError) as error:
            fall_back(str(error))
    return PlainRunner(blocks)


def core_library(logic: Logic | None) -> Path:
    """Return the core's library for this machine, with own logic in it. Raises `CompilerError`."""
    folder = kept_folder("kernels", hash_of(*SOURCES) + (logic.loaded.digest if logic else ""))
    return kept_library(folder / f"core{SUFFIX}", partial(_compile, logic))


def _compile(logic: Logic | None) -> Path:
    from firmware_py.export.c99 import translate  # not needed where a library is kept
    from firmware_py.export.compilers import by_first_that_works
    from firmware_py.export.native import build

    text = translate() if logic is None else logic.loaded.translation

    def make(compiler: "Compiler") -> Path:
        if logic is not None:
            report(f"compiling {', '.join(Path(file).name for file in logic.loaded.files.values())}")
        return build(text, compiler)

    return by_first_that_works(make)


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
