"""Small laws as users write them: accepted, with the same bits in Python and C, or refused with what to write instead."""

from pathlib import Path

import numpy as np
import pytest

from firmware_py.config import parameters_of
from firmware_py.core.structs import MODE_FLY
from firmware_py.core_runner import CoreBlocks
from firmware_py.export.compilers import Compiler, compilers
from firmware_py.export.native import STRICT, build
from firmware_py.logic.loading import load_logic
from hil.board.cores.boards import BOARDS, runner_of
from hil.config import LabConfig
from support.command import Cli
from support.own_logic import own_config
from support.random_frames import OWN, law_of
from support.random_programs import Programs

SUM = "total = ZERO\n    for k in range(4):\n        total = total + memory.errors[k] * f32(i + 1)\n"
CLAMPED = "if i < 0:\n    i = i32(0)\nif i > 3:\n    i = i32(3)\nreturn TABLE[i]"
ACCEPTED = [
    "return ZERO",  # no argument is used
    f"for i in range(2):\n    {SUM}    memory.integral = total\nfor i in range(3):\n    {SUM}"
    "    memory.errors[i] = total * DT\nreturn memory.integral",
    "if memory.ticks > 2:\n    a = own.gain_z\nelse:\n    a = -own.gain_z\nreturn a",
    "if memory.ticks > 2:\n    a = ZERO\nelif memory.mode == 1:\n    a = DT\nelse:\n    return own.gain_z\nreturn a",
    "for i in range(4):\n    last = memory.errors[i]\nreturn last",
    "for i in range(4):\n    if memory.errors[i] > ZERO:\n        low = TABLE[i]\n    else:\n        low = DT\n"
    "    memory.errors[i] = low\nlow = own.gain_z\nreturn low",
    "near = memory.ticks > 1\nif near:\n    near = memory.mode == 0\nif near:\n    return DT\nreturn ZERO",
    "found = i32(-1)\nfor i in range(4):\n    if memory.errors[i] > own.gain_z:\n        found = i32(i)\n        break\n"
    "return f32(found)",
    "total = ZERO\nfor i in range(4):\n    if memory.errors[i] < ZERO:\n        continue\n    total += memory.errors[i]\n"
    "return total",
    "for i in range(3, 0, -1):\n    memory.errors[i] = memory.errors[i - 1]\nmemory.errors[0] = estimator.now[2]\n"
    "return memory.errors[3]",
    "total = ZERO\nfor i in range(0, 4, 2):\n    total = total * f32(3.0) + TABLE[i]\nreturn total",
    "total = ZERO\nfor i in range(4):\n    for k in range(i, -1, -1):\n        total = total + TABLE[k]\nreturn total",
    "memory.ticks += 1\nmemory.integral -= own.gain_z * DT\nmemory.errors[1] *= f32(0.5)\nmemory.counts[2] //= 2\n"
    "return memory.integral / memory.errors[1]",
    f"i = memory.ticks\n{CLAMPED}",
    f"i = i32(estimator.now[2] * f32(10.0))\n{CLAMPED}",
    "return TABLE[min(max(memory.ticks - 1, 0), 3)]",
    "return min(own.gain_z, memory.errors[0]) + max(memory.errors[1], memory.errors[2])",
    "if 0 <= memory.mode and memory.mode < 4:\n    return TABLE[memory.mode]\nreturn ZERO",
    "i = memory.ticks\nif i < 0 or i >= 4:\n    return DT\nreturn TABLE[i]",
    "n = min(memory.ticks, 4)\ntotal = ZERO\nfor i in range(n):\n    total = total + TABLE[i]\nreturn total",
    "if memory.mode != 0:\n    pass\nelse:\n    memory.mode = i32(1)\nreturn f32(memory.mode)",
    "i = 0\nfor k in range(4):\n    if memory.errors[k] > memory.errors[min(max(i, 0), 3)]:\n        i = k\n"
    "return f32(i) * sqrt(abs(clamp(memory.errors[0], -own.gain_z, own.gain_z)))",
]  # fmt: skip
RANDOM = [
    Programs(OWN, seed).body() + "\nif is_far:\n    return x\nreturn y + f32(n) + f32(m)"
    for seed in range(16)
]
DONE = "\n    return DT\nreturn ZERO"
# A law, and what is to be written instead.
REFUSED = [
    ("a = ZERO\nb = DT\na, b = b, a\nreturn a", "write one assignment for each value"),
    ("return estimator.velocity[2]", "write estimator.now[VELOCITY + k]"),
    ("if memory.mode:\n    return DT\nreturn ZERO", "write memory.mode != 0"),
    ("total = ZERO\nfor g in TABLE:\n    total = total + g\nreturn total", "write for k in range(4): and TABLE[k] for g"),
    ("for i in range(len(TABLE)):\n    memory.errors[i] = ZERO\nreturn ZERO", "write 4"),
    ("return f32(round(own.gain_z))", "write i32(x), which cuts off towards zero"),
    ("half = memory.ticks / 2\nreturn f32(half)", "write f32(memory.ticks) / f32(2), or memory.ticks // 2"),
    ("memory.mode = memory.mode | 2\nreturn ZERO", "write an i32 field for each flag"),
    ("if (memory.mode == 1) | (memory.ticks == 2):\n    return DT\nreturn ZERO",
     "write memory.mode == 1 or memory.ticks == 2"),
    ("for i in range(memory.ticks, 0, -1):\n    memory.errors[0] = DT\nreturn ZERO",
     "write for k in range(memory.ticks): and i = memory.ticks - k inside"),
    ("i = memory.ticks\nfor k in range(memory.mode):\n    i = i32(3)\nreturn TABLE[i]", "it may be outside 0..3 in flight"),
    ("return f32(own.gain_z, DT)", "f32 of 2 arguments: write f32(x)"),
    ("last = 4\nfor i in range(0, last, 2):\n    memory.errors[i] = DT\nreturn ZERO",
     "the numbers of a range with a step are constants"),
    ("if memory.ticks > 2:\n    a = DT\nreturn a", "a is read before it has a value: write a = f32(0.0) before line"),
    ("for i in range(memory.ticks):\n    n = n + 1\nreturn f32(n)", "n is read before it has a value: write n ="),
    ("for i in range(4):\n    if memory.mode == i:\n        break\n    a = DT\nreturn a", "write a = f32(0.0) before line"),
    ("i = memory.ticks\nif i > 3:\n    i = i32(3)\nreturn TABLE[i]", "write min(max(i, 0), 3)"),
    ("if 0 <= memory.mode and memory.mode < 4:\n    memory.mode += 1\n    return TABLE[memory.mode]\nreturn ZERO",
     "index memory.mode, which is 1..4: f32 array of 4 has 0..3: write min(max(memory.mode, 0), 3)"),
    ("return memory.integrl", "write memory.integral"),
    ("return own.gain_x * memori.integral", "write own.gain_z"),
    ("return memori.integral", "write memory.integral"),
    ("return TABEL[0]", "write TABLE"),
    ("return clmap(DT, ZERO, DT)", "write clamp"),
    ("return estimator.now[VELOCITY]", "write from firmware_py.core.structs import VELOCITY at the top of the file"),
    ("return own.gain_z if memory.ticks > 2 else ZERO", "a if .. else b: write an if on lines of its own"),
    ("i = 0\nwhile i < 4:\n    i = i + 1\nreturn f32(i)", "while: write a loop over range(..)"),
    ("e: f32 = DT\nreturn e", "type of a local: write x = value, without the type"),
    ("return own.gain_z * 2", "write f32(2)"),
    ("memory.ticks = own.gain_z\nreturn ZERO", "write i32(own.gain_z)"),
    ("return ZERO < own.gain_z < DT", "write ZERO < own.gain_z and own.gain_z < DT"),
    ("for i in range(4):\n    memory.errors[i] = DT\nreturn f32(i)", "write last = i inside, and read last"),
    (f"if memory.mode in (1, 2):{DONE}", "write memory.mode == 1 or memory.mode == 2"),
    (f"if memory.mode not in (1, 2):{DONE}", "write memory.mode != 1 and memory.mode != 2"),
    (f"if memory.mode is 1:{DONE}", "write memory.mode == 1"),
    (f"if memory.mode is not 1:{DONE}", "write memory.mode != 1"),
    (f"if memory.mode is None:{DONE}", "write memory.mode != 0 or the like"),
    (f"if (memory.mode == 1) & (memory.ticks == 2):{DONE}", "write memory.mode == 1 and memory.ticks == 2"),
    (f"if memory.integral:{DONE}", "the condition is f32, not bool: write memory.integral != f32(0.0)"),
    ("return own.gain_z ** 3", "write own.gain_z * own.gain_z * own.gain_z"),
    ("return (own.gain_z + DT) ** 2", "write x * x"),
    ("return f32(memory.mode >> 1)", "write memory.mode // 2 for each bit"),
    ("return f32(memory.mode ^ 1)", "^ of i32: write an i32 field for each flag"),
    ("memory.mode = memory.ticks > 2\nreturn ZERO", "i32 = bool: write an if that sets a number"),
    ("memory.mode = True\nreturn ZERO", "i32 = bool: write 1"),
    ("memory.integral = False\nreturn ZERO", "f32 = bool: write f32(0)"),
    ("return own.gain_z.real", "own.gain_z.real is no field of a struct: write argument.field"),
    ("return self.integral", "write memory.integral, a field of the memory struct"),
    ("return f32(Phase.wait)", "write PHASE_WAIT = 0 at the top of the file"),
    ("return other.gain_z", "write own.gain_z"),
    ("return other.thing", "write other as an argument of law_"),
    ("return law_0", "write law_0(estimator, own, memory)"),
    ("return abs", "abs is no value here: write abs(x)"),
    ("return f32(min(memory.ticks, own.gain_z))", "of i32 and f32: write f32(memory.ticks)"),
    ("return f32(max(memory.ticks > 1, memory.mode > 1))", "of bool and bool: write an if"),
    ("return f32((memory.ticks > 1) + memory.mode)", "+ of bool and i32: write and, or, not between comparisons"),
    ("return memory.errors + own.gain_z", "+ of f32 array and f32: write a loop over range(..) for the elements"),
    ("return memory.errors[0, 1]", "2 indices on f32 array: write memory.errors[column]"),
    ("return own + DT", "+ of Gains and f32: write a field of it"),
    ("for i in reversed(range(4)):\n    memory.errors[i] = DT\nreturn ZERO", "write for i in range(4 - 1, -1, -1)"),
    ("for i, e in enumerate(memory.errors):\n    memory.integral = DT\nreturn ZERO",
     "write for k in range(4): and memory.errors[k]"),
    ("for g in (0.5, 1.0):\n    memory.integral = DT\nreturn ZERO",
     "write for k in range(2): and TABLE[k], with TABLE = constant(0.5, 1.0) at the top of the file"),
    ("for g in zip(1, 2):\n    memory.integral = DT\nreturn ZERO",
     "write for k in range(n): and the elements by their index k"),
    ("for i in range(3):\n    memory.integral = DT\nelse:\n    memory.integral = ZERO\nreturn DT",
     "write its lines behind the loop"),
    ("return memory.counts", "returns i32 array, not f32: write one of its numbers"),
    ("return", "return without f32: write return with a value of f32"),
    ("memory.errors = ZERO\nreturn DT", "f32 array = f32: write a loop over range(..) for the elements"),
]  # fmt: skip
# Lines at the top of the file, and what is to be written instead.
AT_THE_TOP = [
    ("from enum import IntEnum\n\n\nclass Mode(IntEnum):\n    WAIT = 0",
     ["import from enum: write MODE_A = 0", "class Mode is not a Struct: write MODE_WAIT = 0"]),
    ("@kernel\ndef since(a: i32, b: i32) -> i32:\n    return elapsed(a, b)", ["write from firmware_py.core.subset import"]),
    ("K = (0.5, 1.0)", ["write K = constant(0.5, 1.0)"]),
    ("K = [[1.0, 2.0], [3.0, 4.0]]", ["write K = constant((1.0, 2.0), (3.0, 4.0))"]),
    ("RATE: float = 0.5", ["type of a constant at the top of a module: write RATE = f32(0.5)"]),
    ("class A(Struct):\n    n: int\n    x: float\n    a: F32s\n    b: f32 = 0.0",
     ["write n: i32", "write x: f32", "write a: Annotated[F32s, n] with its size", "write b: f32, and its"]),
    ("@kernel\ndef twice(x: int, e: Estimatr) -> float:\n    return x + e.y",
     ["write x: i32", "write e: Estimator", "write -> f32"]),
    ("import numpy as np\n\nK = constant(np.pi)", ["np.pi is outside the subset: write PI, from firmware_py.core.maths"]),
    ("from firmware_py.core.math import sin", ["cannot import math: not a module of the core, or in a circle: write "
     "firmware_py.core.maths"]),
    ('K1 = {"a": 1}', ["write K1_A = f32(0.5), one constant for each entry"]), ("K2 = True", ["write K2 = 1"]),
    ('K3 = "a"', ["write K3 = 0, one number for each text"]), ("K4 = float(3)", ["write K4 = f32(3)"]),
    ("K5 = int(3)", ["write K5 = i32(3)"]), ("K6 = 0.5", ["write K6 = f32(0.5)"]), ("K7: i32 = 3", ["write K7 = 3"]),
    ("K8 = 3 + 4", ["write the number itself, as K8 = f32(0.5)"]), ("K9 = K0 = 1", ["write one line for each constant"]),
    ("from dataclasses import dataclass", ["write class Name(Struct), with fields as x: f32"]),
    ("from random import random", ["leave it out; a file may import from firmware_py.core and typing only"]),
    ("if True:\n    pass", ["if at the top of a module: leave it out"]),
    ("print(1)", ["call at the top of a module: leave it out"]),
    ("3", ["value at the top of a module: leave it out"]),
    ("for q in range(3):\n    pass", ["write it inside a function marked @kernel"]),
    ("async def f():\n    pass", ["write @kernel def f"]), ("class A0:\n    x: f32", ["write class A0(Struct):"]),
    ("class A1(Struct):\n    def f(self):\n        pass", ["nothing but fields: write a @kernel outside"]),
    ("class A2(Struct):\n    x = 3", ["nothing but fields: write a field as x: f32"]),
    ('class A3(Struct):\n    """Nothing."""', ["struct A3 has no field"]),
    ("class A4(Struct):\n    x: list[float]\n    y: i32\n    y: i32\n    z: Annotated[F32s, 2, 2, 2]\n"
     "    n: Annotated[f32, 3]",
     ["write x: Annotated[F32s, n]", "y: this name exists already", "write z: Annotated[F32s, n]", "write n: f32, or i32"]),
    ('class A5(Struct):\n    x: Annotated[f32, Logged("m"), Logged("s")]', ["field with 2 marks: write one of them"]),
    ("@kernel\ndef f1(x: f32):\n    return x", ["write -> f32"]), ("@kernel\ndef f2(x: f32):\n    pass", ["write -> None"]),
    ("@kernel\ndef f3(x) -> f32:\n    return x", ["argument x of f3 has no type of the subset: write x: f32"]),
]  # fmt: skip


