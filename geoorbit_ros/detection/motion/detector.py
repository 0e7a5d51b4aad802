"""Vehicles found by their motion in front of the empty road, by cameras that stand still."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.plugins import register
from geoorbit_ros.core.tables import CAR, MOTORCYCLE, TRUCK
from geoorbit_ros.detection.detector import DetectorSettings, Image, as_bgr, detection_rows
from geoorbit_ros.detection.motion.background import RoadBackground
from geoorbit_ros.detection.motion.blobs import Vehicle, busy_rows, find_vehicles, touches_border
from geoorbit_ros.detection.motion.road_axes import RoadAxes
from geoorbit_ros.detection.motion.road_shift import RoadShift
from geoorbit_ros.detection.motion.shadows import ShadowModel
from geoorbit_ros.detection.motion.trajectories import Trajectories
from geoorbit_ros.detection.motion.vehicle_shapes import VehicleOutlines, VehicleSizes

WORK_WIDTH_PX = 1280
"""Wider images are worked on at this width. Chosen: wider ones show smaller vehicles and take more
time; `benchmarks/motion.py` measures films of this width."""
BEST_SCORE = 0.9
"""Score of a vehicle that looks exactly like a car. Chosen below 1: no model has confirmed it."""
LEARN_FRAMES = 20
"""Sizes are learnt anew once in so many frames. Chosen: more frames follow a new camera later,
fewer take more time."""
SHADOW_PERIOD_S = 0.12
"""Shadows are learnt from one image in so much time. Chosen: longer periods follow the sun later,
shorter ones take more time."""
EDGE_PX = 0.5
"""Edges are blurred, and the difference already exceeds the threshold half a pixel before the edge.
Checked by `test_edges_are_where_they_are_in_the_middle`."""
BENEATH_SHARE = 0.035
"""Share of a box's height, from below, that is the darkness beneath the vehicle. Checked by
`test_edges_are_where_they_are_in_the_middle`."""
CHANGED_SHARE = 0.5
"""More of the image than this changes at once only with the camera or the light. Chosen: larger
misses such changes, smaller takes dense traffic for one."""
CHANGED_FRAMES = 5
"""After so many changed frames the road is learnt anew. Chosen: more lose time, fewer react to a
flash of light."""
TRUCK_AREA = 2.2
"""A box of more than this many cars' area is a truck. Chosen: larger calls trucks cars, smaller
calls vans trucks."""
MIN_CLASS_PX = 8.0
"""Where a car is less high, everything is called a car: its size is known to a pixel or two.
Chosen: larger tells fewer apart, smaller calls far cars trucks."""
MOST_COVERED = 0.3
"""Share of the road that may be covered in the mean. Chosen: in a real film with 0.23 half of the
vehicles are found; larger tells it later, smaller doubts busy roads seen from high up."""
COVERED_TIME_S = 20.0
"""Time over which that is taken. Chosen: longer than a platoon, shorter than a red light."""
DOUBTFUL_BOXES = 2000
"""After so many boxes sizes should be known. Chosen: a minute of five vehicles in each image;
larger tells it later, smaller doubts quiet roads."""
MOTORCYCLE_WIDTH = 0.5
"""A box narrower than this many cars is a motorcycle. Chosen: about 0.8 m over 1.8 m, and a
margin."""


@register("detector", "motion")
class MotionDetector:
    """Finds all that moves on the road of a camera that stands still.

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

    @classmethod
    def from_settings(cls, settings: DetectorSettings) -> Self:
        """A detector that keeps boxes from `min_score` on."""
        return cls(settings.min_score)

    def warm_up(self, images: Iterable[tuple[int, NDArray[np.generic]]]) -> None:
        """See `Detector`: the road, the shadows and the sizes are known from the first image on."""
        for stamp_ns, image in images:
            self.detect(stamp_ns, image)
        self._road.rewind()

    @property
    def doubt(self) -> str:
        """Why its boxes may be wrong, in one sentence; empty while nothing says so."""
        if self._covered > MOST_COVERED and self._watched_s >= COVERED_TIME_S:
            share = f"{100 * self._covered:.0f} % of the road is covered by vehicles"
            return f"{share}: the motion detector can't tell them apart, a YOLO model can (--model)"
        if not self._sizes.known and self._found >= DOUBTFUL_BOXES:
            unknown = f"no size of vehicles is known after {self._found} boxes"
            alone = f"vehicles that drove by themselves: {self._alone}"
            return f"{unknown} ({alone}): boxes are rough, a YOLO model is better (--model)"
        return ""

    def detect(self, stamp_ns: int, image: NDArray[np.generic]) -> NDArray[np.void]:
        """See `Detector`."""
        whole = as_bgr(image)
        size = (whole.shape[1], whole.shape[0])
        if size != self._size:
            self._size = size
            self._forget()
        scale = min(1.0, WORK_WIDTH_PX / size[0])
        smaller = whole if scale == 1.0 else _resized(whole, scale)
        self._road.sample(stamp_ns, smaller)
        vehicles = self._vehicles(stamp_ns, smaller) if self._road.ready else []
        self._found += len(vehicles)
        return self._rows(vehicles, scale, size)

    def _forget(self) -> None:
        self._road, self._shadows, self._sizes = RoadBackground(), ShadowModel(), VehicleSizes()
        self._watch, self._outlines, self._axes = RoadShift(), VehicleOutlines(), RoadAxes()
        self._trajectories = Trajectories()
        self._frames = self._changed = 0
        self._learnt_ns: int | None = None
        self._covered_ns: int | None = None
        self._covered = self._watched_s = 0.0
        self._found = self._alone = 0

    def _vehicles(self, stamp_ns: int, image: Image) -> list[Vehicle]:
        moving = self._road.moving(image)
        road = self._road.image
        if self._is_other_road(stamp_ns, image, road, moving):
            return []
        self._road.follow(stamp_ns, image, moving)
        last = self._learnt_ns
        if last is None or not 0 <= stamp_ns - last < SHADOW_PERIOD_S * 1e9:
            self._learnt_ns = stamp_ns
            self._shadows.learn(image, road, moving)
        rows = busy_rows(moving)
        vehicle = np.zeros_like(moving)
        solid = self._shadows.remove(image[rows], road[rows], moving[rows])
        cv2.medianBlur(solid, 3, dst=vehicle[rows])
        vehicles = find_vehicles(moving, vehicle, self._sizes, self._outlines, self._axes)
        inside = [v for v in vehicles if not touches_border(v.box, image.shape)]
        boxes, isolated = [v.box for v in inside], [v.whole for v in inside]
        travelled = self._trajectories.add(stamp_ns, boxes, isolated)
        self._axes.add(travelled)
        self._alone += travelled.vehicles
        self._sizes.add(travelled.boxes[travelled.isolated], travelled.teaching)
        if self._frames % LEARN_FRAMES == 0:
            self._sizes.learn()
        self._frames += 1
        if self._frames % LEARN_FRAMES == 0:
            self._note_cover(stamp_ns, moving)
        return [
            vehicle
            for vehicle in vehicles
            if self._axes.on_road(vehicle.box) or self._trajectories.follows(stamp_ns, vehicle.box)
        ]

    def _note_cover(self, stamp_ns: int, moving: NDArray[np.uint8]) -> None:
        share = self._axes.covered_share(moving)
        last_ns, self._covered_ns = self._covered_ns, stamp_ns
        if np.isfinite(share) and last_ns is not None:
            elapsed_s = max((stamp_ns - last_ns) / 1e9, 0.0)
            self._watched_s += elapsed_s
            time_s = min(self._watched_s, COVERED_TIME_S)
            self._covered += min(elapsed_s / max(time_s, 1e-9), 1.0) * (share - self._covered)

    def _is_other_road(
        self, stamp_ns: int, image: Image, road: Image, moving: NDArray[np.uint8]
    ) -> bool:
        """Whether the image shows another road than the known one; then it is learnt anew."""
        shift = self._watch.shift(stamp_ns, image, road)
        self._road.allow_sway(self._watch.sway_px)
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

    def _rows(
        self, vehicles: list[Vehicle], scale: float, size: tuple[int, int]
    ) -> NDArray[np.void]:
        score = BEST_SCORE * np.array(
            [vehicle.similarity for vehicle in vehicles], dtype=np.float64
        )
        boxes = np.array([vehicle.box for vehicle in vehicles], dtype=np.float64).reshape(-1, 4)
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
            rows = boxes.astype(int).tolist()
            known = [self._sizes.knows((a, b, c, d)) for a, b, c, d in rows]
            clear = (car[:, 1] >= MIN_CLASS_PX) & np.array(known)
            classes[clear & (share.prod(axis=1) > TRUCK_AREA)] = TRUCK
            classes[clear & (share[:, 0] < MOTORCYCLE_WIDTH)] = MOTORCYCLE
        return classes


def _resized(image: Image, scale: float) -> Image:
    smaller = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(smaller, dtype=np.uint8)
