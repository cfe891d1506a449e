"""What fits an annotation, and how it is described to a user."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

import numpy as np
import pytest

from hil.errors import LabError
from hil.laboratory.arguments import Known, _described, checked, fits

FITS: list[tuple[Any, tuple[Any, ...], tuple[Any, ...]]] = [
    (float, (1, 1.5, np.float32(2), float("inf"), float("nan")), (True, "1", None, 10**400, 1j)),
    (int, (1, -3, np.int64(2)), (1.0, False, "1", 10**400)),
    (str, ("", "a\n"), (1, None, b"a", "\ud800", Path("a"))),
    (Path, (Path("a"),), ("a", Path("\ud800"))),
    (bool, (True, False), (1, None)),
    (float | None, (None, 2), ("", [])),
    (Literal["max", "min"], ("max", "min"), ("mean", 1, None)),
    (Callable[[float], float], (abs, lambda x: x), (1, "abs")),
    (Mapping[str, float], ({}, {"a": 1}), ([("a", 1)], {"a": "b"}, {1: 1.0})),
    (tuple[float, float, float], ((1, 2, 3), [1, 2.5, 3]), ((1, 2), (1, 2, 3, 4), (1, 2, "3"), "abc", {1, 2, 3})),
    (tuple[str, ...], ((), ("a", "b"), ["a"]), (("a", 1), "ab")),
    (Sequence[float], ((), [1, 2]), ([1, "2"], np.arange(2), "12")),
    (Iterable[str], (["a"], ()), (["a", 1], "a")),
    (Any, (None, object()), ()),
    (LabError, (LabError("a"),), (ValueError("a"),)),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "good", "bad"), FITS, ids=[str(kind) for kind, _, _ in FITS])
def test_a_value_fits_an_annotation(kind: Any, good: tuple[Any, ...], bad: tuple[Any, ...]) -> None:
    assert [fits(one, kind) for one in good] == [True] * len(good)
    assert [fits(one, kind) for one in bad] == [False] * len(bad)


@checked
def called(first: float, *rest: str, name: Literal["a", "b", "c"] = "a", **more: int) -> Any:
    return first, rest, name, more


class Wishes(TypedDict, total=False):
    seed: int
    profile: str


@checked
def asked(name: str, **wishes: Unpack[Wishes]) -> Any:
    return name, wishes


@checked
class Made:
    def __init__(self, x: float, y: tuple[float, float] = (0.0, 0.0)) -> None:
        self.x, self.y = x, y


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (lambda: called("1"), "called: first = '1': expected a number"),
        (lambda: called(1, "a", 2), "called: rest = 2: expected text"),
        (lambda: called(1, name="d"), "called: name = 'd': expected 'a', 'b' or 'c'"),
        (lambda: called(), "called: missing a required argument: 'first'"),
        (lambda: called(1, first=2), "called: multiple values for argument 'first'"),
        (lambda: asked("a", seed=1, profile=2), "asked: profile = 2: expected text"),
        (lambda: asked("a", profile="b", seed="c"), "asked: seed = 'c': expected a whole number"),
        (lambda: asked("a", sead=1), "asked: unknown argument 'sead'; did you mean seed?"),
        (lambda: Made(1, z=2), "Made: unknown argument 'z'; there are x, y"),
        (lambda: Made(1, (1, 2, 3)), "Made: y = (1, 2, 3): expected "),
        (lambda: Known("flap", {"left": 1})["lefd"], "flap 'lefd': there is none; did you mean left?"),
    ],
)
def test_a_wrong_call_is_one_line(call: Callable[[], Any], error: str) -> None:
    with pytest.raises(LabError) as refused:
        call()
    assert str(refused.value).startswith(error)


def test_a_right_call_gets_its_values_and_numbers_of_numpy_as_those_of_python() -> None:
    first, rest, name, more = called(np.float64(1.5), "a", "b", name="c")
    assert (first, rest, name, more, type(first)) == (1.5, ("a", "b"), "c", {}, float)
    assert asked("a", seed=np.int64(7), profile="b") == ("a", {"seed": 7, "profile": "b"})
    made = Made(np.int32(3), y=(1, 2))
    assert (made.x, made.y, type(made.x)) == (3, (1, 2), int)


@pytest.mark.parametrize(("kind", "text"), [
    (Literal["a"], "'a'"), (Literal["a", "b"], "'a' or 'b'"), (Literal["a", "b", "c"], "'a', 'b' or 'c'"),
    (Callable[[int], str], "a function"), (Mapping[str, float], "a dictionary of a number by name"),
    (tuple[float, float, float], "3 times a number"), (Sequence[str], "a list of text"), (tuple[str, ...], "a list of text"),
    (float | str, "a number or text"),
])  # fmt: skip
def test_an_annotation_is_described_in_words(kind: Any, text: str) -> None:
    assert _described(kind) == text
