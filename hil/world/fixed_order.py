"""Linear algebra in a fixed order, and compiled elementary functions: the same bits on every processor.

BLAS and LAPACK, behind numpy's `@` and `numpy.linalg`, choose code by processor and sum in different orders, so flights
do not use them. This file suits the few small matrices of a flight. Normal noise also has the same bits everywhere.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py import compiling, elementary

# The dependencies of the laboratory's compiled functions, besides their own files.
SOURCES = (
    Path(__file__).parent,
    Path(compiling.__file__).with_name("elementary.py"),
    Path(compiling.__file__).with_name("core"),
)
TRANSLATOR = Path(compiling.__file__).with_name("export")


def in_c(function: Callable[..., Any], arrays: compiling.Arrays) -> Path | None:
    """Return a kernel's library; None where no C compiler makes it."""
    from firmware_py.export.kernels import library  # not needed where one is kept

    return library(function, arrays)


compiled = compiling.compiler(*SOURCES, TRANSLATOR, library=in_c)

Matrix = NDArray[np.float64]
SWEEPS_MAX = 50  # of Jacobi's method; 4 to 6 are usual
NEGLIGIBLE = 1e-36  # sum of squares off the diagonal, as a share of all

sine_ahead = compiled(elementary.sine_ahead)
exp = compiled(elementary.exp)
atan2 = compiled(elementary.atan2)


@compiled
def product(A: Matrix, B: Matrix) -> Matrix:
    """Return the product of two matrices."""
    C = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            for k in range(A.shape[1]):
                C[i, j] += A[i, k] * B[k, j]
    return C


@compiled
def eigen(S: Matrix) -> tuple[Matrix, Matrix]:
    """Return eigenvalues (N,) and vectors (N, N), one a column, of a symmetric matrix; Jacobi's method, row by row."""
    A = S.copy()
    n = A.shape[0]
    V = np.eye(n)
    for _ in range(SWEEPS_MAX):
        beside, everything = 0.0, 0.0
        for p in range(n):
            for q in range(n):
                square = A[p, q] * A[p, q]
                everything += square
                if p != q:
                    beside += square
        if beside <= NEGLIGIBLE * everything:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if A[p, q] == 0.0:
                    continue
                ratio = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
                tangent = math.copysign(1.0, ratio) / (abs(ratio) + math.sqrt(ratio * ratio + 1.0))
                cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
                sine = tangent * cosine
                for k in range(n):  # columns
                    a, b = A[k, p], A[k, q]
                    A[k, p], A[k, q] = cosine * a - sine * b, sine * a + cosine * b
                    a, b = V[k, p], V[k, q]
                    V[k, p], V[k, q] = cosine * a - sine * b, sine * a + cosine * b
                for k in range(n):  # rows
                    a, b = A[p, k], A[q, k]
                    A[p, k], A[q, k] = cosine * a - sine * b, sine * a + cosine * b
    return np.diag(A).copy(), V


def fit_polynomial(x: Matrix, y: Matrix, order: int) -> Matrix:
    """Return the coefficients (order + 1,), from the constant on, of the least-squares polynomial through points (N,).

    Forsythe's polynomials are orthogonal on the points, so every coefficient is a separate sum: no equations to solve,
    and nothing is ill-conditioned. `fsum` rounds once, in any order.
    """
    fit = np.zeros(order + 1)
    before, now = np.zeros(order + 1), np.eye(1, order + 1)[0]  # coefficients of two successive polynomials
    values_before, values = np.zeros(len(x)), np.ones(len(x))
    norm_before = 1.0
    for degree in range(order + 1):
        norm = math.fsum(values * values)
        fit += math.fsum(values * y) / norm * now
        if degree < order:
            middle, share = math.fsum(x * values * values) / norm, norm / norm_before
            following = np.concatenate([[0.0], now[:-1]]) - middle * now - (share * before if degree else 0.0)
            values_before, values = values, (x - middle) * values - (share * values_before if degree else 0.0)
            before, now, norm_before = now, following, norm
    return fit


STEPS = 65536.0  # per standard deviation


def normal(rng: np.random.Generator, shape: int | tuple[int, ...]) -> NDArray[np.float64]:
    """Return numbers of the standard normal distribution, rounded to 1 / `STEPS`.

    Beyond 3.65, numpy uses the C library's logarithm, whose last bit differs; rounding removes that.
    """
    return np.asarray(np.rint(rng.standard_normal(shape) * STEPS) / STEPS)
