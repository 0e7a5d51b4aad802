"""How YOLO exports write their boxes: the three layouts, and which of them a model's output has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.class_names import COCO_NAMES
from geoorbit_ros.detection.detector import ModelError
from geoorbit_ros.detection.onnx.session import OnnxMetadata

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


KNOWN = (
    "one output 1x(4+classes)xN (YOLOv8, 11, 12), 1xNx6 (YOLO26, YOLOv10, exports with NMS) or "
    "1xNx(5+classes) with one box per grid cell (YOLOX)"
)


def choose_layout(
    outputs: list[NDArray[np.float32]],
    canvas: tuple[int, int],
    metadata: OnnxMetadata,
    names: Mapping[int, str],
    place: str,
) -> tuple[Layout, Mapping[int, str], int]:
    """Layout, class names and number of classes of a model.

    Args:
        outputs: What the model wrote for one grey canvas.
        canvas: Width and height of that canvas.
        metadata: What the file says.
        names: Names given by the user; they go before those in the file.
        place: The model's file, for the error.

    Raises:
        ModelError: Outputs of any other shape, or class names that are not known.
    """
    seen = ", ".join("x".join(map(str, output.shape)) for output in outputs) or "no output"
    said = f"{_plural(len(outputs), 'output')} {seen} for an input of {canvas[0]}x{canvas[1]}"
    refusal = ModelError(place, said, KNOWN)
    if len(outputs) != 1 or outputs[0].ndim != 3 or outputs[0].dtype.kind != "f":
        raise refusal
    output = outputs[0][0]
    names = names or metadata.names
    layout, count = _by_shape(output, canvas, metadata, len(names))
    if layout is None:
        raise refusal
    if not names and count in (0, len(COCO_NAMES)):
        # Files without metadata have the 80 classes of COCO, unless the user names others.
        names = dict(enumerate(COCO_NAMES))
    if not names:
        expected = "metadata 'names' in the file, or the option class_names"
        raise ModelError(place, f"{count} classes without names", expected)
    if count and len(names) != count:
        raise ModelError(place, f"{len(names)} class names", f"{count}, as its output {seen} says")
    return layout, names, count or max(names) + 1


def _by_shape(
    output: NDArray[np.float32], canvas: tuple[int, int], metadata: OnnxMetadata, named: int
) -> tuple[Layout | None, int]:
    """The layout of (A, B), None when it is none; its number of classes, 0 when it can't say."""
    a, b = output.shape
    for strides in GRID_STRIDES:
        cells = cell_count(canvas, strides)
        raw = b == cells and a > 4
        grid = a == cells and b > 5 and metadata.task is None
        if raw and not metadata.end2end:
            return RawLayout(), a - 4
        if grid and (b != 6 or named == 1):
            # Decoded centres lie all over the canvas, offsets within a cell or two.
            decoded = bool(np.median(output[:, 0]) > 0.25 * canvas[0])
            return GridLayout(strides, decoded), b - 5
    if b == 6:
        return NmsFreeLayout(), 0
    return None, 0


def _plural(count: int, word: str) -> str:
    return word if count == 1 else f"{count} {word}s"
