"""Faults in tables of tracked boxes that every reader looks for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import Frames

BOX_FIELDS = ("x", "y", "width", "height", "score")


def first_bad_box(rows: NDArray[np.void]) -> int | None:
    """Index of the first row with a number that is not finite or a negative size."""
    good = (rows["width"] >= 0) & (rows["height"] >= 0)
    for name in BOX_FIELDS:
        good &= np.isfinite(rows[name])
    return None if good.all() else int(np.argmin(good))


def first_twin(frames: Frames) -> int | None:
    """Index of the first row whose `track_id` an earlier row of the same frame has.

    An id names one vehicle: twice in a frame it would tear every track in two.
    """
    frame = np.repeat(np.arange(len(frames)), np.diff(frames.offset)) << 32
    key = frame + frames.rows["track_id"]
    if (np.diff(np.sort(key)) > 0).all():  # a plain sort is several times faster than argsort
        return None
    order = np.argsort(key, kind="stable")
    twin = np.flatnonzero(np.diff(key[order]) == 0)
    return int(order[twin + 1].min())
