"""The laboratory's kernels in C do what their Python does, and what has no equal in C is refused."""

import math
from pathlib import Path
from textwrap import indent
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py import compiling
from firmware_py.compiling import bound, bound_in, compiler
from firmware_py.core.subset import F64s, I32s, I64s, Integer, Struct, call, f64, i32, i64
from firmware_py.elementary import atan2, exp, sine_ahead
from firmware_py.export.compilers import Compiler, compilers
from firmware_py.export.errors import ExportError
from firmware_py.export.kernels import build, library, translate
from firmware_py.export.live_reading import Arrays
from firmware_py.export.methods import METHOD
from support.random_frames import KERNEL, KERNEL_HEAD, LIVE, names_in
from support.random_programs import Programs

COMPILERS = [one for one in compilers() if one.name != "cc"]
IDS = [one.name for one in COMPILERS]
COEFFICIENTS = (0.5, -0.25, 1e-300)
ROW, SHIFT = 1, -0.1

kernel = compiler()


@kernel
def reduced(x: float, by: Integer) -> float:
    """Return a value that gets its first value in a branch, and a choice."""
    whole = math.floor(x) + by
    if whole % 3 == 0:
        value = 1.0 - x
        value = math.copysign(value, -1.0)
    else:
        value = x + 2 * whole
    return -value if whole // 4 > 0 or value < SHIFT else value


@kernel
def swap(numbers: F64s) -> None:
    """Swap through a second name."""
    same, before = numbers, numbers[0]
    numbers[0], numbers[1] = same[1], same[0]
    numbers[2] = before - numbers[1]


@kernel
def compute(numbers: F64s, table: F64s, counts: I32s) -> None:
    """Do one of everything."""
    a, b = numbers[0], numbers[1]
    swap(numbers)
    series: float = 0.0
    for coefficient in COEFFICIENTS:
        series = series * a + coefficient
    numbers[3], numbers[4] = min(a, b), max(a, b)
    numbers[5], numbers[6] = abs(series), math.sqrt(abs(b))
    doublings = 0
    while numbers[4] < 1e3:
        doublings += 1
        if doublings > 5:
            break
        numbers[4] *= 2.0
    for i in range(counts[0], 3):
        table[ROW, i] = table[ROW, i] + reduced(a, i - counts[1])
    counts[0], counts[1] = i32(max(math.floor(a), f64(counts[1]))), i32(a > b)
    numbers[7], numbers[8], numbers[9] = exp(a), sine_ahead(b, counts[1]), atan2(a, b)
    numbers[10] = a - (math.inf if a == b else math.ldexp(a, int(counts[1]) - 3)) * math.pi


def fresh(numbers: list[float], first: int, second: int) -> Arrays:
    arrays = np.zeros(11), np.full((2, 3), 0.5), np.array([first, second], i32)
    arrays[0][:2] = numbers
    return arrays


@pytest.mark.parametrize("compiler", COMPILERS, ids=IDS)
def test_c_computes_the_bits_of_python(compiler: Compiler) -> None:
    in_c = fresh([0.0, 0.0], 0, 0)
    call = bound_in(
        build(translate((compute,), in_c), compiler, ("-Wall", "-Wextra", "-Werror")),
        METHOD + "compute",
        *in_c,
    )
    number = st.floats(-700.0, 700.0)  # beyond, Python's ldexp may raise
    number |= st.sampled_from([0.0, -0.0, 1.0, -1.0])

    @settings(max_examples=300, deadline=None)
    @given(
        numbers=st.lists(number, min_size=2, max_size=2), first=st.integers(0, 2), second=st.integers(-9, 9)
    )
    def holds(numbers: list[float], first: int, second: int) -> None:
        in_python = fresh(numbers, first, second)
        for array, content in zip(in_c, in_python, strict=True):
            array[:] = content
        call()
        compute(*in_python)
        assert [array.tobytes() for array in in_c] == [array.tobytes() for array in in_python]

    holds()


@pytest.mark.long
def test_random_kernels_compute_the_bits_of_python(tmp_path: Path) -> None:
    path = tmp_path / "random_kernels.py"
    kernels = (KERNEL.format(name=n, body=indent(Programs(LIVE, n).body(), "    ")) for n in range(30))
    path.write_text(KERNEL_HEAD + "".join(kernels), encoding="utf-8")
    names = names_in(path)
    functions = tuple(names[f"random_{n}"] for n in range(30))
    in_c, in_python = ((np.zeros(5), np.zeros(3, i32)) for _ in range(2))
    built = library(functions, in_c)
    rng = np.random.default_rng(2)
    for function in functions:
        call = bound_in(built, METHOD + function.__name__, *in_c)
        for _ in range(8):
            for one, other, content in zip(
                in_c, in_python, (rng.normal(0, 3, 5), rng.integers(-9, 9, 3)), strict=True
            ):
                one[:] = other[:] = content
            call()
            function(*in_python)
            assert [one.tobytes() for one in in_c] == [one.tobytes() for one in in_python], function.__name__


@kernel
def library_sine(numbers: F64s) -> None:
    """Do."""
    numbers[0] = math.sin(numbers[1])


@kernel
def asks_inside(counts: I64s) -> int:
    """Do."""
    return 1 + call(counts[0])


@kernel
def asks_and_goes_on(counts: I64s) -> None:
    """Do."""
    call(counts[0])


@kernel
def asks_for_truth(counts: I64s) -> int:
    """Do."""
    if call(counts[0]) > 0:
        return 1
    return 0


@kernel
def listed(numbers: F64s) -> None:
    """Do."""
    numbers[0] = max([numbers[1], 1.0])


