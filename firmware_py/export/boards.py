"""The boards that fly in the emulator, by what executes the flight core."""

from functools import partial

from firmware_py.config import LogicConfig
from firmware_py.core_runner import NativeRunner, RunnerFactory, default_runner
from firmware_py.export.arm_image import build_image, build_meter
from firmware_py.export.cortex_m4 import CortexM4Runner, find_emulator
from firmware_py.export.native import build
from firmware_py.logic.loading import translation_of

PYTHON, C, CORTEX_M4 = "python", "c", "cortex-m4"
BOARDS = (PYTHON, C, CORTEX_M4)


def runner_of(board: str, logic: LogicConfig) -> RunnerFactory:
    """Return the runner of the core on a board, compiled if necessary.

    Raises `ExportError`, and `LogicError` as `load_logic` does.
    """
    if board == PYTHON:
        return default_runner
    if board == CORTEX_M4:
        find_emulator()
    core = translation_of(logic)
    if board == C:
        return partial(NativeRunner, library=build(core))
    image = build_image(core.source, core.header)
    return partial(CortexM4Runner, image=image, meter=build_meter())
