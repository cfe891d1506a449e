"""Measures a learned law as machine code of the Cortex-M4: processor time, memory, and the error from its policy.

Cycles are those of `hil/board/cores/cortex_m4.py` for one step of the controller. The weights are read from flash, for
which five cycles are added per line of 16 bytes: the emulator counts the waits for instructions only.
"""

from dataclasses import dataclass

import numpy as np

from firmware_py.config import FirmwareConfig, parameters_of
from firmware_py.core.budget import CALL_CYCLES
from firmware_py.core.observation import OBSERVATIONS
from firmware_py.core.structs import MODE_FLY, STATES
from firmware_py.core_runner import CoreBlocks, CoreCosts, RunnerFactory
from firmware_py.export.arm_image import build_image
from firmware_py.export.c99 import translate
from firmware_py.export.usage import CLOCK_MHZ
from firmware_py.logic.loading import load_logic
from firmware_py.policy.reading import Policy

CALLS = 32
# The largest position [m], velocity [m/s], attitude [rad], rate [rad/s] and flap deviation [rad] of a call's estimate.
REACH = np.repeat([0.3, 0.5, 0.3, 2.0, 0.4], (3, 3, 3, 3, 4))
GOLDEN = 0.6180339887498949  # its multiples modulo 1 fill the interval evenly
LINE_BYTES, WAIT_STATES = 16, 5  # of the flash of an STM32F405 at 168 MHz


@dataclass(frozen=True, slots=True)
class LawFigures:
    """The law's use of the board, and its largest difference from the policy's actions."""

    cycles: int  # of the longest call
    flash_bytes: int  # more than the default core
    ram_bytes: int  # likewise
    difference: float

    @property
    def share(self) -> float:
        """The share of its control slot that a call takes."""
        return self.cycles / CALL_CYCLES

    def __str__(self) -> str:
        time = f"{self.cycles} cycles per call ({self.cycles / CLOCK_MHZ:.0f} us of a Cortex-M4)"
        slot = f"{self.share:.0%} of its control slot of {CALL_CYCLES}"
        return f"{time}, {slot}; flash {self.flash_bytes} B, RAM {self.ram_bytes} B"


def measure(config: FirmwareConfig, policy: Policy, runner: RunnerFactory) -> LawFigures:
    """Call the law of a profile, with a runner that measures, on states all over the flight envelope.

    Raises `ExportError` when the compiler is missing.
    """
    core = translate()
    default = build_image(core.source, core.header)
    blocks = CoreBlocks(parameters_of(config), runner, load_logic(config.logic))
    assert isinstance(blocks.run, CoreCosts)
    memory = blocks.named["controller_memory"].memory
    blocks.data.fields.mode = np.int32(MODE_FLY)
    observations, actions = np.empty((CALLS, OBSERVATIONS), np.float32), np.empty((CALLS, 4), np.float32)
    for call in range(CALLS):
        steps = call * STATES + np.arange(1, STATES + 1)
        blocks.estimator.fields.now[:] = REACH * (2 * (steps * GOLDEN % 1) - 1)
        blocks.run.call("control")
        observations[call], actions[call] = memory["observation"][0], memory["action"][0]
    expected = np.clip(policy.answer(observations), -1, 1)
    lines = -(-4 * policy.numbers // LINE_BYTES)
    own = [
        block.memory.nbytes for name, block in blocks.named.items() if name in ("controller_memory", "guard")
    ]
    usage = blocks.run.usage
    assert usage is not None
    assert usage.flash_bytes is not None
    return LawFigures(
        usage.entries["control"].worst_cycles + WAIT_STATES * lines,
        usage.flash_bytes - len(default.code),
        sum(own),
        float(np.abs(actions - expected).max()),
    )
