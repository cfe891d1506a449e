"""Constructs of Python that the subset does not have: each is one line with file, line and what to write instead."""

from pathlib import Path

import pytest

from hil.errors import LabError
from support.own_logic import LAW, own_config

IN_LAW = "    memory.ticks = i32(memory.ticks + 1)\n"
CONSTRUCTS = [
    ("a = [v * v for v in control.u]", "list comprehension: write a loop over range(..)"),
    ("a = {v for v in control.u}", "set comprehension: write a loop over range(..)"),
    ("a = {v: v for v in control.u}", "dict comprehension: write a loop over range(..)"),
    ("a = sum(v for v in control.u)", "generator expression: write a loop over range(..)"),
    ("twice = lambda v: v + v", "lambda: write a @kernel of its own, above this one"),
    ("def twice(v: f32) -> f32:\n    return v + v", "function inside a function: write a @kernel of its own"),
    ("class Inner:\n    v = 1", "class inside a function: write a Struct at the top of the file"),
    ("import math\na = math.sin(ZERO)", "write sin(x), from firmware_py.core.maths"),
    ("import numpy as np", "import numpy as np is outside the subset, and not used: leave it out"),
    ("from math import sqrt as root\na = root(ZERO)", "write sqrt(x), from firmware_py.core.subset"),
    ("from firmware_py.core.maths import cos", "import inside a function: write it at the top of the file"),
    ("try:\n    a = ZERO\nexcept ValueError:\n    a = DT", "Try statement: write an if"),
    ("with control as c:\n    a = c", "With statement: write its lines without it"),
    ("global DT", "Global statement: write a field of the memory struct"),
    ("nonlocal DT", "Nonlocal statement: write a field of the memory struct"),
    ('a = f"{DT}"', "f-string: write a field of the memory struct marked Logged(unit)"),
    ("if (a := ZERO) < DT:\n    return", "assignment with := : write an assignment on a line of its own"),
    ("match memory.ticks:\n    case 1:\n        a = ZERO", "Match statement: write if and elif"),
    ("a = clamp(*control.u)", "* before an argument: write the arguments one by one"),
    ("a = clamp(**control.u)", "write the arguments in their order, without names"),
    ("a, *b = control.u", "* before an argument: write the arguments one by one"),
    ("while True:\n    a = ZERO\nelse:\n    a = DT", "While statement: write a loop over range(..)"),
    (
        "for i in range(3):\n    a = ZERO\nelse:\n    a = DT",
        "else of a loop: write its lines behind the loop",
    ),
    ("for i in range(3):\n    break", "Break statement: write an if"),
    ("for i in range(3):\n    continue", "Continue statement: write an if"),
    ("pass", "Pass statement: write nothing, or return"),
    ("del control", "Delete statement: write nothing"),
    ("yield ZERO", "yield: write a field of the memory struct"),
    ("a = await control", "await: write nothing"),
    ("a = ZERO if memory.ticks == 0 else DT", "IfExp expression: write an if on lines of its own"),
    ("raise ValueError", "Raise statement: write an if"),
    ("assert memory.ticks == 0", "Assert statement: write an if"),
    ("a = memory.ticks in (1, 2)", "comparison memory.ticks in (1, 2): write == for each value"),
    ("a = memory is control", "comparison memory is control: write =="),
    ("a = memory.ticks is not 3", "comparison memory.ticks is not 3: write !="),
]


@pytest.mark.parametrize(("body", "told"), CONSTRUCTS, ids=[body.split("\n")[0] for body, _ in CONSTRUCTS])
def test_an_unsupported_construct_is_one_line_with_a_replacement(
    tmp_path: Path, body: str, told: str
) -> None:
    lines = "".join(f"    {line}\n" for line in body.splitlines())
    text = LAW.replace(IN_LAW, IN_LAW + lines)
    first = text[: text.index(lines)].count("\n") + 1
    with pytest.raises(LabError) as error:
        own_config(tmp_path, text)
    place, _, reason = str(error.value).partition(": ")
    assert place in [
        f"{tmp_path / 'controller.py'}:{first + index}" for index in range(len(body.splitlines()))
    ]
    assert told in reason
    assert "\n" not in reason
