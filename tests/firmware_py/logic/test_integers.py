"""Whole numbers of own logic: division and remainder round down on every target, as in Python, not towards zero as in C."""

import pytest

from firmware_py.config import parameters_of
from firmware_py.core.structs import MODE_FLY
from firmware_py.core_runner import CoreBlocks
from firmware_py.logic.loading import load_logic
from hil.board.cores.boards import BOARDS, runner_of
from hil.config import LabConfig
from support.own_logic import own_config

LAW = '''"""Whole numbers of both signs."""

from typing import Annotated

from firmware_py.core.structs import Control, Estimator
from firmware_py.core.subset import I32s, Struct, f32, i32, kernel

PERIOD = 4


class Memory(Struct):
    ring: Annotated[I32s, 5]


@kernel
def reset_law(memory: Memory) -> None:
    memory.ring[0] = i32(0)


@kernel
def control_law(estimator: Estimator, control: Control, memory: Memory) -> None:
    number = i32(estimator.now[0])
    memory.ring[number % 5] = i32(memory.ring[number % 5] + 1)
    control.u[0] = f32(number // PERIOD)
    control.u[1] = f32(number % PERIOD)
    control.u[2] = f32(2 * (1 - (number + 1) // 3))
'''


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> LabConfig:
    return own_config(tmp_path_factory.mktemp("integers"), LAW)


@pytest.mark.parametrize("board", BOARDS)
def test_division_and_remainder_round_down_everywhere(config: LabConfig, board: str) -> None:
    logic = load_logic(config.logic)
    runner = runner_of(board, config.logic)
    blocks = CoreBlocks(parameters_of(config), runner, logic)
    ring = [0] * 5
    for number in range(-13, 14):
        blocks.data.fields.mode = MODE_FLY
        blocks.estimator.fields.now[0] = number
        blocks.run.call("control")
        ring[number % 5] += 1
        expected = (number // 4, number % 4, 2 * (1 - (number + 1) // 3))
        assert tuple(blocks.control.fields.u[:3]) == expected, number
        assert blocks.named["controller_memory"].fields.ring.tolist() == ring
