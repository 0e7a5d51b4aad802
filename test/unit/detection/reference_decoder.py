"""The published way from a model's output to boxes, one number at a time, to compare with."""

import math

import numpy as np
from numpy.typing import NDArray

Box = tuple[float, float, float, float, float, int]
"""Left, top, right, bottom in image pixels, score, class of the model."""


def decode(
    layout: str,
    output: NDArray[np.float32],
    image_size: tuple[int, int],
    canvas: tuple[int, int],
    wanted: set[int],
    min_score: float = 0.25,
    max_iou: float = 0.7,
) -> list[Box]:
    boxes = [box for box in _numbers(layout, output, canvas, min_score) if box[5] in wanted]
    if layout != "nms_free":
        boxes = _suppressed(boxes, max_iou)
    width, height = image_size
    gain = min(canvas[0] / width, canvas[1] / height)
    left = top = 0.0
    if layout != "grid":
        left = round((canvas[0] - round(width * gain)) / 2 - 0.1)
        top = round((canvas[1] - round(height * gain)) / 2 - 0.1)
    found = []
    for a, b, c, d, score, number in boxes:
        edges = [(a - left) / gain, (b - top) / gain, (c - left) / gain, (d - top) / gain]
        limits = [width, height, width, height]
        a, b, c, d = (min(max(e, 0.0), float(n)) for e, n in zip(edges, limits, strict=True))
        if c > a and d > b:
            found.append((a, b, c, d, score, number))
    return sorted(found, key=lambda box: -box[4])


def _numbers(
    layout: str, output: NDArray[np.float32], canvas: tuple[int, int], min_score: float
) -> list[Box]:
    found: list[Box] = []
    if layout == "nms_free":
        for a, b, c, d, score, number in output.tolist():
            if score > min_score:
                found.append((a, b, c, d, score, int(number)))
        return found
    cells = []
    for stride in (8, 16, 32):
        for row in range(canvas[1] // stride):
            for column in range(canvas[0] // stride):
                cells.append((column, row, stride))
    values = output.T.tolist() if layout == "raw" else output.tolist()
    for (column, row, stride), value in zip(cells, values, strict=True):
        x, y, w, h = value[:4]
        scores = value[4:]
        if layout == "grid":
            x, y = (x + column) * stride, (y + row) * stride
            w, h = math.exp(w) * stride, math.exp(h) * stride
            scores = [value[4] * each for each in value[5:]]
        number = scores.index(max(scores))
        if scores[number] > min_score:
            found.append((x - w / 2, y - h / 2, x + w / 2, y + h / 2, scores[number], number))
    return found


def _suppressed(boxes: list[Box], max_iou: float) -> list[Box]:
    kept: list[Box] = []
    for box in sorted(boxes, key=lambda box: -box[4]):
        if all(other[5] != box[5] or iou(other, box) <= max_iou for other in kept):
            kept.append(box)
    return kept


def iou(one: Box, two: Box) -> float:
    width = min(one[2], two[2]) - max(one[0], two[0])
    height = min(one[3], two[3]) - max(one[1], two[1])
    if width <= 0 or height <= 0:
        return 0.0
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (one, two)]
    return width * height / (sum(areas) - width * height)
