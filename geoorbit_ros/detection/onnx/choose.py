"""Which layout a model's output has, found in its shape and in its numbers.

Exporters write the same six columns for different things. Which, the numbers tell: classes are
whole and scores are shares; in corners the second point lies right of and below the first, which
centre and size keep to only by chance; what a transformer writes are shares of the image.
Sources: the exporters of Ultralytics (YOLOv8 to 26, RT-DETR, YOLOv5), THU-MIG/yolov10,
WongKinYiu/yolov7 (`--end2end --max-wh`), marcoslucianops/DeepStream-Yolo, PaddleDetection and
SuperGradients (YOLO-NAS, flat format).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.class_names import COCO_91, COCO_NAMES
from geoorbit_ros.detection.detector import ModelError
from geoorbit_ros.detection.onnx.layouts import (
    GRID_STRIDES,
    Columns,
    GridLayout,
    Layout,
    RawLayout,
    TableLayout,
    TransformerLayout,
    TransposedLayout,
    cell_count,
)
from geoorbit_ros.detection.onnx.outputs import BoxOutputs, find_boxes
from geoorbit_ros.detection.onnx.session import OnnxMetadata

_TOLERANCE = 1e-3
"""By which a whole number, or a share, may miss. Chosen: half precision has steps of that size."""
_MOST_SHARE = 1.5
"""Largest number in a box that is in shares of the canvas. Chosen: in pixels, a box within this is
smaller than any vehicle."""
_MIN_ORDERED = 0.98
"""Of boxes given by corners at least so many have them in order, and of the surest ones. Chosen:
smaller takes centre and size for corners where vehicles are near the upper left corner; larger
lets one degenerate box decide."""
_REACH = 0.1
"""Of the canvas by which a box may reach over its border. Chosen: models guess the hidden part of
vehicles at the border."""
_SUREST = 0.5
"""Boxes with at least this share of the best score are the surest; of these, at least this share
must be on the canvas. Chosen: smaller takes in more of what is no vehicle."""


class UnclearColumnsError(ValueError):
    """Numbers that fit no meaning, or several; the message says what was found in them."""


def meaning(rows: NDArray[np.float32], named: int, canvas: tuple[int, int]) -> Columns | None:
    """What six or seven columns mean.

    Args:
        rows: (N, 6) or (N, 7) of one image.
        named: How many classes the model has; 0 when that is not known.
        canvas: Width and height of the model's input.

    Returns:
        Their meaning; None when there is no row that says anything.

    Raises:
        UnclearColumnsError: None is possible, or it can't be told which.
    """
    kept = rows[np.isfinite(rows).all(axis=1)]
    kept = kept[(np.abs(kept) > 0.0).any(axis=1) & (kept != -1.0).any(axis=1)]
    if not len(kept):
        return None
    if kept.shape[1] == 7:
        if (kept[:, 0] != 0.0).any():
            found = "seven columns of which the first is not the image's number, 0"
            raise UnclearColumnsError(f"{found}: rotated boxes?")
        inner = meaning(kept[:, 1:], named, canvas)
        return None if inner is None else _shifted(inner)
    return _of_six(kept, named, canvas)


def _shifted(inner: Columns) -> Columns:
    """Six columns that stand behind the number of the image."""
    return replace(
        inner,
        box=inner.box + 1,
        score=inner.score + 1,
        kind=inner.kind + 1 if inner.kind >= 0 else -1,
        second=inner.second + 1 if inner.second >= 0 else -1,
        batch=0,
    )


def _of_six(rows: NDArray[np.float32], named: int, canvas: tuple[int, int]) -> Columns:
    whole = [_is_whole(column) for column in rows.T]
    share = [_is_share(column) for column in rows.T]
    found: Columns | None = None
    if whole[0] and share[1] and not whole[1] and _ordered(rows[:, 2:]).all():
        found = Columns(box=2, score=1, kind=0)
    elif whole[5] and share[4] and _fits(rows[:, 5], named):
        found = Columns()
    elif whole[4] and share[5] and _fits(rows[:, 4], named):
        found = Columns(score=5, kind=4)
    elif share[4] and (whole[5] or whole[4]) and named and not (share[4] and share[5]):
        most = int(rows[:, 5 if whole[5] else 4].max())
        raise UnclearColumnsError(f"class number {most} of {named} classes")
    else:
        found = _pair(rows, named, sigmoid=share[4] and share[5])
    return _with_box(rows, found, canvas)


def _pair(rows: NDArray[np.float32], named: int, *, sigmoid: bool) -> Columns:
    """Two scores: objectness and the only class, or two classes."""
    logits = not sigmoid
    if logits and not (_in_shares(rows[:, :4]) and named == 2):
        low, high = rows[:, 4:].min(), rows[:, 4:].max()
        found = f"values from {low:.3g} to {high:.3g} where score and class should be"
        raise UnclearColumnsError(found)
    if named not in (1, 2):
        known = f"{named} classes" if named else "classes without names"
        raise UnclearColumnsError(f"two scores a box for {known}")
    return Columns(second=5, kind=-1, product=named == 1, logits=logits)


def _with_box(rows: NDArray[np.float32], columns: Columns, canvas: tuple[int, int]) -> Columns:
    """The same, with what the four columns of the box are."""
    box = rows[:, columns.box : columns.box + 4]
    score = rows[:, columns.score].copy()
    if columns.second >= 0:
        second = rows[:, columns.second]
        score = score * second if columns.product else np.maximum(score, second)
    best = box[score >= _SUREST * score.max()]
    shares = _in_shares(box)
    width, height = (1, 1) if shares else canvas
    half = 0.5 * best[:, 2:]
    around = np.concatenate([best[:, :2] - half, best[:, :2] + half], axis=1)
    on_canvas = float(_inside(around, width, height).mean())
    corners = min(float(_ordered(best).mean()), float(_ordered(box).mean())) >= _MIN_ORDERED
    # Two scores come from before suppression, where exporters write centre and size.
    pair = columns.second >= 0
    centre = not corners or (pair and on_canvas >= _SUREST)
    if centre and ((best[:, 2:] < 0.0).any() or (on_canvas < _SUREST and not pair)):
        raise UnclearColumnsError("boxes that are neither corners nor centre and size")
    return replace(columns, centre=centre, shares=shares)


def _ordered(box: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.asarray((box[:, 2] >= box[:, 0]) & (box[:, 3] >= box[:, 1]))


def _inside(box: NDArray[np.float32], width: int, height: int) -> NDArray[np.bool_]:
    """Whether corners are on the canvas, or a little outside."""
    share = box / np.array([width, height, width, height], np.float32)
    return np.asarray(((share > -_REACH) & (share < 1.0 + _REACH)).all(axis=1))


def _is_whole(column: NDArray[np.float32]) -> bool:
    return bool((np.abs(column - np.rint(column)) < _TOLERANCE).all() and (column >= 0.0).all())


def _is_share(column: NDArray[np.float32]) -> bool:
    return bool((column >= -_TOLERANCE).all() and (column <= 1.0 + _TOLERANCE).all())


def _fits(kinds: NDArray[np.float32], named: int) -> bool:
    return not named or bool(kinds.max() < named)


def _in_shares(box: NDArray[np.float32]) -> bool:
    """Whether boxes are shares of the image: none reaches further than a pixel or so."""
    far = float(np.abs(box).max())
    return 0.0 < far <= _MOST_SHARE


KNOWN = (
    "one output 1x(4+classes)xN (YOLOv8, 11, 12), 1xNx6 (YOLO26, YOLOv10, exports with NMS), "
    "1xNx(5+classes) with one box per grid cell (YOLOX, YOLOv6) or three (YOLOv5, YOLOv7), "
    "1xNx(4+classes) (RT-DETR), or boxes beside classes and scores (D-FINE, torchvision, RF-DETR)"
)


def _known_meaning(
    output: NDArray[np.float32], named: int, canvas: tuple[int, int], place: str
) -> Columns | None:
    try:
        return meaning(output, named, canvas)
    except UnclearColumnsError as error:
        found = f"1x{'x'.join(map(str, output.shape))} with {error}"
        raise ModelError(place, found, KNOWN) from None


def choose_layout(
    outputs: list[NDArray[np.float32]],
    canvas: tuple[int, int],
    metadata: OnnxMetadata,
    names: Mapping[int, str],
    place: str,
) -> tuple[BoxOutputs, Layout, Mapping[int, str], int]:
    """Box outputs, layout, class names and number of classes of a model.

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
    where = find_boxes(outputs)
    if where is None:
        raise refusal
    table = np.asarray(where.of(outputs), np.float32)
    output = table if table.ndim == 2 else table[0]
    names = names or metadata.names
    apart = len(where.parts) == 2
    layout, count = _Choice(output, canvas, metadata, len(names), place, apart).layout()
    if layout is None or (table.ndim == 2 and not isinstance(layout, TableLayout)):
        raise refusal
    if not names and (count in _COCO_91 or (len(where.parts) == 3 and table.ndim == 2)):
        # torchvision and DETR count the classes as the data set's files do.
        names = COCO_91
    if not names and count in (0, len(COCO_NAMES)):
        # Files without metadata have the 80 classes of COCO, unless the user names others.
        names = dict(enumerate(COCO_NAMES))
    if not names:
        expected = "metadata 'names' in the file, or the option class_names"
        raise ModelError(place, f"{count} classes without names", expected)
    if count and len(names) != count and names is not COCO_91:
        raise ModelError(place, f"{len(names)} class names", f"{count}, as its output {seen} says")
    return where, layout, names, count or max(names) + 1