@kernel
def by_float(numbers: F64s) -> None:
    """Do."""
    numbers[0] = numbers[numbers[1]]


@kernel
def beyond(numbers: F64s) -> None:
    """Do."""
    numbers[11] = 0.0


@kernel
def retyped(numbers: F64s) -> None:
    """Do."""
    x: Any = 1
    x = 0.5
    numbers[0] = x


@kernel
def untyped(numbers: Any) -> None:
    """Do."""
    numbers[0] = 0.0


@kernel
def unlike(numbers: F64s) -> None:
    """Do."""
    numbers[0] = 1.0 if numbers[1] > 0.0 else numbers[2] > 0.0


@kernel
def unknown(numbers: F64s) -> None:
    """Do."""
    numbers[0] = nothing(numbers[1])  # type: ignore[name-defined]  # noqa: F821


@kernel
def named(numbers: F64s) -> None:
    """Do."""
    reduced(numbers[0], by=1)


@kernel
def of_truth(numbers: F64s) -> None:
    """Do."""
    numbers[0] = f64(numbers[1] > 0.0)


@kernel
def too_many(numbers: F64s) -> None:
    """Do."""
    x, y = 1.0, 2.0, 3.0  # type: ignore[misc]
    numbers[0] = x + y


@kernel
def two_rows(numbers: F64s) -> None:
    """Do."""
    row = numbers
    row = numbers
    numbers[0] = row[1]


@kernel
def of_nothing(numbers: F64s) -> None:
    """Do."""
    x: Any = library_sine(numbers)  # type: ignore[func-returns-value]
    numbers[0] = x


@kernel
def over_a_number(numbers: F64s) -> None:
    """Do."""
    one: Any = numbers[0]
    for x in one:
        numbers[1] = x


@kernel
def fraction(numbers: F64s) -> float:
    """Do."""
    return numbers[0]


@kernel
def by_itself(numbers: F64s) -> None:
    """Do."""
    y = y + numbers[0]  # type: ignore[has-type]  # noqa: F821
    numbers[1] = y


@kernel
def recursive(numbers: F64s) -> None:
    """Do."""
    recursive(numbers)


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (library_sine, "call of math.sin, which is no kernel"),
        (asks_inside, "a call of Python inside an expression: give it a statement"),
        (asks_for_truth, "a call of Python inside an expression: give it a statement"),
        (asks_and_goes_on, "a call of Python: the function must return an integer"),
        (listed, "call of max, which is no kernel"),
        (by_float, "an index is f64, not i64"),
        (by_itself, "y is read before it has a value"),
        (beyond, "index 11: f64 array of 11 has 0..10"),
        (retyped, "i64 = f64"),
        (untyped, "typing.Any has no equal in C"),
        (recursive, "recursive calls itself: recursion"),
        (unlike, "f64 or bool"),
        (unknown, "call nothing(numbers[1])"),
        (named, "call reduced(numbers[0], by=1)"),
        (of_truth, "f64(numbers[1] > 0.0) of bool"),
        (too_many, "2 places for 3 values"),
        (of_nothing, "f64 = None"),
        (two_rows, "local row of type f64 array (in two_rows)"),
        (over_a_number, "a loop runs over a range or a constant tuple"),
        (fraction, "returns a float: a method of CPython returns whole numbers"),
        (swap, "takes 1 arguments, not 2"),
    ],
)
def test_what_has_no_equal_in_c_is_refused(function: Any, reason: str) -> None:
    arrays = fresh([0.0, 0.0], 0, 0)[: 2 if function is swap else 1]
    if function.__name__.startswith("asks"):
        arrays = (np.zeros(1, np.int64),)
    with pytest.raises(ExportError) as refused:
        translate((function,), arrays)
    assert reason in str(refused.value)


def test_memory_of_another_kind_is_refused() -> None:
    """The addresses of a bound call carry no types."""

    with pytest.raises(ExportError, match="int64 is not its memory"):
        translate((swap,), (np.zeros(3, np.int64),))


@pytest.mark.skipif("zig" not in IDS, reason="no ziglang")
def test_a_system_compiler_that_does_not_work_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "gcc"
    broken.write_text("#!/bin/sh\nexit 1\n")
    broken.chmod(0o700)
    monkeypatch.setenv("PATH", str(tmp_path))
    numbers = np.array([1.0, 2.0, 0.0])
    path = library((swap,), (numbers,))
    bound_in(path, METHOD + "swap", numbers)()
    assert numbers.tolist() == [2.0, 1.0, 0.0]


class Asked(Struct):
    """Functions of Python, and their answers."""

    function: i64
    answers: i64


@kernel
def ask(asked: Asked) -> int:
    """Ask."""
    answer = call(asked.function)
    asked.answers += 1
    return answer


@kernel
def ask_twice(asked: Asked) -> int:
    """Ask."""
    first = ask(asked)
    second = ask(asked)
    return 10 * first + second


@pytest.mark.parametrize("plain", [False, True], ids=["c", "plain"])
def test_a_kernel_calls_python_and_ends_where_that_raises(
    plain: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiling, "PLAIN", plain)
    asked, answers = Asked.allocate(), [7, 3, 5]
    asked.connect(function=lambda: answers.pop())
    ask_both = bound(ask_twice, asked)
    assert ask_both() == 53
    with pytest.raises(IndexError, match="pop from empty list"):
        ask_both()
    assert asked.fields.answers == 3
    asked.connect(function=lambda: None)
    assert ask_both() == 0
    asked.connect(function=lambda: "one")  # type: ignore[arg-type,return-value]
    with pytest.raises((TypeError, ValueError)):
        ask_both()
    assert asked.fields.answers == 5
