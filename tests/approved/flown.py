"""Tests for an approved run of pytest with the plugin: those that pass, that fail in each way, and that cannot fly."""

from typing import Any

import pytest

from hil import Experiment
from hil.testing.flights import Flights

SHORT: Any = {"duration_s": 0.1}


@pytest.mark.floaty(seeds=2)
def test_two_seeds(floaty: Flights) -> None:
    run = floaty.fly(**SHORT)
    assert run.result.request.seed == floaty.seed


@pytest.mark.floaty(profiles=["original", "floaty"], faults=["push.y@0.05=0.5"])
def test_two_profiles(floaty: Flights) -> None:
    assert floaty.fly("yaw-step", seed=3, **SHORT).metrics["rms_y"] < 1e-9


@pytest.mark.floaty(seeds=[6])
class TestMarked:
    def test_of_the_class(self, floaty: Flights) -> None:
        assert floaty.seed == 6

    @pytest.mark.floaty(seeds=[7, 8])
    def test_of_its_own(self, floaty: Flights) -> None:
        assert floaty.seed == 7


@pytest.mark.floaty(seeds=[4, 9], boards=["c", "python"])
def test_four_choices(floaty: Flights) -> None:
    assert (floaty.target, floaty.seed) != ("python", 9)


def test_many_flights(floaty: Flights) -> None:
    hashes = [floaty.fly(seed=seed, **SHORT).hash for seed in (1, 2, 1)]
    assert hashes[0] == hashes[1]


def test_an_own_experiment(floaty: Flights) -> None:
    assert floaty.fly(Experiment("mine", "", 0.1, {"rms_x": 1e-9})).passed


def test_a_baseline(floaty: Flights) -> None:
    floaty.fly(**SHORT)
    floaty.fly(seed=2, **SHORT)
    floaty.baseline("hover", metrics=["rms_x", "max_z"])


def test_another_baseline(floaty: Flights) -> None:
    for seed in (1, 5):
        floaty.fly(seed=seed, faults=["push.x@0.02=2"], **SHORT)
    floaty.baseline("hover", rel=0.5)


@pytest.mark.parametrize("experiment", ["hovar", "hover"])
def test_a_wrong_request(floaty: Flights, experiment: str) -> None:
    floaty.fly(experiment, overrides=["controller.gain_yy=1"], **SHORT)


@pytest.mark.floaty(needs="mavlink")
def test_another_link(floaty: Flights) -> None:
    pass


def test_a_board(floaty: Flights) -> None:
    board = floaty.board()
    board.run(0.5)
    assert board.counts == ()