@pytest.fixture(scope="module")
def accepted(tmp_path_factory: pytest.TempPathFactory) -> LabConfig:
    return own_config(tmp_path_factory.mktemp("laws"), law_of(ACCEPTED + RANDOM))


@pytest.mark.long
@pytest.mark.parametrize("board", BOARDS[1:])
def test_accepted_laws_compute_the_same_bits_in_c_and_elsewhere(accepted: LabConfig, board: str) -> None:
    logic = load_logic(accepted.logic)
    flown, beside = (
        CoreBlocks(parameters_of(accepted), runner_of(one, accepted.logic), logic) for one in ("c", board)
    )
    rng = np.random.default_rng(5)
    for ticks in (0, 2, 5, -7, 3):
        errors, now = rng.normal(0, 2, 4).astype(np.float32), rng.normal(0, 1, 16).astype(np.float32)
        for blocks in (flown, beside):
            blocks.data.fields.mode = MODE_FLY
            blocks.estimator.fields.now[:] = now
            memory = blocks.named["controller_memory"].fields
            memory.ticks, memory.errors[:], memory.counts[:] = ticks, errors, (-5, 6, 7)
            blocks.run.call("control")
        assert np.isfinite(memory.answers).all()
        assert memory.answers[: len(ACCEPTED + RANDOM)].any()
        for name in ("control", "controller_memory", "guard"):
            assert flown.named[name].bytes() == beside.named[name].bytes(), (name, ticks)


