"""Which candidate pair of track and detection holds: the cheapest set, one partner each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def assign(row: Index, column: Index, cost: Array, limit: float) -> NDArray[np.intp]:
    """The pairs of the cheapest assignment, in which staying alone costs `limit`.

    Pairs whose row and column have no other candidate are taken at once; the Hungarian method
    (Kuhn 1955) decides among the others alone. Both together are the optimum.

    Args:
        row: (P,) row of each candidate pair.
        column: (P,) its column; no pair twice.
        cost: (P,) its cost; pairs at `limit` or above are no candidates.
        limit: Cost of leaving a row or column without partner.

    Returns:
        Indices of the chosen pairs.
    """
    candidate = np.flatnonzero(cost < limit)
    if not len(candidate):
        return candidate
    rows, columns = row[candidate], column[candidate]
    rivals = np.bincount(rows)[rows] + np.bincount(columns)[columns]
    sole = rivals == 2
    if sole.all():
        return candidate
    contested = candidate[~sole]
    used_row, i = np.unique(row[contested], return_inverse=True)
    used_column, j = np.unique(column[contested], return_inverse=True)
    dense = np.full((len(used_row), len(used_column)), limit)
    dense[i, j] = cost[contested]
    pair = np.full(dense.shape, -1, dtype=np.intp)
    pair[i, j] = contested
    best = pair[linear_sum_assignment(dense)]
    return np.concatenate([candidate[sole], best[best >= 0]])
