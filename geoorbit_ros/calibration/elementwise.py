"""Small linear algebra on many vehicles at once, with the same bits however they are grouped.

Arrays hold their components first and the M vehicles last. Every operation is elementwise along M:
a vehicle's numbers don't depend on which others are computed in the same call, so that one frame
at a time (live) and many frames together (offline) give the same bytes. Products of matrices by
BLAS, `einsum` and sums along an axis don't have this property: they add in an order that depends
on sizes.
"""

from __future__ import annotations

from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def total(terms: Array) -> Array:
    """Sum over the first axis, from the first to the last."""
    return np.asarray(reduce(add, terms))


def solve(matrix: Array, right: Array) -> Array:
    """Solutions (n, k, M) of symmetric positive definite systems.

    Gaussian elimination; such systems need no pivots (Golub and Van Loan (2013), Matrix
    Computations, section 4.2).

    Args:
        matrix: (n, n, M).
        right: (n, k, M), or (n, k, 1) where all are the same.
    """
    n, columns = len(matrix), right.shape[1]
    both = np.empty((n, n + columns, matrix.shape[2]))
    both[:, :n], both[:, n:] = matrix, right
    for k in range(n):
        both[k, k + 1 :] /= both[k, k]
        both[k + 1 :, k + 1 :] -= both[k + 1 :, k, None] * both[k, k + 1 :]
    for k in range(n - 1, 0, -1):
        both[:k, n:] -= both[:k, k, None] * both[k, n:]
    return both[:, n:]


def inverse_2x2(matrix: Array) -> Array:
    """Inverses of matrices (2, 2, M); infinite for singular ones."""
    (a, b), (c, d) = matrix
    inverse = np.empty_like(matrix)
    inverse[0, 0], inverse[1, 1] = d, a
    inverse[0, 1], inverse[1, 0] = -b, -c
    return np.asarray(inverse / (a * d - b * c))


def through(slope: Array, inner: Array) -> Array:
    """Products (2, k, M) of slopes (2, 2, M) with inner ones (2, k, M): the chain rule."""
    return np.asarray(slope[:, :1] * inner[0] + slope[:, 1:] * inner[1])


def worst_sigma(covariance: Array) -> Array:
    """Square root (M,) of the larger eigenvalue of covariances (2, 2, M)."""
    a, b, c = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    return np.asarray(np.sqrt((a + c) / 2 + np.hypot((a - c) / 2, b)))
