"""Vehicles found by their motion in front of the empty road, by cameras that stand still."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Image, as_bgr, detection_rows
from geoorbit_ros.detection.motion.background import RoadBackground
from geoorbit_ros.detection.motion.blobs import Blob, find_blobs
from geoorbit_ros.detection.motion.pixels import busy_rows
from geoorbit_ros.detection.motion.road_axes import RoadAxes
from geoorbit_ros.detection.motion.shadows import ShadowModel
from geoorbit_ros.detection.motion.vehicle_shapes import Silhouettes, VehicleSizes
from geoorbit_ros.detection.motion.view_watch import CameraWatch
from geoorbit_ros.detection.vehicle_classes import CAR, MOTORCYCLE, TRUCK

WORK_WIDTH_PX = 1280
"""Wider images are worked on at this width."""
BEST_SCORE = 0.9
LEARN_FRAMES = 20
"""Sizes are learnt anew once in so many frames."""
SHADOW_PERIOD_S = 0.12
"""Shadows are learnt from one picture in so much time."""
EDGE_PX = 0.5
"""Edges are blurred, and a vehicle begins where it differs a little: half a pixel too early."""
BENEATH_SHARE = 0.035
"""Of a box's height, from below, is the darkness beneath the vehicle rather than the vehicle."""
CHANGED_SHARE = 0.5
"""More of the image than this doesn't change at once unless the camera or the light does."""
CHANGED_FRAMES = 5
TRUCK_AREA, MOTORCYCLE_WIDTH = 2.2, 0.5
"""Of a car's: what is larger is called a truck, what is narrower a motorcycle."""


class MotionDetector:
    """Finds whatever moves on the road of a camera that stands still.

    Everything that depends on the place is learnt from the images: the empty road, how dark shadows
    are, how large a car is where. The first second gives no boxes, the first minute worse ones.

    Args:
        min_score: Boxes that score less are dropped.

    Attributes:
        relearned: How often the road was learnt anew, because the camera or the light changed.
    """

    name = "motion"

    def __init__(self, min_score: float = 0.25) -> None:
        self.min_score = min_score
        self.relearned = 0
        self._size: tuple[int, int] | None = None
        self._forget()

    def warm_up(self, images: Iterable[tuple[int, NDArray[np.generic]]]) -> None:
        """See `Detector`: the road, the shadows and the sizes are known from the first image on."""
        for stamp_ns, image in images:
            self.detect(stamp_ns, image)
        self._road.rewind()

    def detect(self, stamp_ns: int, image: NDArray[np.generic]) -> NDArray[np.void]:
        """See `Detector`."""
        whole = as_bgr(image)
        size = (whole.shape[1], whole.shape[0])
        if size != self._size:
            self._size = size
            self._forget()
        scale = min(1.0, WORK_WIDTH_PX / size[0])
        picture = whole if scale == 1.0 else _resized(whole, scale)
        self._road.sample(stamp_ns, picture)
        blobs = self._blobs(stamp_ns, picture) if self._road.ready else []
        return self._rows(blobs, scale, size)

    def _forget(self) -> None:
        self._road, self._shadows, self._sizes = RoadBackground(), ShadowModel(), VehicleSizes()
        self._watch, self._shapes, self._axes = CameraWatch(), Silhouettes(), RoadAxes()
        self._frames = self._changed = 0
        self._learnt_ns: int | None = None

    def _blobs(self, stamp_ns: int, picture: Image) -> list[Blob]:
        moving = self._road.moving(picture)
        road = self._road.picture
        if self._is_other_road(stamp_ns, picture, road, moving):
            return []
        self._road.follow(stamp_ns, picture, moving)
        last = self._learnt_ns
        if last is None or not 0 <= stamp_ns - last < SHADOW_PERIOD_S * 1e9:
            self._learnt_ns = stamp_ns
            self._shadows.learn(picture, road, moving)
        rows = busy_rows(moving)
        vehicle = np.zeros_like(moving)
        solid = self._shadows.remove(picture[rows], road[rows], moving[rows])
        cv2.medianBlur(solid, 3, dst=vehicle[rows])
        blobs = find_blobs(moving, vehicle, self._sizes, self._shapes, self._axes)
        whole = [blob.box for blob in blobs if blob.whole]
        self._axes.add(stamp_ns, whole)
        self._sizes.add(np.array(whole, dtype=np.float64).reshape(-1, 4))
        if self._frames % LEARN_FRAMES == 0:
            self._sizes.learn()
        self._frames += 1
        return blobs

    def _is_other_road(
        self, stamp_ns: int, picture: Image, road: Image, moving: NDArray[np.uint8]
    ) -> bool:
        """Whether the picture shows another road than the known one; then it is learnt anew."""
        shift = self._watch.shift(stamp_ns, picture, road)
        if shift is not None:
            self.relearned += 1
            self._road.move(shift)
            return True
        changed = cv2.countNonZero(moving) > CHANGED_SHARE * moving.size
        self._changed = self._changed + 1 if changed else 0
        if self._changed >= CHANGED_FRAMES:
            self.relearned += 1
            self._road, self._shadows, self._changed = RoadBackground(), ShadowModel(), 0
        return changed

    def _rows(self, blobs: list[Blob], scale: float, size: tuple[int, int]) -> NDArray[np.void]:
        score = BEST_SCORE * np.array([blob.likeness for blob in blobs], dtype=np.float64)
        boxes = np.array([blob.box for blob in blobs], dtype=np.float64).reshape(-1, 4)
        kept = score >= self.min_score
        boxes, score = boxes[kept], score[kept]
        classes = self._classes(boxes)
        boxes += [EDGE_PX, EDGE_PX, -EDGE_PX, -EDGE_PX]
        inside = boxes[:, 3] < size[1] * scale - 1.0
        boxes[inside, 3] -= BENEATH_SHARE * (boxes[inside, 3] - boxes[inside, 1])
        return detection_rows(boxes / scale, score, classes, size)

    def _classes(self, boxes: NDArray[np.float64]) -> NDArray[np.int64]:
        classes = np.full(len(boxes), CAR, dtype=np.int64)
        if self._sizes.known and len(boxes):
            car = self._sizes.at(0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3])
            share = (boxes[:, 2:] - boxes[:, :2]) / car
            classes[share.prod(axis=1) > TRUCK_AREA] = TRUCK
            classes[share[:, 0] < MOTORCYCLE_WIDTH] = MOTORCYCLE
        return classes


def _resized(image: Image, scale: float) -> Image:
    smaller = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(smaller, dtype=np.uint8)
