"""Images in, tracked boxes out, without a ROS graph.

The nodes `detector` and `tracker` call the same objects in the same order, frame by frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Detector


class BoxTracker(Protocol):
    """What gives detections their identity."""

    def update(self, stamp_ns: int, detections: NDArray[np.void]) -> NDArray[np.void]:
        """Tracks at `stamp_ns`, `PIXEL_TRACK_DTYPE`, from `DETECTION_DTYPE` rows."""


@dataclass(frozen=True, slots=True)
class TrackedImage:
    """One image and what was seen in it.

    Attributes:
        stamp_ns: Capture time.
        image: (H, W, 3) uint8 BGR.
        detections: (N,) `DETECTION_DTYPE`.
        tracks: (M,) `PIXEL_TRACK_DTYPE`.
    """

    stamp_ns: int
    image: NDArray[np.uint8]
    detections: NDArray[np.void]
    tracks: NDArray[np.void]


def track_images(
    frames: Iterable[tuple[int, NDArray[np.uint8]]], detector: Detector, tracker: BoxTracker
) -> Iterator[TrackedImage]:
    """Detect and track frame by frame.

    Args:
        frames: Capture time and image, in time order.
        detector: One that has seen no image yet.
        tracker: One that has seen no frame yet.
    """
    for stamp_ns, image in frames:
        detections = detector.detect(stamp_ns, image)
        yield TrackedImage(stamp_ns, image, detections, tracker.update(stamp_ns, detections))