@dataclass(frozen=True, slots=True)
class _Choice:
    """One image's output, and what is known about its model."""

    output: NDArray[np.float32]
    canvas: tuple[int, int]
    metadata: OnnxMetadata
    named: int
    place: str
    apart: bool

    def layout(self) -> tuple[Layout | None, int]:
        """The layout, None when it is none; its number of classes, 0 when it can't say."""
        a, b = self.output.shape
        for strides in GRID_STRIDES:
            cells = cell_count(self.canvas, strides)
            if b == cells and a > 4 and not self.metadata.end2end:
                return RawLayout(self._are_logits(self.output[4:])), a - 4
            if a == cells and (found := self._per_cell(strides)):
                return found
            if a == 3 * cells and b > 6:
                return self._per_anchor(strides)
        if b in (6, 7) and not self.apart:
            tell = partial(_known_meaning, named=self.named, canvas=self.canvas, place=self.place)
            suppressed = bool(self.metadata.end2end)
            return TableLayout(tell, tell(self.output), self.named, suppressed, self.place), 0
        in_shares = 0.0 < np.abs(np.nan_to_num(self.output[:, :4])).max(initial=0.0) <= _MOST_SHARE
        classes = (self.named,) if self.named else (len(COCO_NAMES), *_COCO_91)
        if b > 4 and in_shares and b - 4 in (*classes, self.named + 1 if self.apart else 0):
            scores = self.output[:, 4:]
            logits = bool(scores.min() < 0.0 or scores.max() > 1.0)
            # One class more than there are is that of no object (Carion et al. 2020, DETR).
            softmax = self.apart and logits and b - 4 == (self.named or max(_COCO_91) - 1) + 1
            return TransformerLayout(logits, softmax), b - 4 - softmax
        return None, 0

    def _per_cell(self, strides: tuple[int, ...]) -> tuple[Layout, int] | None:
        """One box per cell; None when its columns are those of a table."""
        b = self.output.shape[1]
        known = self.named or len(COCO_NAMES)
        pair = None
        if b == 6 and self.named in (1, 2):
            pair = _meaning_or_none(self.output, self.named, self.canvas)
        if b > 4 and b - 4 == known and (b != 6 or (pair is not None and pair.second >= 0)):
            return TransposedLayout(self._are_logits(self.output[:, 4:].T)), b - 4
        if b <= 5 or self.metadata.task is not None or (b == 6 and self.named != 1):
            return None
        if pair is not None and pair.second < 0:
            return None
        # Decoded centres lie all over the canvas, offsets within a cell or two.
        decoded = bool(np.median(self.output[:, 0]) > 0.25 * self.canvas[0])
        # YOLOv6 writes 1 for every objectness, and is fed as YOLOv5 is.
        rgb = decoded and bool((self.output[:, 4] == 1.0).all())
        return GridLayout(strides, decoded, rgb), b - 5

    def _per_anchor(self, strides: tuple[int, ...]) -> tuple[Layout | None, int]:
        """Three boxes per cell, decoded."""
        finite = np.nan_to_num(self.output)
        size, scores = finite[:, 2:4], finite[:, 4:]
        if size.min() < 0.0 or not size.max() or scores.min() < 0.0 or scores.max() > 1.0 + _SLACK:
            return None, 0
        shares = bool(np.abs(finite[:, :4]).max() <= _MOST_SHARE)
        name = "anchors 1xNx(5+classes)"
        return GridLayout(strides, True, True, shares, name), self.output.shape[1] - 5

    def _are_logits(self, scores: NDArray[np.float32]) -> bool:
        """Whether scores (classes, N) lack the sigmoid; refuses what are no scores at all."""
        known = scores[np.isfinite(scores)]
        if known.size and (known.min() < -_SLACK or known.max() > 1.0 + _SLACK):
            # On a grey canvas there is nothing: most cells say so of every class.
            if np.isfinite(scores).all() and (np.median(scores, axis=1) < _NOTHING_LOGIT).all():
                return True
            shape = "x".join(map(str, self.output.shape))
            found = f"1x{shape} with values from {known.min():.3g} to {known.max():.3g}"
            expected = "class scores from 0 to 1 after the box: no poses, masks or rotated boxes"
            raise ModelError(self.place, f"{found} behind the box", expected)
        return False


_COCO_91 = (91, 92)
"""Numbers of classes of models that count COCO's as its files do, the second with that of no
object."""
_NOTHING_LOGIT = -1.5
"""Log-odds of no vehicle in a cell without one, or less. Chosen: a share of 0.18; trained models
write -4 and less, while angles, key points and coefficients of masks are around 0 or positive."""
_SLACK = 1e-2
"""By which a score may miss its bounds. Chosen: what half precision and quantised models miss."""


def _meaning_or_none(
    output: NDArray[np.float32], named: int, canvas: tuple[int, int]
) -> Columns | None:
    try:
        return meaning(output, named, canvas)
    except UnclearColumnsError:
        return None


def _plural(count: int, word: str) -> str:
    return word if count == 1 else f"{count} {word}s"
