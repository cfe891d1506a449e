"""Edges of the pytest plugin's choices and folders, without a flight."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hil.board.imu import COS, SIN
from hil.config import load_config
from hil.laboratory.request import Options
from hil.testing.board import BareBoard
from hil.testing.choices import name_of
from hil.testing.flights import NAME_MAX, SHOWN, Item, folder_of, shown_of
from hil.testing.strategies import _round_step
from support.choices import choice


def test_a_name_tells_only_what_differs_between_the_choices() -> None:
    two = [choice(1), choice(2)]
    assert [name_of(one, two) for one in two] == ["seed1", "seed2"]
    boards = [choice(1, "c"), choice(1, "python")]
    assert [name_of(one, boards) for one in boards] == ["c", "python"]
    assert name_of(choice(), [choice()]) == ""
    faulty: list[Options] = [{**choice(), "faults": ("push.y@1=1", "push.x@2=1")}, {**choice(), "faults": ()}]
    assert [name_of(one, faulty) for one in faulty] == ["push.y@1=1+push.x@2=1", "no-fault"]


@pytest.mark.parametrize("count", [1, SHOWN, SHOWN + 1])
def test_of_a_few_flights_all_are_shown_and_of_more_the_last(count: int) -> None:
    flown: Any = [SimpleNamespace(number=number) for number in range(count)]
    shown = [one.number for one in shown_of(Item("x", Path(), Path(), choice(), flown))]
    assert shown == (list(range(count)) if count <= SHOWN else [count - 1])


def test_names_that_differ_in_what_a_folder_cannot_have_get_folders_of_their_own() -> None:
    names = [
        "a[1]", "a-1", "a(1)", "a.py::test[x/y]", "a.py::test[x y]", "a" * NAME_MAX, "a" * (NAME_MAX + 1),
    ]  # fmt: skip
    names += ["x" * (NAME_MAX + 20), "x" * (NAME_MAX + 20) + "y"]
    folders = [folder_of(name) for name in names]
    assert len(set(folders)) == len(names)
    assert folders[1] == "a-1"
    assert all(re.fullmatch(r"[\w.-]{1,100}", folder) for folder in folders)


@pytest.mark.parametrize(
    ("step", "rounded"),
    [(0.1, 0.1), (0.11, 0.2), (0.2, 0.2), (0.21, 0.5), (0.5, 0.5), (0.51, 1.0), (3e-4, 5e-4)],
)
def test_a_step_is_the_next_round_number(step: float, rounded: float) -> None:
    assert _round_step(step) == pytest.approx(rounded)


def test_what_the_imu_is_fed_is_turned_by_45_degrees_and_ends_at_its_range() -> None:
    board = BareBoard(load_config())
    board.feed_imu(omega_B=(1.0, 0.0, 0.5))
    gx, gy, gz, *_ = board._board.imu
    assert gx / gz == pytest.approx(2 * COS, rel=0.01)
    assert gy / gz == pytest.approx(-2 * SIN, rel=0.01)
    board.feed_imu(omega_B=(0.0, 0.0, 1e3), f_B=(0.0, 0.0, -1e3))
    assert board._board.imu[2] == 32767
    assert board._board.imu[5] == -32768


def test_a_packet_that_is_hushed_is_not_repeated_beside_the_next_one() -> None:
    board = BareBoard(load_config())
    arrived: list[bytes] = []
    board._arrive = arrived.append  # type: ignore[method-assign]
    board.receive(b"\x30a", every_ms=10)
    board.stop_repeating()
    board.receive(b"\x30b", every_ms=10)
    board.run(ms=35)
    assert arrived == [b"\x30a", *[b"\x30b"] * 4]


def test_an_expectation_goes_no_further_than_it_may() -> None:
    board = BareBoard(load_config())
    with pytest.raises(AssertionError, match=r"not printed within 2\.5 ms"):
        board.expect("never", within_ms=2.5)
    assert board.now_us == 2_500
