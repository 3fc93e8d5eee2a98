"""Products of small matrices and vectors: compiled loops beat BLAS, whose call costs more than 17 x 17 numbers."""

import numpy as np

from softneck.runtime._compiled_runtime import COMPILED


def product(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return A x."""
    y = np.zeros(A.shape[0])
    add_product(A, x, y)
    return y


def add_product(A: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Add A x to the first numbers of `y`; x may be longer than A is wide."""
    rows, columns = A.shape[0], A.shape[1]
    if not COMPILED:
        y[:rows] += np.dot(A, x[:columns])
        return
    for i in range(rows):
        total = 0.0
        for j in range(columns):
            total += A[i, j] * x[j]
        y[i] += total
