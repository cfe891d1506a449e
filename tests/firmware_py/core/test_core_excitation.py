"""The excitation on board: spectra by numpy's FFT and phases by scipy's chirp, not by our own output."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import chirp

from firmware_py.config import SIGNALS, parameters_of
from firmware_py.core.excitation import PERIOD, REALISATION, REALISATIONS
from firmware_py.core.structs import EXCITE_CHIRP, EXCITE_MULTISINE, EXCITE_OFF, MODE_FLY, MODE_HOVER
from firmware_py.core_runner import CoreBlocks, default_runner
from hil.config import load_config

BAND = ("excitation.low=0.2", "excitation.high=8")
RMS = {"u1": 0.05, "u2": 0.08, "u3": 0.06, "u4": 0.07}


class Board:
    """The controller alone, at rest at its goal."""

    def __init__(self, kind: int, **rms: float) -> None:
        overrides = (*BAND, *(f"excitation.{name}={value}" for name, value in rms.items()))
        self.core = CoreBlocks(parameters_of(load_config("floaty", overrides)), default_runner)
        self.parameters, self.data, self.control = self.core.parameters, self.core.data, self.core.control
        self.data.fields.mode = MODE_FLY
        self.parameters.fields.excite_kind = kind

    def tick(self) -> NDArray[np.float64]:
        self.core.run.call("control")
        return self.control.fields.excitation.astype(float)

    def fly(self, ticks: int = PERIOD) -> NDArray[np.float64]:
        return np.array([self.tick() for _ in range(ticks)])


def amplitudes(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    found: NDArray[np.float64] = 2 * np.abs(np.fft.rfft(samples, axis=0)) / len(samples)
    return found


def test_a_multisine_has_its_rms_and_odd_lines_of_its_own_inside_the_band() -> None:
    samples = Board(EXCITE_MULTISINE, **RMS).fly()
    assert samples.std(axis=0) == pytest.approx(list(RMS.values()), rel=1e-4)
    lines = [set(np.flatnonzero(amplitudes(samples)[:, i] > 1e-4).tolist()) for i in range(4)]
    together = set.union(*lines)
    assert sum(map(len, lines)) == len(together)  # no two inputs share a line
    assert together == {n for n in range(1, PERIOD) if n % 2 and 0.2 <= n / 20 <= 8.0}
    assert min(map(len, lines)) >= 19


def test_an_input_has_the_same_lines_whatever_others_are_excited() -> None:
    alone, together = Board(EXCITE_MULTISINE, u2=0.08).fly(), Board(EXCITE_MULTISINE, **RMS).fly()
    assert np.array_equal(alone[:, 1], together[:, 1])
    assert not alone[:, [0, 2, 3]].any()


def test_a_realisation_is_periodic_and_the_next_has_other_phases_on_the_same_lines() -> None:
    both = Board(EXCITE_MULTISINE, **RMS).fly(2 * REALISATION)
    settling = REALISATION - PERIOD
    for samples in (both[:REALISATION], both[REALISATION:]):
        assert samples[:settling] == pytest.approx(samples[PERIOD:], abs=1e-6)
    first, second = (np.fft.rfft(part, axis=0) for part in (both[settling:REALISATION], both[-PERIOD:]))
    assert np.abs(first) == pytest.approx(np.abs(second), abs=2e-2)
    for i in range(4):
        lines = np.abs(first[:, i]) > 1.0
        turned = np.angle(second[lines, i] / first[lines, i])
        assert np.abs(np.exp(1j * turned).mean()) < 0.5  # random phases differ in all directions


@pytest.mark.long
def test_the_first_realisation_follows_the_last_and_peaks_stay_low() -> None:
    board = Board(EXCITE_MULTISINE, **RMS)
    every = board.fly(REALISATION * REALISATIONS)
    assert np.array_equal(board.fly(50), every[:50])
    assert (np.abs(every).max(axis=0) < 4.0 * every.std(axis=0)).all()


def test_a_chirp_sweeps_the_band_in_a_period() -> None:
    samples = Board(EXCITE_CHIRP, u3=0.1).fly()
    t = 0.01 * np.arange(PERIOD)
    expected = 0.1 * np.sqrt(2) * chirp(t, 0.2, 20.0, 8.0, phi=-90)
    assert samples[:, 2] == pytest.approx(expected, abs=2e-4)


def test_what_is_excited_comes_on_top_of_the_inputs_and_out_at_the_flaps() -> None:
    board = Board(EXCITE_MULTISINE, u1=0.05)
    for _ in range(50):
        part = board.tick()
        assert board.control.fields.u == pytest.approx(part)
        assert board.control.fields.command == pytest.approx(part[0] * np.array([1, 1, -1, -1]), abs=1e-6)


def test_reported_inputs_are_the_mean_of_a_tick_and_the_one_before() -> None:
    board = Board(EXCITE_MULTISINE, **RMS)
    u, reported = np.array([
        (board.control.fields.u.astype(float), board.control.fields.u_mean.astype(float))
        for _ in range(50)
        if len(board.tick())
    ]).swapaxes(0, 1)  # fmt: skip
    assert reported == pytest.approx(0.5 * (u + np.concatenate([np.zeros((1, 4)), u[:-1]])), abs=1e-7)
    board.data.fields.mode = MODE_HOVER
    board.fly(2)
    assert not board.control.fields.u_mean.any()


def test_excitation_stops_when_off_or_open_loop_and_restarts_its_period() -> None:
    board = Board(EXCITE_OFF, **RMS)
    assert not board.fly(20).any()
    board.parameters.fields.excite_kind = EXCITE_MULTISINE
    first = board.fly(20)
    board.data.fields.mode = MODE_HOVER
    assert not board.fly(5).any()
    board.data.fields.mode = MODE_FLY
    assert np.array_equal(board.fly(20), first)
    board.parameters.fields.excite_kind = EXCITE_OFF
    assert not board.fly(1).any()
    board.parameters.fields.excite_kind = EXCITE_MULTISINE
    assert np.array_equal(board.fly(20), first)


def test_the_signals_have_the_numbers_of_the_parameter() -> None:
    assert [SIGNALS[kind] for kind in (EXCITE_OFF, EXCITE_MULTISINE, EXCITE_CHIRP)] == [
        "off", "multisine", "chirp",
    ]  # fmt: skip
