"""Linear algebra in a fixed order, and compiled elementary functions: the same bits on every processor.

BLAS and LAPACK, behind numpy's `@` and `numpy.linalg`, choose code by processor and sum in different orders, so flights
do not use them. This file suits the few small matrices of a flight. Normal noise also has the same bits everywhere.
"""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_py import compiling, elementary
from firmware_py.core.subset import F64s, Integer

# The dependencies of the laboratory's kernels, besides their own files.
SOURCES = (
    Path(__file__).parent,
    Path(compiling.__file__).with_name("elementary.py"),
    Path(compiling.__file__).with_name("core"),
)

compiled = compiling.compiler(*SOURCES)

Matrix = NDArray[np.float64]
SIZE = 4  # of the largest matrix with eigenvalues, a turn's
SWEEPS_MAX = 50  # of Jacobi's method; 4 to 6 are usual
NEGLIGIBLE = 1e-36  # sum of squares off the diagonal, as a share of all

sine_ahead = compiled(elementary.sine_ahead)
exp = compiled(elementary.exp)
atan2 = compiled(elementary.atan2)


def product(A: Matrix, B: Matrix) -> Matrix:
    """Return the product of two matrices."""
    C = np.zeros((A.shape[0], B.shape[1]))
    for k in range(A.shape[1]):
        C += A[:, k, None] * B[k]
    return C


def eigen(S: Matrix) -> tuple[Matrix, Matrix]:
    """Return eigenvalues (N,) and vectors (N, N), one a column, of a symmetric matrix; N <= 4; Jacobi's method."""
    n, A, V = len(S), np.zeros((SIZE, SIZE)), np.eye(SIZE)
    A[:n, :n] = S
    compiling.bound(diagonalise, A, V)()
    return np.diag(A)[:n].copy(), V[:n, :n]


@compiled
def turn(A: F64s, p: Integer, q: Integer, cosine: float, sine: float) -> None:
    """Turn two columns of a square matrix into each other."""
    for k in range(SIZE):
        a, b = A[k, p], A[k, q]
        A[k, p], A[k, q] = cosine * a - sine * b, sine * a + cosine * b


@compiled
def annul(A: F64s, V: F64s, p: Integer, q: Integer) -> None:
    """Turn a symmetric matrix so that its element (p, q) vanishes, and the vectors with it."""
    ratio = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
    tangent = math.copysign(1.0, ratio) / (abs(ratio) + math.sqrt(ratio * ratio + 1.0))
    cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    turn(A, p, q, cosine, sine)
    turn(V, p, q, cosine, sine)
    for k in range(SIZE):  # rows
        a, b = A[p, k], A[q, k]
        A[p, k], A[q, k] = cosine * a - sine * b, sine * a + cosine * b


@compiled
def diagonalise(A: F64s, V: F64s) -> None:
    """Turn a symmetric matrix until it is diagonal, and the vectors `V` with it."""
    for _ in range(SWEEPS_MAX):
        beside, everything = 0.0, 0.0
        for p in range(SIZE):
            for q in range(SIZE):
                square = A[p, q] * A[p, q]
                everything = everything + square
                if p != q:
                    beside = beside + square
        if beside <= NEGLIGIBLE * everything:
            return
        for p in range(SIZE - 1):
            for q in range(p + 1, SIZE):
                if A[p, q] != 0.0:
                    annul(A, V, p, q)


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
