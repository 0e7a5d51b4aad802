"""The three ways in which YOLO exports write their boxes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

GRID_STRIDES = ((8, 16, 32), (8, 16, 32, 64))
"""Cells of these sizes, in this order, each giving one box; the second set has a P6 head."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """Boxes in canvas pixels before suppression.

    Attributes:
        boxes: (N, 4) left, top, right, bottom.
        score: (N,) in [0, 1].
        model_class: (N,) the model's class numbers.
    """

    boxes: NDArray[np.float32]
    score: NDArray[np.float32]
    model_class: NDArray[np.int64]


class Layout(Protocol):
    """Reads the output for one image."""

    @property
    def name(self) -> str:
        """Its name and shape, for a sentence."""

    @property
    def suppressed(self) -> bool:
        """Whether the model itself keeps one box per vehicle."""

    def candidates(
        self,
        output: NDArray[np.float32],
        canvas: tuple[int, int],
        wanted: NDArray[np.int64],
        min_score: float,
    ) -> Candidates:
        """Boxes whose best class is wanted and scores above `min_score`.

        Args:
            output: (A, B) as the model wrote it.
            canvas: Width and height of its input.
            wanted: The model's class numbers that are vehicles.
            min_score: Least score.
        """


@dataclass(frozen=True, slots=True)
class RawLayout:
    """(4 + classes, N): centre, size, class scores (YOLOv8, 11, 12)."""

    name: str = "raw 1x(4+classes)xN"
    suppressed: bool = False

    def candidates(
        self,
        output: NDArray[np.float32],
        canvas: tuple[int, int],
        wanted: NDArray[np.int64],
        min_score: float,
    ) -> Candidates:
        """See `Layout`."""
        scores = output[4:]
        # A few rows decide which columns to look at; only there all classes are compared.
        near = np.flatnonzero(scores[wanted].max(axis=0) > min_score)
        best = np.asarray(scores[:, near].argmax(axis=0), dtype=np.int64)
        ours = np.isin(best, wanted)
        near, best = near[ours], best[ours]
        return Candidates(_corners(output[:4, near].T), scores[best, near], best)


@dataclass(frozen=True, slots=True)
class NmsFreeLayout:
    """(N, 6): corners, score, class (YOLO26, YOLOv10, exports with `nms=True`)."""

    name: str = "NMS-free 1xNx6"
    suppressed: bool = True

    def candidates(
        self,
        output: NDArray[np.float32],
        canvas: tuple[int, int],
        wanted: NDArray[np.int64],
        min_score: float,
    ) -> Candidates:
        """See `Layout`."""
        kept = output[output[:, 4] > min_score]
        kept = kept[np.isin(kept[:, 5], wanted)]
        return Candidates(kept[:, :4], kept[:, 4], kept[:, 5].astype(np.int64))


@dataclass(frozen=True, slots=True)
class GridLayout:
    """(N, 5 + classes): offset in the cell, log size, objectness, class scores (YOLOX).

    Attributes:
        strides: Cell sizes, pixels.
        decoded: Whether the model already turned offsets and log sizes into canvas pixels.
    """

    strides: tuple[int, ...]
    decoded: bool
    name: str = "grid 1xNx(5+classes)"
    suppressed: bool = False

    def candidates(
        self,
        output: NDArray[np.float32],
        canvas: tuple[int, int],
        wanted: NDArray[np.int64],
        min_score: float,
    ) -> Candidates:
        """See `Layout`."""
        # No class scores above 1, so that objectness alone rules most cells out; a few columns then
        # decide in which rows all classes are compared.
        near = np.flatnonzero(output[:, 4] > min_score)
        vehicles = output[np.ix_(near, 5 + wanted)].max(axis=1, initial=0.0)
        near = near[vehicles * output[near, 4] > min_score]
        scores = output[near, 5:] * output[near, 4:5]
        best = np.asarray(scores.argmax(axis=1), dtype=np.int64)
        score = scores[np.arange(len(near)), best]
        ours = (score > min_score) & np.isin(best, wanted)
        near, best, score = near[ours], best[ours], score[ours]
        boxes = output[near, :4].copy()
        if not self.decoded:
            corner, stride = grid_cells(canvas, self.strides)
            boxes[:, :2] = (boxes[:, :2] + corner[near]) * stride[near, None]
            boxes[:, 2:] = np.exp(boxes[:, 2:]) * stride[near, None]
        return Candidates(_corners(boxes), score, best)


def cell_count(canvas: tuple[int, int], strides: tuple[int, ...]) -> int:
    """Cells of all strides in a canvas of this width and height."""
    return sum((canvas[0] // stride) * (canvas[1] // stride) for stride in strides)


@lru_cache(maxsize=8)
def grid_cells(
    canvas: tuple[int, int], strides: tuple[int, ...]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row (N, 2) and stride (N,) of every cell, row by row, finest stride first."""
    corners, sizes = [], []
    for stride in strides:
        row, column = np.mgrid[: canvas[1] // stride, : canvas[0] // stride]
        corners.append(np.column_stack([column.ravel(), row.ravel()]))
        sizes.append(np.full(row.size, stride))
    return np.concatenate(corners).astype(np.float32), np.concatenate(sizes).astype(np.float32)


def _corners(boxes: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, 4) left, top, right, bottom of centre, size."""
    half = 0.5 * boxes[:, 2:]
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)
