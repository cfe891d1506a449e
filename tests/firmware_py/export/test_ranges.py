"""What the translator knows of whole numbers is what trying all of them shows."""

import ast

import pytest

from firmware_py.export.literals import constant_literal
from firmware_py.export.ranges import FULL, Ranges
from firmware_py.export.syntax import I32, Constant, Module, Signature, StructField, StructType, ValueType

WIDE = range(-60, 61)  # stands for all whole numbers: an end that it reaches is none
MODULE = Module("own", "own.py", "", own=True, names={"MANY": Constant("MANY", I32, "4", "", False)})


def expression(text: str) -> ast.expr:
    return ast.parse(text, mode="eval").body


def narrowed(test: str, holds: bool = True) -> Ranges:
    found = Ranges(MODULE, {"n": I32}, I32)
    found.narrow(expression(test), holds)
    return found


def values(test: str, holds: bool = True) -> list[int]:
    return [n for n in WIDE if eval(test, {"n": n, "MANY": 4}) is holds]


def ends(numbers: list[int]) -> tuple[int, int] | None:
    """Return the least and the greatest number, as `Ranges` has them."""
    low = FULL[0] if min(numbers) == WIDE[0] else min(numbers)
    high = FULL[1] if max(numbers) == WIDE[-1] else max(numbers)
    return None if (low, high) == FULL else (low, high)


SIGNS = ("<", "<=", ">", ">=", "==", "!=")
TESTS = [
    *(f"n {sign} {number}" for sign in SIGNS for number in ("3", "-2", "MANY")), *(f"5 {sign} n" for sign in SIGNS),
    "n >= 0 and n < MANY", "n < -3 or n > 7", "not n > 2", "not (n < 1 or n >= 6)", "n > 2 and not n >= 9",
    "0 < n and n < 2",
]  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("holds", [True, False])
@pytest.mark.parametrize("test", TESTS)
def test_a_condition_bounds_a_number_to_those_for_which_it_holds(test: str, holds: bool) -> None:
    known, possible = narrowed(test, holds).of(expression("n")), values(test, holds)
    turned = holds == test.startswith("not (")
    open_ended = (" and " if turned else " or ") in test  # one of several is enough: they are not joined
    assert known == (None if open_ended else ends(possible))


GUARD = "n >= -3 and n <= 5"
EXPRESSIONS = (
    "n", "7", "-7", "MANY", "n + 2", "n - 2", "2 - n", "n * 3", "n * -3", "MANY * n", "n % 4", "(n + 1) % MANY", "min(n, 2)",
    "max(n, 2)", "min(n, 9)", "max(n, -9)", "min(max(n, 0), 3)", "max(min(n, 4), -1) + n * 0", "i32(n)", "i32(-2)",
    "charged_end(0, 0, n, 1)",
)  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("text", EXPRESSIONS)
def test_an_expression_has_the_values_that_its_numbers_give(text: str) -> None:
    scope = {"MANY": 4, "i32": int, "charged_end": lambda budget, begin, end, step: end}
    tried = [eval(text, scope | {"n": n}) for n in values(GUARD)]
    assert narrowed(GUARD).of(expression(text)) == (0, 3) if "% " in text else (min(tried), max(tried))


@pytest.mark.parametrize("number", [0, 2**31 - 1, 1 - 2**31, 2**31, -(2**31), 2**40])
def test_a_constant_is_a_number_of_32_bits_but_the_least(number: int) -> None:
    """C has no literal of the least: it is the negative of one that is too large."""
    fits = abs(number) < 2**31
    for text in (str(number), f"i32({number})"):
        assert constant_literal(expression(text)) == ((I32, str(number)) if fits else None)


@pytest.mark.parametrize(
    "text", ["n % m", "n // 2", "m", "m + 1", "n % (n + 3)", "f(n)", "n + 2147483647", "n * 2147483647"]
)
def test_of_other_expressions_nothing_is_known(text: str) -> None:
    assert narrowed(GUARD).of(expression(text)) is None


def test_the_bounds_of_whole_numbers_are_those_of_32_bits() -> None:
    assert narrowed("n > 0").of(expression("n + 0")) == (1, 2**31 - 1)
    assert narrowed("n > 0").of(expression("n + 1")) is None
    assert narrowed("n < 0").of(expression("n - 0")) == (-(2**31), -1)
    assert narrowed("n < 0").of(expression("n - 1")) is None


