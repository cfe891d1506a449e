"""The implementations of the flight core that `floaty deploy check` can compare with the flying one."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from firmware_py.config import LogicConfig
from firmware_py.core_runner import CoreBlocks, CoreRunner, NativeRunner, PlainRunner, RunnerFactory
from firmware_py.export.arm_image import CoreImage, build_image, read_image
from firmware_py.export.errors import ExportError
from firmware_py.export.native import build
from firmware_py.export.usage import EntryLoad
from firmware_py.logic.loading import translation_of
from hil.board.cores.cortex_m4 import CortexM4Runner
from hil.board.real_core import RealCore, is_link, open_real_core
from hil.emulator.stm32f405.chip import build_machine
from hil.errors import LabError

PLAIN, C_O0, C_O2, CORTEX_M4 = TARGETS = ("plain", "c-O0", "c-O2", "cortex-m4")
Loads = dict[str, EntryLoad]  # by entry point
OPTIMISATION = {C_O0: "-O0", C_O2: "-O2"}
TICK_HZ = 100


def target_names(text: str | None) -> tuple[str, ...]:
    """Return the targets in a comma-separated text, real boards by their links; None: all but boards.

    Raises `LabError`.
    """
    if text is None:
        return TARGETS
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in names:
        if name not in TARGETS and not is_link(name):
            allowed = ", ".join(TARGETS)
            raise LabError(f"--targets {text}: {name!r} is none of {allowed}, and no link to a board")
    return names


class Metered(CortexM4Runner):
    """Machine code with counted ticks: each has poses, the estimator and the controller."""

    def __init__(self, blocks: CoreBlocks, image: CoreImage, machine: Path, ticks: EntryLoad) -> None:
        super().__init__(blocks, image, machine)
        self._ticks = ticks
        self._so_far: tuple[int, int] | None = None  # instructions, cycles at the last tick's end; None: boot

    def call(self, name: str) -> int:
        """Execute an entry point; the controller's ends a tick."""
        answer = super().call(name)
        if name != "control":
            return answer
        loads = self.load.values()
        now = sum(load.instructions for load in loads), sum(load.cycles for load in loads)
        if self._so_far is not None:
            self._ticks.add(now[0] - self._so_far[0], now[1] - self._so_far[1])
        self._so_far = now
        return answer


@dataclass(slots=True)
class MachineCode:
    """The machine code's use of the board over all flights of a check: memory, and processor time per tick."""

    flash_bytes: int | None  # None: part of a firmware
    ticks: EntryLoad
    entries: Loads = field(default_factory=dict)
    ram_bytes: int = 0
    stack_bytes: int = 0

    @property
    def loads(self) -> tuple[float, float]:
        """The processor load of the mean and the worst tick."""
        return self.ticks.mean_us * 1e-6 * TICK_HZ, self.ticks.worst_us * 1e-6 * TICK_HZ


class Toolbox:
    """Builds what the targets need, once.

    `logic` is the user's logic, `source` the text of a floaty_core.c that replaces the exported one, `elf` a linked
    firmware whose core is the machine code.

    Raises `LabError` for a missing compiler or package and for C that does not compile.
    """

    def __init__(
        self, names: Sequence[str], logic: LogicConfig, source: str | None = None, elf: Path | None = None
    ) -> None:
        self.machine_code: MachineCode | None = None
        self.boards: dict[str, Loads] = {name: {} for name in names if is_link(name)}  # board measurements
        self._native: dict[str, RunnerFactory] = {}
        self._names = names
        if elf and CORTEX_M4 not in names:
            raise LabError(f"--elf {elf}: nothing to check it with: --targets has no {CORTEX_M4}")
        try:
            c = translation_of(logic)
            c = c if source is None else replace(c, source=source)
            for name in names:
                if name in OPTIMISATION:
                    library = build(c, optimisation=OPTIMISATION[name])
                    self._native[name] = partial(NativeRunner, library=library)
                elif name == CORTEX_M4:
                    self._machine = build_machine()
                    self._image = read_image(elf, False) if elf else build_image(c.source, c.header)
                    flash = None if elf else len(self._image.code)
                    self.machine_code = MachineCode(flash, EntryLoad())
        except ExportError as error:
            raise LabError(str(error)) from None

    def factories(self, stack: ExitStack) -> dict[str, RunnerFactory]:
        """Return functions that make the targets' runners, which end with the stack."""

        def cortex_m4(blocks: CoreBlocks) -> CoreRunner:
            assert self.machine_code is not None
            runner = Metered(blocks, self._image, self._machine, self.machine_code.ticks)
            stack.callback(self._measure, runner)
            return runner

        def board(uri: str) -> RunnerFactory:
            client = open_real_core(uri, "--targets", stack)

            def runner_of(blocks: CoreBlocks) -> CoreRunner:
                runner = RealCore(blocks, client)
                stack.callback(add_loads, self.boards[uri], runner.load)
                return runner

            return runner_of

        factories = {**self._native, PLAIN: PlainRunner, CORTEX_M4: cortex_m4}
        return {name: board(name) if is_link(name) else factories[name] for name in self._names}

    def _measure(self, runner: Metered) -> None:
        """Record a flight's memory use."""
        assert self.machine_code is not None
        self.machine_code.ram_bytes = runner.ram_bytes
        self.machine_code.stack_bytes = max(self.machine_code.stack_bytes, runner.stack_bytes)
        add_loads(self.machine_code.entries, runner.load)


def add_loads(total: Loads, flight: Loads) -> None:
    for name, load in flight.items():
        total.setdefault(name, EntryLoad()).merge(load)