@pytest.mark.long
@pytest.mark.parametrize(
    "compiler", [one for one in compilers() if one.name != "cc"], ids=lambda one: str(one.name)
)
def test_strict_compilers_accept_the_laws_without_a_warning(accepted: LabConfig, compiler: Compiler) -> None:
    logic = load_logic(accepted.logic)
    assert logic is not None
    build(
        logic.loaded.translation,
        compiler,
        "-Os",
        (*STRICT, "-std=c99", "-Wno-tautological-compare"),
    )


@pytest.mark.long
@pytest.mark.parametrize("board", ["c", "python"])
def test_a_loop_that_the_data_bounds_keeps_the_bounds_of_its_indices(accepted: LabConfig, board: str) -> None:
    law = ACCEPTED.index(next(body for body in ACCEPTED if body.startswith("n = min(")))
    blocks = CoreBlocks(parameters_of(accepted), runner_of(board, accepted.logic), load_logic(accepted.logic))
    blocks.data.fields.mode = MODE_FLY
    memory = blocks.named["controller_memory"].fields
    for ticks, total in ((-3, 0.0), (1, 0.5), (900, 2.35)):
        memory.ticks = ticks - 1  # another law counts
        blocks.run.call("control")
        assert float(memory.answers[law]) == pytest.approx(total)


