"""Non-maximum suppression: of boxes on the same vehicle, the one with the highest score stays."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_CANDIDATES = 30000
"""More boxes than this before suppression: the best of them, as the common predictors do."""


def suppress(
    boxes: NDArray[np.floating],
    score: NDArray[np.floating],
    group: NDArray[np.integer],
    max_iou: float,
) -> NDArray[np.int64]:
    """Indices of the boxes that stay, highest score first.

    Args:
        boxes: (N, 4) left, top, right, bottom.
        score: (N,).
        group: (N,) boxes of different groups never suppress each other.
        max_iou: Intersection over union above which the lesser box goes.
    """
    if not len(boxes):
        return np.empty(0, dtype=np.int64)
    best = np.argsort(-score, kind="stable")[:MAX_CANDIDATES]
    edges = np.column_stack([boxes[best, :2], boxes[best, 2:] - boxes[best, :2]])
    # Its annotations ask for lists; arrays work, without an object per number.
    arrays: tuple[Any, Any, Any] = (
        edges.astype(np.float64),
        score[best].astype(np.float32),
        group[best].astype(np.int32),
    )
    kept = cv2.dnn.NMSBoxesBatched(*arrays, -1.0, max_iou)
    return np.asarray(best[np.asarray(kept, dtype=np.int64).ravel()])
