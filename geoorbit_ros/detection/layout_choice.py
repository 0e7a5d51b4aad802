"""Which layout a model's output has: from its shape, and from what the file says."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import ModelError
from geoorbit_ros.detection.layouts import (
    GRID_STRIDES,
    GridLayout,
    Layout,
    NmsFreeLayout,
    RawLayout,
    cell_count,
)
from geoorbit_ros.detection.onnx_metadata import OnnxMetadata
from geoorbit_ros.detection.vehicle_classes import COCO_NAMES

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
        # Files without metadata come with the 80 classes of COCO, or the user knows better.
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
