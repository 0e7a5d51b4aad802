"""Detections of one frame, checked and in an order of their own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.tracking.motion_model import MotionNoise, measurement_variance, measurements
from geoorbit_ros.tracking.parameters import TrackerParameters

Array = NDArray[np.float64]

BORDER_RATIO = 0.01
"""Boxes that end within 1 % of the image from its border are cut by it, as in `box_projector`."""
CUT_FACTOR = 10.0
"""Variance of a cut box relative to a whole one: its centre and size aren't the vehicle's."""
MAX_DETECTIONS = 1000
"""More in a frame are no traffic; the most confident are taken."""


@dataclass(frozen=True, slots=True)
class FrameDetections:
    """M detections.

    Attributes:
        box: (4, M) x, y, width, height in pixels.
        measured: (4, M) see `motion.measurements`.
        variance: (4, M) of `measured`.
        score: (M,) confidence.
        strong: (M,) whether it is confident.
        class_id: (M,) COCO class.
        cut: (M,) whether the image border cuts the box; False where the image's size is unknown.
        unusable: Detections left out because a number isn't finite or the box has no area.
    """

    box: Array
    measured: Array
    variance: Array
    score: Array
    strong: NDArray[np.bool_]
    class_id: NDArray[np.int64]
    cut: NDArray[np.bool_]
    unusable: int

    def __len__(self) -> int:
        return len(self.score)


def prepare(
    rows: NDArray[np.void], parameters: TrackerParameters, noise: MotionNoise
) -> FrameDetections:
    """Detections that can be used and are not too weak, the same whatever order they came in."""
    names = ("x", "y", "width", "height", "score")
    value = np.array([rows[name] for name in names], dtype=np.float64).reshape(5, -1)
    usable = np.isfinite(value).all(axis=0) & (value[2] > 0.0) & (value[3] > 0.0)
    keep = np.flatnonzero(usable & (value[4] >= parameters.low_score))
    value, kind = value[:, keep], rows["class_id"][keep].astype(np.int64)
    order = np.lexsort((kind, value[3], value[2], value[1], value[0], -value[4]))[:MAX_DETECTIONS]
    value, kind = value[:, order], kind[order]
    box = value[:4]
    variance = measurement_variance(box, noise)
    cut = _cut(box, parameters.image_width, parameters.image_height)
    variance[:, cut] *= CUT_FACTOR
    unusable = len(rows) - int(np.count_nonzero(usable))
    score, strong = value[4], value[4] >= parameters.high_score
    return FrameDetections(box, measurements(box), variance, score, strong, kind, cut, unusable)


def _cut(box: Array, image_width: int, image_height: int) -> NDArray[np.bool_]:
    if not image_width:
        return np.zeros(box.shape[1], dtype=bool)
    size = np.array([[image_width], [image_height]])
    border, half = BORDER_RATIO * size, 0.5 * box[2:]
    return np.asarray(((box[:2] - half < border) | (box[:2] + half > size - border)).any(axis=0))