LIMITS = (
    "5",
    "0",
    "-2",
    "2, 5",
    "5, 2",
    "-3, 3",
    "3, 3",
    "0, 7, 2",
    "1, 7, 3",
    "7, 1, -1",
    "7, 1, -2",
    "1, 7, -1",
    "MANY",
    "4, 5",
    "5, 4, -1",
)


@pytest.mark.parametrize("limits", LIMITS)
def test_a_loop_variable_is_within_its_range(limits: str) -> None:
    numbers = range(*eval(f"({limits},)", {"MANY": 4}))
    call = expression(f"range({limits})")
    assert isinstance(call, ast.Call)
    found = narrowed(GUARD)
    assert found.runs(call.args) == (len(numbers) > 0)
    beyond = numbers.stop - 1 if numbers.step > 0 else numbers.stop + 1
    assert found.loop(call.args) == (tuple(sorted((numbers.start, beyond))) if numbers else None)
    assert found.step(call.args) == numbers.step


@pytest.mark.parametrize(
    ("limits", "reach", "runs"),
    [
        ("n", (0, 4), False), ("n + 4", (0, 8), True), ("n + 3", (0, 7), False), ("n, 7", (-3, 6), True),
        ("n, 6", (-3, 5), True), ("n, 5", (-3, 4), False), ("m", None, False), ("m, 5", None, False),
        ("7, n, -1", (-2, 7), True),
        ("6, n, -1", (-2, 6), True), ("5, n, -1", (-2, 5), False), ("n, -4, -1", (-3, 5), True),
        ("n, -3, -1", (-2, 5), False), ("0, 2147483647", (0, 2**31 - 2), True),
        ("0, 2147483647, 2", None, True),
    ],
)  # fmt: skip
def test_a_loop_up_to_a_known_number_is_bounded(
    limits: str, reach: tuple[int, int] | None, runs: bool
) -> None:
    call = expression(f"range({limits})")
    assert isinstance(call, ast.Call)
    found = narrowed(GUARD)
    assert (found.loop(call.args), found.runs(call.args)) == (reach, runs)


def test_what_a_statement_may_change_is_forgotten() -> None:
    """Two arguments may be the same memory, and a kernel may write to any."""
    struct = StructType("Memory", "", {"k": StructField("k", I32, "", "", 1)})
    memory = ValueType("Memory", struct=struct)
    function = ast.parse("def f() -> i32:\n    return 1").body[0]
    assert isinstance(function, ast.FunctionDef)
    module = Module("own", "own.py", "", own=True)
    module.names["f"] = Signature("f", "own.py", function, {}, I32, False, module)
    for statement, left in (
        ("a.k = 1", {"n", "a.m"}), ("n = 1", {"a.k", "b.k", "a.m"}), ("m = n", {"n", "a.k", "b.k", "a.m"}),
        ("m = f()", {"n"}),
        ("m = sqrt(n)", {"n", "a.k", "b.k", "a.m"}), ("for i in range(n):\n    b.k = 2", {"n", "a.m"}),
    ):  # fmt: skip
        found = Ranges(module, {"n": I32, "m": I32, "a": memory, "b": memory}, I32)
        found.known = dict.fromkeys(("n", "a.k", "b.k", "a.m"), (0, 3))
        found.forget(ast.parse(statement))
        assert found.known.keys() == left, statement
    found.known = dict.fromkeys(("n", "a.k", "b.k", "a.m"), (0, 3))
    found.assign(expression("b.k"), (1, 2))
    assert found.known == {"n": (0, 3), "b.k": (1, 2), "a.m": (0, 3)}


def test_behind_two_paths_holds_what_both_have() -> None:
    for one, other, both in (
        ((0, 3), (2, 5), (0, 5)),
        ((2, 5), (0, 3), (0, 5)),
        ((1, 2), (0, 9), (0, 9)),
        ((0, 9), (1, 2), (0, 9)),
    ):
        found = narrowed("n > 0")
        found.known = {"n": one, "m": (1, 1)}
        found.join({"n": other, "k": (1, 1)})
        assert found.known == {"n": both}
