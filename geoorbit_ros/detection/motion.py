"""Vehicles found by their motion in front of the empty road, by cameras that stand still."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import as_bgr, detection_rows
from geoorbit_ros.detection.motion_background import RoadBackground
from geoorbit_ros.detection.motion_shadow import ShadowModel

WORK_WIDTH_PX = 1280
"""Wider images are worked on at this width."""


class MotionDetector:
    """Finds whatever moves on the road of a camera that stands still.

    Args:
        min_score: Boxes that score less are dropped.
    """

    name = "motion"

    def __init__(self, min_score: float = 0.25) -> None:
        self.min_score = min_score
        self.bg = RoadBackground()
        self.sh = ShadowModel()
        self._debug = np.zeros((2, 2), np.uint8)

    def detect(self, stamp_ns: int, image: NDArray[np.generic]) -> NDArray[np.void]:
        """See `Detector`."""
        im = as_bgr(image)
        height, width = im.shape[:2]
        f = min(1.0, WORK_WIDTH_PX / width)
        if f < 1:
            im = np.asarray(
                cv2.resize(im, None, fx=f, fy=f, interpolation=cv2.INTER_AREA), np.uint8
            )
        self.bg.sample(stamp_ns, im)
        if not self.bg.ready:
            return detection_rows(
                np.zeros((0, 4)), np.zeros(0), np.zeros(0, np.int64), (width, height)
            )
        diff, road = self.bg.difference(im)
        m = np.asarray(cv2.compare(diff, self.bg.contrast, cv2.CMP_GT), np.uint8)
        free = cv2.bitwise_not(cv2.dilate(m, np.ones((5, 5), np.uint8)))
        self.bg.follow(stamp_ns, im, diff, np.asarray(free, np.uint8))
        m2 = cv2.medianBlur(self.sh.remove(im, road, m), 3)
        m3 = cv2.morphologyEx(m2, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
        self._debug = np.where(m3 > 0, np.where(m2 > 0, 255, 180), np.where(m > 0, 90, 0)).astype(
            np.uint8
        )
        _, _, st, _ = cv2.connectedComponentsWithStats(m3, connectivity=8)
        st = st[1:]
        st = st[(st[:, 4] >= 30) & (st[:, 3] >= 6)]
        b = np.column_stack([st[:, 0], st[:, 1], st[:, 0] + st[:, 2], st[:, 1] + st[:, 3]]) / f
        return detection_rows(
            b, np.full(len(b), 0.6), np.full(len(b), 2, np.int64), (width, height)
        )
