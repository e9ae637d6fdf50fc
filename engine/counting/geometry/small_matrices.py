"""Small symmetric matrices in kernels. NumPy's routines would compile for seconds in each kernel that calls them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import njit

FloatArray = NDArray[np.float64]

SWEEPS = 12
"""Of Jacobi's method, which converges quadratically: a 3 × 3 matrix needs four or five."""


@njit
def invert(matrix: FloatArray, inverse: FloatArray) -> None:
    """Write the inverse of a symmetric positive definite matrix (n, n), which is overwritten by its Cholesky factor."""
    n = len(matrix)
    for j in range(n):
        for i in range(j, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(total) if i == j else total / matrix[j, j]
    for column in range(n):
        for i in range(n):  # forward substitution
            total = 1.0 if i == column else 0.0
            for k in range(i):
                total -= matrix[i, k] * inverse[k, column]
            inverse[i, column] = total / matrix[i, i]
        for i in range(n - 1, -1, -1):  # backward substitution
            total = inverse[i, column]
            for k in range(i + 1, n):
                total -= matrix[k, i] * inverse[k, column]
            inverse[i, column] = total / matrix[i, i]


@njit
def smallest_axis(matrix: FloatArray, axis: FloatArray) -> tuple[float, float]:
    """The two smallest eigenvalues of a symmetric matrix (3, 3), ascending; writes the unit eigenvector of the first.

    The lower half is read and the matrix is overwritten (Jacobi's method; Golub and Van Loan, section 8.5).
    """
    vectors = np.zeros((3, 3))
    for i in range(3):
        vectors[i, i] = 1.0
        for j in range(i):
            matrix[j, i] = matrix[i, j]
    for _ in range(SWEEPS):
        for p in range(2):
            for q in range(p + 1, 3):
                if matrix[p, q] == 0.0:
                    continue
                ratio = (matrix[q, q] - matrix[p, p]) / (2.0 * matrix[p, q])
                tangent = 1.0 / (abs(ratio) + np.sqrt(ratio * ratio + 1.0))
                if ratio < 0.0:
                    tangent = -tangent
                cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
                sine = tangent * cosine
                for k in range(3):
                    first, second = matrix[k, p], matrix[k, q]
                    matrix[k, p], matrix[k, q] = cosine * first - sine * second, sine * first + cosine * second
                for k in range(3):
                    first, second = matrix[p, k], matrix[q, k]
                    matrix[p, k], matrix[q, k] = cosine * first - sine * second, sine * first + cosine * second
                for k in range(3):
                    first, second = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = cosine * first - sine * second, sine * first + cosine * second
    least = 0
    for i in range(1, 3):
        if matrix[i, i] < matrix[least, least]:
            least = i
    second = np.inf
    for i in range(3):
        if i != least and matrix[i, i] < second:
            second = matrix[i, i]
        axis[i] = vectors[i, least]
    return matrix[least, least], second
