"""The figures of a learned law, from a runner whose cycles and sizes are chosen."""

from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pytest

from firmware_py.core.budget import CALL_CYCLES
from firmware_py.core.structs import MODE_FLY
from firmware_py.core_runner import PlainRunner
from firmware_py.export.usage import EntryLoad, Usage
from firmware_py.policy import measuring
from support.own_logic import own_config

LAW = '''"""Five times the first four observations less half of the previous action."""

from typing import Annotated

from firmware_py.core.guard import allocate
from firmware_py.core.observation import ACTIONS, act, observe
from firmware_py.core.structs import Control, Estimator, Parameters
from firmware_py.core.subset import F32s, Struct, f32, kernel


class Memory(Struct):
    action: Annotated[F32s, 4]
    observation: Annotated[F32s, 20]


@kernel
def reset_law(memory: Memory) -> None:
    for i in range(ACTIONS):
        memory.action[i] = f32(0.0)


@kernel
def control_law(parameters: Parameters, estimator: Estimator, control: Control, memory: Memory) -> None:
    observe(parameters, estimator, memory.action, memory.observation)
    for i in range(ACTIONS):
        memory.action[i] = f32(5.0) * memory.observation[i] - f32(0.5) * memory.observation[16 + i]
    act(parameters, memory.action, control)
    allocate(parameters, control)
'''


class Measured(PlainRunner):
    """Runs the core's Python; its calls take 1000, 1001, ... cycles, but the third one more than all."""

    def __init__(self, blocks: Any) -> None:
        super().__init__(blocks)
        self.blocks, self.load, self.states = blocks, EntryLoad(), []

    @property
    def usage(self) -> Usage:
        return Usage(
            20_500, 4_000, None, {"control": self.load, "estimate": EntryLoad(1, 9, 10**6, 9, 10**6)}
        )

    def estimate_us(self) -> int:
        raise AssertionError("the estimator is not called")

    control_us = estimate_us

    def call(self, name: str) -> int:
        assert (name, self.blocks.data.fields.mode) == ("control", MODE_FLY)
        self.states.append(self.blocks.estimator.fields.now.copy())
        self.load.add(1, 1000 + len(self.states) + 5000 * (len(self.states) == 3))
        return super().call(name)


def test_a_law_s_figures_are_of_its_longest_call_its_own_memory_and_its_worst_action(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The policy answers as the law, but for one action of one call; its 41 constants fill 11 lines of flash."""
    made, asked = [], []
    monkeypatch.setattr(measuring, "build_image", lambda source, header: Made(code=bytes(20_000)))

    def answer(observations: Any) -> Any:
        asked.append(observations.copy())
        actions = 5.0 * observations[:, :4] - 0.5 * observations[:, 16:]
        actions[7, 2] = np.clip(actions[7, 2], -1, 1) - np.sign(actions[7, 2]) * 0.25
        return actions

    def runner(blocks: Any) -> Measured:
        made.append(Measured(blocks))
        return made[0]

    config = own_config(tmp_path, LAW)
    figures = measuring.measure(config, Made(answer=answer, numbers=41), runner)
    states, observations = np.array(made[0].states), asked[0]
    assert figures.cycles == 1003 + 5000 + 5 * 11
    assert (figures.flash_bytes, figures.ram_bytes) == (500, sum(
        block.memory.nbytes for name, block in made[0].blocks.named.items() if name in ("guard", "controller_memory")
    ))  # fmt: skip
    assert figures.ram_bytes >= 96
    assert figures.difference == pytest.approx(0.25, abs=1e-6)
    assert states.shape == (32, measuring.STATES)
    reach = np.repeat([0.3, 0.5, 0.3, 2.0, 0.4], (3, 3, 3, 3, 4))
    assert np.all(np.abs(states) <= reach * 1.000001)
    assert np.all(np.abs(states).max(axis=0) > 0.85 * reach)
    assert np.all(states.max(axis=0) - states.min(axis=0) > 1.5 * reach)
    assert len(np.unique((states / reach).round(5))) == states.size, "none of them comes twice"
    assert np.array_equal(observations[:, 9:16], states[:, 9:].astype(np.float32))
    assert np.any(observations[1:, 16:]), "the previous action is kept"
    assert figures.share == figures.cycles / CALL_CYCLES
    assert str(figures) == (
        f"{figures.cycles} cycles per call ({figures.cycles / 168:.0f} us of a Cortex-M4), "
        f"{figures.cycles / CALL_CYCLES:.0%} of its control slot of {CALL_CYCLES}; flash 500 B, RAM {figures.ram_bytes} B"
    )
