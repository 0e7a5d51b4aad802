"""How well a detector finds the vehicles that can be seen: recall, precision, edges.

Only vehicles within a useful range are asked for; boxes on others, and boxes too small to be in
it, are neither right nor wrong, as with the ignored regions of MOTChallenge (Milan et al. 2016,
arXiv:1603.00831, section 4.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from geoorbit_ros.core.tables import FLAG_TRUNCATED

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


MATCH_IOU = 0.5
"""Least overlap of a box and the vehicle that it finds, as MOTChallenge asks for."""
USEFUL_WIDTH_PX = 1280
"""Width of the image that `USEFUL_HEIGHT_PX` is meant for."""
USEFUL_HEIGHT_PX = 16.0
"""Least height of a vehicle's box within the useful range (docs/detection.md)."""
USEFUL_VISIBLE = 0.5
"""Least visible share of a vehicle within the useful range (docs/detection.md)."""


@dataclass(frozen=True, slots=True)
class FrameMatch:
    """Boxes of one frame beside the truth.

    Attributes:
        pairs: (M, 2) index of the box, index of the true one, both of at least `MATCH_IOU`.
        useful: (T,) whether each true box is within the useful range.
        missed: Indices of useful true boxes without a box.
        false: Indices of boxes without a true one, of useful height.
    """

    pairs: NDArray[np.intp]
    useful: NDArray[np.bool_]
    missed: NDArray[np.intp]
    false: NDArray[np.intp]


def match_frame(rows: NDArray[np.void], truth: NDArray[np.void], image_width: int) -> FrameMatch:
    """One-to-one pairs of largest overlap in all, useful vehicles first.

    Args:
        rows: Boxes found, `DETECTION_DTYPE` or more.
        truth: `PIXEL_TRACK_DTYPE`; `score` is the visible share.
        image_width: Of the image, pixels.
    """
    least_px = USEFUL_HEIGHT_PX * image_width / USEFUL_WIDTH_PX
    useful = (truth["height"] >= least_px) & (truth["score"] >= USEFUL_VISIBLE)
    iou = box_iou(box_corners(rows), box_corners(truth))
    gain = np.where(iou >= MATCH_IOU, iou + useful, 0.0)
    row, column = linear_sum_assignment(-gain)
    held = gain[row, column] > 0.0
    pairs = np.column_stack([row[held], column[held]])
    missed = np.setdiff1d(np.flatnonzero(useful), pairs[:, 1])
    false = np.setdiff1d(np.flatnonzero(rows["height"] >= least_px), pairs[:, 0])
    return FrameMatch(pairs, useful, missed, false)


class DetectionScore:
    """Adds up frames.

    Attributes:
        hits: Useful vehicles found.
        missed: Useful vehicles not found.
        false: Boxes where no vehicle is.
    """

    def __init__(self) -> None:
        self.hits = self.missed = self.false = 0
        self._errors: list[NDArray[np.float64]] = []

    def add(self, rows: NDArray[np.void], truth: NDArray[np.void], image_width: int) -> FrameMatch:
        """Count one frame; arguments as `match_frame`."""
        match = match_frame(rows, truth, image_width)
        found = match.pairs[match.useful[match.pairs[:, 1]]]
        self.hits += len(found)
        self.missed += len(match.missed)
        self.false += len(match.false)
        inside = found[(truth["flags"][found[:, 1]] & FLAG_TRUNCATED) == 0]
        off = box_corners(rows[inside[:, 0]]) - box_corners(truth[inside[:, 1]])
        self._errors.append(off / truth["height"][inside[:, 1], None])
        return match

    @property
    def recall(self) -> float:
        """Share of the useful vehicles that were found; NaN without any."""
        return self.hits / (self.hits + self.missed) if self.hits + self.missed else float("nan")

    @property
    def precision(self) -> float:
        """Share of the boxes that are vehicles; NaN without any."""
        return self.hits / (self.hits + self.false) if self.hits + self.false else float("nan")

    @property
    def edge_errors(self) -> NDArray[np.float64]:
        """(M, 4) found less true left, top, right, bottom over the true height; no cut boxes."""
        return np.concatenate(self._errors) if self._errors else np.empty((0, 4))
