"""The boards that fly in the emulator, by what executes the flight core."""

from functools import partial

from firmware_py.config import LogicConfig
from firmware_py.core_runner import PlainRunner, RunnerFactory, default_runner
from firmware_py.logic.loading import translation_of

C, PYTHON, CORTEX_M4 = BOARDS = "c", "python", "cortex-m4"  # the first one is usual


def runner_of(board: str, logic: LogicConfig) -> RunnerFactory:
    """Return the runner of the core on a board, compiled if necessary.

    Raises `ExportError`, and `LogicError` as `load_logic` does.
    """
    if board == C:
        return default_runner
    if board == PYTHON:
        return PlainRunner
    from firmware_py.export.arm_image import build_image
    from hil.board.cores.cortex_m4 import CortexM4Runner
    from hil.emulator.stm32f405.chip import build_machine

    machine, core = build_machine(), translation_of(logic)
    return partial(CortexM4Runner, image=build_image(core.source, core.header), machine=machine)
