"""Overlap of boxes given by their columns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def overlapping_pairs(first: Array, second: Array) -> tuple[Index, Index, Array]:
    """Pairs of boxes (4, N) and (4, M) x, y, width, height that overlap.

    Returns:
        Indices into both (P,), and intersection over union (P,), above 0.
    """
    shared = np.ones((first.shape[1], second.shape[1]))
    for k in (0, 1):
        low = np.maximum.outer(first[k] - 0.5 * first[k + 2], second[k] - 0.5 * second[k + 2])
        high = np.minimum.outer(first[k] + 0.5 * first[k + 2], second[k] + 0.5 * second[k + 2])
        shared *= np.maximum(high - low, 0.0)
    i, j = np.nonzero(shared)
    area = shared[i, j]
    union = first[2, i] * first[3, i] + second[2, j] * second[3, j] - area
    return i, j, area / union
