"""How exports write their boxes: the layouts that are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import ModelError

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
    """(4 + classes, N): centre, size, class scores (YOLOv8, 11, 12).

    Attributes:
        logits: Whether scores lack the sigmoid.
    """

    logits: bool = False
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
        least = _logit(min_score) if self.logits else min_score
        near = np.flatnonzero(scores[wanted].max(axis=0) > least)
        best = np.asarray(scores[:, near].argmax(axis=0), dtype=np.int64)
        ours = np.isin(best, wanted)
        near, best = near[ours], best[ours]
        score = _sigmoid(scores[best, near]) if self.logits else scores[best, near]
        return Candidates(_corners(output[:4, near].T), score, best)


@dataclass(frozen=True, slots=True)
class TransposedLayout:
    """(N, 4 + classes): as `RawLayout` with rows and columns exchanged."""

    logits: bool = False
    name: str = "raw 1xNx(4+classes)"
    suppressed: bool = False

    def candidates(
        self,
        output: NDArray[np.float32],
        canvas: tuple[int, int],
        wanted: NDArray[np.int64],
        min_score: float,
    ) -> Candidates:
        """See `Layout`."""
        return RawLayout(self.logits).candidates(output.T, canvas, wanted, min_score)


@dataclass(frozen=True, slots=True)
class TransformerLayout:
    """(N, 4 + classes): centre and size in shares of the canvas, class scores (RT-DETR, DETR).

    Attributes:
        logits: Whether scores lack the sigmoid.
        softmax: Whether they lack the softmax instead, with a last class of no object.
    """

    logits: bool
    softmax: bool = False
    name: str = "transformer 1xNx(4+classes)"
    suppressed: bool = True

    def candidates(
        self,
        output: NDArray[np.float32],
        canvas: tuple[int, int],
        wanted: NDArray[np.int64],
        min_score: float,
    ) -> Candidates:
        """See `Layout`."""
        scaled = output.copy()
        scaled[:, :4] *= np.array([*canvas, *canvas], np.float32)
        if self.softmax:
            power = np.exp(scaled[:, 4:] - scaled[:, 4:].max(axis=1, keepdims=True))
            scaled = np.concatenate([scaled[:, :4], power / power.sum(axis=1, keepdims=True)], 1)
            scaled = scaled[:, :-1]
        elif self.logits:
            scaled[:, 4:] = _sigmoid(scaled[:, 4:])
        return RawLayout().candidates(scaled.T, canvas, wanted, min_score)


@dataclass(frozen=True, slots=True)
class Columns:
    """Where a row has what.

    Attributes:
        box: First of the four columns of the box.
        centre: Whether they are centre and size; else two corners.
        score: Column of the score.
        kind: Column of the class; -1: there is none.
        second: Column of a second score, -1: none.
        product: Whether the two scores are multiplied (objectness and the only class); else they
            are those of two classes.
        batch: Column of the image's number, -1: none.
        shares: Whether boxes are in shares of the canvas.
        logits: Whether scores lack the sigmoid.
    """

    box: int = 0
    centre: bool = False
    score: int = 4
    kind: int = 5
    second: int = -1
    product: bool = False
    batch: int = -1
    shares: bool = False
    logits: bool = False

    @property
    def words(self) -> str:
        """The columns in their order."""
        box = ["centre", "size"] if self.centre else ["corners"]
        parts = {self.box: ", ".join(box)}
        if self.second >= 0:
            names = ("objectness", "class score") if self.product else ("two class scores",)
            parts |= {self.score + k: name for k, name in enumerate(names)}
        else:
            parts |= {self.score: "score", self.kind: "class"}
        if self.batch >= 0:
            parts[self.batch] = "image"
        return ", ".join(parts[k] for k in sorted(parts))


class TableLayout:
    """(N, 6) or (N, 7): one box a row, in columns of any order.

    What they mean is known once a model has found something, which it need not on a grey canvas.

    Args:
        meaning: Tells what they mean; None: the rows don't say anything.
        columns: What it said of a grey canvas.
        named: How many classes the model has; 0 when that is not known.
        suppressed: Whether the model itself keeps one box per vehicle.
        place: The model's file, for the error.
    """

    def __init__(
        self,
        meaning: Callable[[NDArray[np.float32]], Columns | None],
        columns: Columns | None,
        named: int,
        suppressed: bool,
        place: str,
    ) -> None:
        self.suppressed = suppressed
        self._meaning, self._columns, self._named, self._place = meaning, columns, named, place
        self._found = False

    @property
    def name(self) -> str:
        """See `Layout`."""
        if self._columns is None or self._columns == Columns():
            return "NMS-free 1xNx6" if self.suppressed else "corners, score, class 1xNx6"
        return f"{self._columns.words} 1xN"

    def candidates(
        self,
        output: NDArray[np.float32],
        canvas: tuple[int, int],
        wanted: NDArray[np.int64],
        min_score: float,
    ) -> Candidates:
        """See `Layout`.

        Raises:
            ModelError: Columns that mean nothing known, or a class without a name.
        """
        if self._columns is None:
            self._columns = self._meaning(output)
        if (columns := self._columns) is None:
            return _NOTHING
        rows, score, kind = _scored(output, columns)
        kept = np.flatnonzero(score > min_score)
        box = rows[kept, columns.box : columns.box + 4]
        if not columns.centre and (box[:, 2:] < box[:, :2]).any():
            # What a grey canvas showed was chance.
            self._columns = None if self._found else self._meaning(output)
            if self._columns is None or not self._columns.centre:
                found = "a box whose second corner is left of or above its first"
                raise ModelError(self._place, found, "columns of the same meaning in all boxes")
            return self.candidates(output, canvas, wanted, min_score)
        if self._named and (kind[kept] >= self._named).any():
            found = f"class number {int(kind[kept].max())} of {self._named} classes"
            raise ModelError(self._place, found, "a name for each class (option class_names)")
        self._found = self._found or len(kept) > 0
        if columns.shares:
            box = box * np.array([*canvas, *canvas], np.float32)
        box = _corners(box) if columns.centre else box
        ours = np.isin(kind[kept], wanted)
        return Candidates(box[ours], score[kept][ours], kind[kept][ours].astype(np.int64))


def _scored(
    output: NDArray[np.float32], columns: Columns
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.floating]]:
    """Rows of the first image, their score and their class."""
    rows = output if columns.batch < 0 else output[output[:, columns.batch] == 0.0]
    if columns.second < 0:
        return rows, rows[:, columns.score], rows[:, columns.kind]
    pair = rows[:, columns.score : columns.score + 2]
    pair = _sigmoid(pair) if columns.logits else pair
    if columns.product:
        return rows, pair.prod(axis=1), np.zeros(len(rows), np.float32)
    return rows, pair.max(axis=1), pair.argmax(axis=1).astype(np.float32)


@dataclass(frozen=True, slots=True)
class GridLayout:
    """(N, 5 + classes): offset in the cell, log size, objectness, class scores (YOLOX).

    Attributes:
        strides: Cell sizes, pixels.
        decoded: Whether the model already turned offsets and log sizes into canvas pixels.
        rgb: Whether images are prepared as for YOLOv5 to 7 (red first, 0 to 1, in the middle).
        shares: Whether centre and size are shares of the canvas.
    """

    strides: tuple[int, ...]
    decoded: bool
    rgb: bool = False
    shares: bool = False
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
        if self.shares:
            boxes *= np.array([*canvas, *canvas], np.float32)
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


def _sigmoid(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(values, -50.0, 50.0))), np.float32)


def _logit(share: float) -> float:
    """Log-odds; 0 and 1 as what half precision can tell from them."""
    inside = min(max(share, 1e-4), 1.0 - 1e-4)
    return float(np.log(inside / (1.0 - inside)))


_NOTHING = Candidates(np.empty((0, 4), np.float32), np.empty(0, np.float32), np.empty(0, np.int64))
