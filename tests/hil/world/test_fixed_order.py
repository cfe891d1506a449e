"""The arithmetic in a fixed order against LAPACK's, and noise without last bits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from firmware_py import compiling
from hil.world.fixed_order import STEPS, eigen, fit_polynomial, normal, product

shapes = st.tuples(st.integers(1, 6), st.integers(1, 6), st.integers(1, 6))
seeds = st.integers(0, 2**32)


@pytest.mark.long
@given(shapes, seeds)
def test_product_is_numpys(shape: tuple[int, int, int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B = rng.standard_normal(shape[:2]), rng.standard_normal(shape[1:])
    assert product(A, B) == pytest.approx(A @ B, abs=1e-13)
    assert product(A, B.T.copy().T) == pytest.approx(A @ B, abs=1e-13)


@pytest.mark.long
@given(st.integers(1, 4), st.integers(0, 6), seeds)
def test_eigenvalues_and_vectors_are_numpys(size: int, rank: int, seed: int) -> None:
    A = np.random.default_rng(seed).standard_normal((size, rank))
    S = A @ A.T
    values, V = eigen(S)
    assert np.sort(values) == pytest.approx(np.linalg.eigvalsh(S), abs=1e-12)
    assert np.diag(values) == pytest.approx(V.T @ S @ V, abs=1e-12)
    assert np.eye(size) == pytest.approx(V.T @ V, abs=1e-13)
    for scale in (2.0**-60, 2.0**60):
        scaled, same = eigen(scale * S)
        assert (scaled == scale * values).all()
        assert (same == V).all()


@pytest.mark.long
@given(st.integers(0, 6), st.integers(7, 50), seeds)
def test_polynomial_is_that_of_least_squares(order: int, points: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = np.linspace(-0.7, 1.0, points), rng.standard_normal(points)
    expected = np.polynomial.polynomial.polyfit(x, y, order)
    assert fit_polynomial(x, y, order) == pytest.approx(expected, rel=1e-9, abs=1e-9)


class OtherLibrary:
    """A generator whose logarithm differs in the last bit."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def standard_normal(self, shape: int) -> np.ndarray:
        return np.nextafter(self._rng.standard_normal(shape), np.inf)


def test_noise_has_the_same_bits_whatever_the_last_bit_of_a_logarithm() -> None:
    ours = normal(np.random.default_rng(1), 100_000)
    assert (ours == normal(OtherLibrary(np.random.default_rng(1)), 100_000)).all()


@pytest.mark.long
def test_noise_is_numpys_to_the_rounding_and_normal() -> None:
    drawn = normal(np.random.default_rng(2), 20_000)
    assert drawn == pytest.approx(np.random.default_rng(2).standard_normal(20_000), abs=0.5 / STEPS)
    assert kstest(drawn, "norm").pvalue > 0.01


@pytest.mark.parametrize("plain", [False, True])
def test_an_element_next_to_zero_is_no_warning_in_c_and_in_python(
    plain: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiling, "PLAIN", plain)
    S = np.array([[1.0, 0.5, 5e-324], [0.5, 2.0, 0.0], [5e-324, 0.0, 3.0]])
    assert sorted(eigen(S)[0]) == pytest.approx(np.linalg.eigvalsh(S))
