"""Constant arrays of own logic: matrix loops with the same bits on every target, and what is refused, with its line."""

from pathlib import Path

import numpy as np
import pytest

from firmware_py.config import parameters_of
from firmware_py.core.structs import MODE_FLY
from firmware_py.core_runner import CoreBlocks, default_runner
from firmware_py.export import reading
from firmware_py.logic.loading import load_logic
from hil.board.cores.boards import BOARDS, runner_of
from hil.config import LabConfig
from hil.errors import LabError
from support.own_logic import own_config

ROWS, COLUMNS = 5, 16
RNG = np.random.default_rng(7)
WEIGHTS = RNG.normal(0, 1, (ROWS, COLUMNS)).astype(np.float32)
WEIGHTS[0, :5] = 0.0, -0.0, 1e-45, 3e38, 16777216.0
LAW = f'''"""A matrix times the state, through tanh."""

from typing import Annotated

from firmware_py.core.maths import tanh
from firmware_py.core.structs import Control, Estimator
from firmware_py.core.subset import F32s, Struct, constant, f32, kernel

WEIGHTS = constant(
    {", ".join(str(tuple(map(float, row))) for row in WEIGHTS)},  # of the tests
)
BIASES = constant(0.5, -1, 2.0, 0.25, 0.0)


class Memory(Struct):
    product: Annotated[F32s, {ROWS}]


@kernel
def element(matrix: F32s, row: i32, column: i32) -> f32:
    return matrix[row % {ROWS}, column % {COLUMNS}]


@kernel
def reset_law(memory: Memory) -> None:
    memory.product[0] = f32(0.0)


@kernel
def control_law(estimator: Estimator, control: Control, memory: Memory) -> None:
    biases = BIASES
    for row in range({ROWS}):
        total = biases[row]
        for column in range({COLUMNS}):
            total = total + element(WEIGHTS, row, column) * estimator.now[column]
        memory.product[row] = total
    for flap in range(4):
        control.u[flap] = tanh(memory.product[flap + 1])
        control.flap[flap] = control.u[flap]
'''.replace("f32, kernel", "f32, i32, kernel")


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> LabConfig:
    return own_config(tmp_path_factory.mktemp("matrix"), LAW)


@pytest.mark.long
@pytest.mark.parametrize("board", BOARDS[1:])
def test_matrix_times_vector_is_equal_everywhere(config: LabConfig, board: str) -> None:
    logic = load_logic(config.logic)
    other = runner_of(board, config.logic)
    flown, beside = (CoreBlocks(parameters_of(config), runner, logic) for runner in (default_runner, other))
    rng = np.random.default_rng(3)
    for scale in (1e-20, 1e-3, 0.1, 1.0, 10.0, 1e3):
        state = rng.normal(0, scale, COLUMNS).astype(np.float32)
        for blocks in (flown, beside):
            blocks.data.fields.mode = MODE_FLY
            blocks.estimator.fields.now[:] = state
            blocks.run.call("control")
        for name in ("control", "controller_memory", "guard"):
            assert flown.named[name].bytes() == beside.named[name].bytes(), (name, scale)
        exact = WEIGHTS[1:].astype(float) @ state + (-1, 2, 0.25, 0)
        assert flown.control.fields.u == pytest.approx(np.tanh(exact), abs=2e-6 * max(scale, 1))


def line_of(text: str, part: str) -> int:
    return text[: text.index(part)].count("\n") + 1


BIASES = "BIASES = constant(0.5, -1, 2.0, 0.25, 0.0)"
BODY = "    biases = BIASES\n"
REFUSED = [
    (BIASES, "BIASES = constant()", "BIASES", "BIASES: an array without numbers"),
    (BIASES, "BIASES = constant((), ())", "BIASES", "BIASES: an array without numbers"),
    (BIASES, "BIASES = constant(\n    0.5,\n    x,\n)", "    x", "BIASES: x is no number"),
    (BIASES, 'BIASES = constant(\n    float("nan"),\n)', "    float", "BIASES: float('nan') is no number"),
    (BIASES, "BIASES = constant(\n    1.0,\n    -1e39)", "    -1e39", "BIASES: -1e+39 is no finite float32"),
    (BIASES, "BIASES = constant(1.0, True)", "BIASES", "BIASES: True is no number"),
    (BIASES, "BIASES = constant(1.0, (2.0, 3.0))", "BIASES", "BIASES: (2.0, 3.0) is no number"),
    (BIASES, "BIASES = constant(\n    (1.0, 2.0),\n    (3.0,),\n)", "    (3.0",
     "BIASES: a row of 1 numbers; the first has 2"),
    (BIASES, "BIASES = constant(((1.0,),))", "BIASES", "BIASES: (1.0,) is no number"),
    (BIASES, f"BIASES = constant({'0,' * 20})", "BIASES",
     "BIASES: 100 numbers in the constant arrays of this file: at most 99"),
    (BIASES, "BIASES = [0.5, -1.0]", "BIASES", "constant BIASES is none of f32(number), a 32-bit integer and"),
    (BODY, BODY + "    WEIGHTS[0, 1] = f32(1.0)\n", "    WEIGHTS[", "WEIGHTS is a constant and is written"),
    (BODY, BODY + "    biases[1] = f32(1.0)\n", "    biases[1]", "BIASES is a constant and is written"),
    ("total = biases[row]", "total = biases[row] + WEIGHTS[0, 16]", "        total =",
     "index 16: f32 matrix of 16 has 0..15 (in control_law)"),
    ("range(5)", "range(6)", "        total =", "index row, which is 0..5: f32 array of 5 has 0..4: write min(max("),
    ("biases[row]", "BIASES", "        total =", "total stands for more than one array: write another name"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "at", "reason"), REFUSED, ids=[case[3] for case in REFUSED])
def test_a_bad_constant_array_is_refused_with_its_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, old: str, new: str, at: str, reason: str
) -> None:
    monkeypatch.setattr(reading, "MOST_NUMBERS", 99)  # 80 of them are the weights
    text = LAW.replace(old, new, 1)
    with pytest.raises(LabError) as error:
        own_config(tmp_path, text)
    assert str(error.value).startswith(f"{tmp_path / 'controller.py'}:{line_of(text, at)}: {reason}")


def test_a_function_that_writes_to_a_constant_array_is_refused(tmp_path: Path) -> None:
    fill = "@kernel\ndef fill(a: F32s) -> None:\n    a[0] = f32(1.0)\n\n\n@kernel\ndef reset_law"
    text = LAW.replace("@kernel\ndef reset_law", fill).replace(BODY, BODY + "    fill(BIASES)\n")
    with pytest.raises(
        LabError, match=rf"py:{line_of(text, '    fill(')}: BIASES is a constant and is written"
    ):
        own_config(tmp_path, text)
