"""Vehicles found by the package's own network, by cameras that stand still."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Self

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from geoorbit_ros.core.plugins import register
from geoorbit_ros.detection.detector import (
    MIN_SIDE_PX,
    DetectorSettings,
    Image,
    as_bgr,
    detection_rows,
)
from geoorbit_ros.detection.motion.background import RoadBackground
from geoorbit_ros.detection.motion.road_shift import RoadShift
from geoorbit_ros.detection.network.boxes import Boxes, decode
from geoorbit_ros.detection.network.channels import PAST_S, channels, work_size
from geoorbit_ros.detection.network.driven_places import DrivenPlaces

WEIGHTS = Path(__file__).with_name("vehicles.onnx")
"""What the network learnt; `MODEL_CARD.md` beside it says from what."""
MAX_IOU = 0.6
"""Of two boxes that overlap more than this, the lesser goes. Chosen: larger gives one vehicle two
boxes, smaller loses vehicles behind others."""
LONGEST_PAST_S = 0.5
"""An earlier image that is older than this is not shown to the network: it never saw such."""
CHANGED_SHARE = 0.5
"""More of the image than this changes at once only with the camera or the light. Chosen: larger
misses such changes, smaller takes dense traffic for one."""
CHANGED_FRAMES = 5
"""After so many changed frames the road is learnt anew. Chosen: more lose time, fewer react to a
flash of light."""
_COARSE = 1.3
"""Images that get smaller by more than this are averaged, those by less interpolated, which is
faster."""
_ERRORS_ONLY = 3
"""onnxruntime's log level for errors and worse."""


@register("detector", "network")
class NetworkDetector:
    """Finds vehicles by a small network that sees the image, the empty road and the past.

    The road is learnt from the images as the motion detector learns it; until it is known, and for
    the first image, the network sees the image alone.

    Args:
        min_score: Boxes that score less are dropped.
        threads: Threads of one run; from settings that leave it open, one.

    Attributes:
        relearned: How often the road was learnt anew, because the camera or the light changed.
    """

    name = "network"

    def __init__(self, min_score: float = 0.25, threads: int = 1) -> None:
        self.min_score = min_score
        self.relearned = 0
        options = onnxruntime.SessionOptions()
        options.log_severity_level = _ERRORS_ONLY
        options.intra_op_num_threads = threads
        # Threads that spin between frames take the cores that other nodes need.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self._session = onnxruntime.InferenceSession(
            str(WEIGHTS), options, providers=["CPUExecutionProvider"]
        )
        self._size = (MIN_SIDE_PX, MIN_SIDE_PX)
        self._forget()

    @classmethod
    def from_settings(cls, settings: DetectorSettings) -> Self:
        """A detector that keeps boxes from `min_score` on."""
        return cls(settings.min_score, settings.threads or 1)

    def warm_up(self, images: Iterable[tuple[int, NDArray[np.generic]]]) -> None:
        """See `Detector`: the road and where vehicles drive are known from the first image on."""
        for stamp_ns, image in images:
            self.detect(stamp_ns, image)
        self._road.rewind()
        self._past.clear()

    def detect(self, stamp_ns: int, image: NDArray[np.generic]) -> NDArray[np.void]:
        """See `Detector`."""
        whole = as_bgr(image)
        size = (whole.shape[1], whole.shape[0])
        if size != self._size:
            self._size = size
            self._forget()
        small = _resized(whole, work_size(size))
        road = self._known_road(stamp_ns, small)
        past = self._image_before(stamp_ns, small)
        seen = channels(small, road, past)
        (found,) = self._session.run(None, {"image": seen[None]})
        boxes = decode(np.asarray(found, np.float32), self.min_score, MAX_IOU)
        if past is not None:
            boxes = boxes.kept(self._places.plausible(stamp_ns, boxes, seen[..., 4]))
        return self._rows(boxes, (small.shape[1], small.shape[0]))

    def _forget(self) -> None:
        self._road, self._watch, self._changed = RoadBackground(), RoadShift(), 0
        self._past: deque[tuple[int, Image]] = deque()
        self._places = DrivenPlaces(work_size(self._size))

    def _known_road(self, stamp_ns: int, image: Image) -> Image | None:
        """The empty road as it looks now; None where it is not known."""
        self._road.sample(stamp_ns, image)
        if not self._road.ready:
            return None
        moving = self._road.moving(image)
        shift = self._watch.shift(stamp_ns, image, self._road.image)
        self._road.allow_sway(self._watch.sway_px)
        if shift is not None:
            self.relearned += 1
            self._road.move(shift)
            self._places = DrivenPlaces((image.shape[1], image.shape[0]))
            return None
        changed = cv2.countNonZero(moving) > CHANGED_SHARE * moving.size
        self._changed = self._changed + 1 if changed else 0
        if self._changed >= CHANGED_FRAMES:
            self.relearned += 1
            self._road, self._changed = RoadBackground(), 0
        if changed:
            return None
        self._road.follow(stamp_ns, image, moving)
        return self._road.image

    def _image_before(self, stamp_ns: int, image: Image) -> Image | None:
        """The image of `PAST_S` ago; None where there is none of that time."""
        past = self._past
        if past and not stamp_ns - past[-1][0] > 0:
            past.clear()
        while len(past) > 1 and stamp_ns - past[1][0] >= 0.75e9 * PAST_S:
            past.popleft()
        earlier = past[0] if past else None
        past.append((stamp_ns, image))
        if earlier is None or stamp_ns - earlier[0] > LONGEST_PAST_S * 1e9:
            return None
        return earlier[1]

    def _rows(self, boxes: Boxes, seen: tuple[int, int]) -> NDArray[np.void]:
        scale = np.array(self._size, dtype=np.float64) / seen
        corners = boxes.corners * np.tile(scale, 2)
        return detection_rows(corners, boxes.score, boxes.class_id, self._size)


def _resized(image: Image, size: tuple[int, int]) -> Image:
    whole = min(image.shape[1] // size[0], image.shape[0] // size[1])
    if whole > 1:  # OpenCV averages whole blocks of pixels many times as fast as parts of them.
        parts = (image.shape[1] // whole, image.shape[0] // whole)
        image = np.asarray(cv2.resize(image, parts, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    how = cv2.INTER_AREA if image.shape[1] > _COARSE * size[0] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=how), dtype=np.uint8)
