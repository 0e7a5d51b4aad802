"""Which of a model's outputs are its boxes, and how those that stand apart are put together.

Sources: Ultralytics' exporter for segmentation (boxes with coefficients of masks, and the masks);
lyuwenyu/RT-DETR and Peterande/D-FINE (labels, boxes, scores); NVIDIA's EfficientNMS plug-in (count,
boxes, scores, classes); torchvision (boxes, labels, scores); Hugging Face's and Roboflow's DETR
models (class logits and boxes).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Output = NDArray[np.generic]

_WHOLE = 1e-3
"""By which a class number in floats may miss a whole one: steps of half precision."""


@dataclass(frozen=True, slots=True)
class BoxOutputs:
    """The outputs that make one table of boxes.

    Attributes:
        parts: Numbers of the outputs, side by side in the table.
        columns: How many columns (`by_column`) or rows of the table count; None: all. What is
            behind them are coefficients of masks.
        by_column: Whether a box is a row.
    """

    parts: tuple[int, ...]
    columns: int | None = None
    by_column: bool = True

    def of(self, outputs: Sequence[Output]) -> Output:
        """The table: (B, A, C), or (A, C) where the model's outputs have no batch."""
        table = outputs[self.parts[0]]
        if len(self.parts) > 1:
            others = [outputs[k] for k in self.parts[1:]]
            beside = [o if o.ndim == table.ndim else o[..., None] for o in others]
            table = np.concatenate([each.astype(np.float32) for each in (table, *beside)], axis=-1)
        if self.columns is None:
            return table
        return table[..., : self.columns] if self.by_column else table[:, : self.columns]


def find_boxes(outputs: Sequence[Output]) -> BoxOutputs | None:
    """The outputs of a model that are its boxes; None: it can't be told."""
    # Feature maps beside the boxes, as older exports of YOLOv5 have them, are not needed.
    used = [k for k, output in enumerate(outputs) if output.ndim < 5]
    floats = [k for k in used if outputs[k].dtype.kind == "f"]
    if len(used) == 1:
        flat = outputs[used[0]].ndim in (2, 3) and used == floats
        return BoxOutputs((used[0],)) if flat else None
    masks = [k for k in used if outputs[k].ndim == 4]
    if len(used) == 2 and len(masks) == 1:
        return _without_masks(outputs, next(k for k in used if k not in masks), masks[0])
    boxes = [k for k in floats if outputs[k].ndim in (2, 3) and outputs[k].shape[-1] == 4]
    if len(boxes) != 1:
        return None
    rest = [k for k in used if k not in (boxes[0], *masks)]
    count = outputs[boxes[0]].shape[:-1]
    logits = [k for k in rest if k in floats and outputs[k].shape[:-1] == count]
    if len(rest) == 1 and len(logits) == 1:
        return BoxOutputs((boxes[0], logits[0]))
    lists = [k for k in rest if outputs[k].shape == count]
    kinds = [k for k in lists if _is_whole(outputs[k])]
    scores = [k for k in lists if k not in kinds]
    if len(scores) == 2 or len(kinds) == 2:  # nothing was found on a grey canvas: by their types
        kinds = [k for k in lists if outputs[k].dtype.kind in "iu"]
        scores = [k for k in lists if outputs[k].dtype.kind == "f"]
    if len(kinds) == len(scores) == 1:
        return BoxOutputs((boxes[0], scores[0], kinds[0]))
    return None


def _without_masks(outputs: Sequence[Output], table: int, masks: int) -> BoxOutputs | None:
    if outputs[table].ndim != 3 or outputs[table].dtype.kind != "f":
        return None
    rows, columns = outputs[table].shape[1:]
    behind = outputs[masks].shape[1]
    by_column = columns < rows
    left = (columns if by_column else rows) - behind
    return BoxOutputs((table,), left, by_column) if left > 4 else None


def _is_whole(output: Output) -> bool:
    if output.dtype.kind in "iu":
        return True
    return bool((np.abs(output - np.rint(output)) < _WHOLE).all() and output.max(initial=0) > 1)
