"""From the network's output to boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import BUS, CAR, MOTORCYCLE, TRUCK
from geoorbit_ros.detection.network.channels import STRIDE_PX
from geoorbit_ros.detection.onnx.yolo import suppress

BICYCLE = -2
"""Stands for the network's class that is no vehicle: such boxes are left out."""
CLASS_IDS = np.array([CAR, MOTORCYCLE, BUS, TRUCK, BICYCLE])
"""COCO numbers of the network's classes, in its order."""


@dataclass(frozen=True, slots=True)
class Boxes:
    """Boxes in the image that the network saw.

    Attributes:
        corners: (N, 4) left, top, right, bottom in pixels.
        score: (N,) from 0 to 1.
        class_id: (N,) COCO numbers.
    """

    corners: NDArray[np.float64]
    score: NDArray[np.float64]
    class_id: NDArray[np.int64]

    def kept(self, which: NDArray[np.generic]) -> Boxes:
        """Some of them, by number or by truth value."""
        return Boxes(self.corners[which], self.score[which], self.class_id[which])


def decode(found: NDArray[np.float32], min_score: float, max_iou: float) -> Boxes:
    """The boxes in (5 + classes, rows, columns), the output of the network.

    Args:
        found: Score of a middle, four distances to the sides in pixels, class logits.
        min_score: Middles that score less are no vehicles.
        max_iou: Of two boxes that overlap more than this, the lesser goes.
    """
    row, column = np.nonzero(found[0] >= min_score)
    cells = found[:, row, column].T.astype(np.float64)
    middle = np.column_stack((column, row)) * STRIDE_PX + 0.5 * STRIDE_PX
    corners = np.hstack((middle - cells[:, 1:3], middle + cells[:, 3:5]))
    score, class_id = cells[:, 0], CLASS_IDS[cells[:, 5:].argmax(axis=1)]
    kept = suppress(corners, score, np.zeros(len(score), dtype=np.int64), max_iou)
    kept = kept[class_id[kept] != BICYCLE]
    return Boxes(corners[kept], score[kept], class_id[kept])