def test_all_refusals_come_at_once_in_the_order_of_their_lines(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = law_of([body for body, _ in REFUSED], "\n\n".join(top for top, _ in AT_THE_TOP))
    Path("controller.py").write_text(text, encoding="utf-8")
    Path("good.py").write_text(law_of(ACCEPTED[:2]), encoding="utf-8")
    assert cli("check", "controller.py", "good.py") == 2
    lines = cli.err.splitlines()
    places = [line.split(":")[:2] for line in lines]
    assert all(file == "controller.py" for file, _ in places)
    assert [int(line) for _, line in places] == sorted(int(line) for _, line in places)
    assert cli.out == "good.py: ok (controller: reset_law, control_law; 1 parameter)\n"
    expected = [repair for _, repairs in AT_THE_TOP for repair in repairs] + [repair for _, repair in REFUSED]
    assert [line for line, repair in zip(lines, expected, strict=True) if repair not in line] == []
    assert not [name for name in ("Assign", "Expr", "If", "For", "Op", "Comp") if name in cli.err]
    (tmp_path / "profile.toml").write_text('base = "floaty"\n[logic]\ncontroller = "controller.py"\n')
    assert cli("fly", "hover", "--profile", "profile.toml") == 2
    assert cli.err.splitlines() == [f"floaty: {line}" for line in lines]


def test_a_file_that_is_no_law_is_refused(cli: Cli, tmp_path: Path) -> None:
    assert cli("check", tmp_path / "missing.py") == 2
    assert cli.err == f"{tmp_path / 'missing.py'}: No such file or directory\n"
    (tmp_path / "latin.py").write_bytes(b"# Newton\xe9\n")
    assert cli("check", tmp_path / "latin.py") == 2
    assert cli.err.startswith(f"{tmp_path / 'latin.py'}: 'utf-8' codec can't decode byte 0xe9")
    (tmp_path / "test_it.py").write_text("def test_it():\n    pass\n")
    assert cli("check", tmp_path / "test_it.py") == 2
    assert cli.err.endswith(
        "test_it.py:1: no control law and no estimator: write @kernel def control_law(..)\n"
    )
