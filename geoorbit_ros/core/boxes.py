"""Boxes in the image: corners and overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def box_corners(rows: NDArray[np.void]) -> Array:
    """(N, 4) left, top, right, bottom in pixels of rows with `x y width height` (box centre)."""
    x, y = rows["x"].astype(np.float64), rows["y"].astype(np.float64)
    half = 0.5 * rows["width"].astype(np.float64), 0.5 * rows["height"].astype(np.float64)
    return np.column_stack([x - half[0], y - half[1], x + half[0], y + half[1]])


def box_iou(first: Array, second: Array) -> Array:
    """(N, M) intersection over union of corners (N, 4) and (M, 4); 0 where both are empty."""
    low = np.maximum(first[:, None, :2], second[None, :, :2])
    high = np.minimum(first[:, None, 2:], second[None, :, 2:])
    shared = np.clip(high - low, 0.0, None).prod(axis=2)
    area = [
        np.clip(boxes[:, 2:] - boxes[:, :2], 0.0, None).prod(axis=1) for boxes in (first, second)
    ]
    union = area[0][:, None] + area[1][None, :] - shared
    return np.asarray(shared / np.maximum(union, 1e-12))
