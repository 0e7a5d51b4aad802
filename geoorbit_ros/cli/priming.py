"""A look at a recording before it is worked on, for detectors that learn from the camera."""

from __future__ import annotations

from collections.abc import Iterator

from geoorbit_ros.detection.detector import Detector
from geoorbit_ros.storage.frames.source import FrameSource, StampedImage

SPACING_S = 0.25
"""Time between the images looked at."""
LONGEST_S = 120.0
"""Of a longer recording, the beginning."""


def prime_detector(detector: Detector, images: FrameSource, duration_s: float | None) -> None:
    """Let the detector see a recording once, under a progress bar; a stream can't be seen twice.

    A detector that learns nothing takes no image, so that nothing is read.
    """
    if not images.live:
        detector.prime(_some(images, min(duration_s or LONGEST_S, LONGEST_S)))


def _some(images: FrameSource, duration_s: float) -> Iterator[StampedImage]:
    from geoorbit_ros.cli.console import track

    count = images.frame_count
    if images.fps:
        count = min(count or 10**9, round(duration_s * images.fps))
    first_ns = last_ns = None
    for stamp_ns, image in track(images, "learning the road", count):
        first_ns = stamp_ns if first_ns is None else first_ns
        if stamp_ns - first_ns >= duration_s * 1e9:
            return
        if last_ns is None or stamp_ns - last_ns >= SPACING_S * 1e9:
            last_ns = stamp_ns
            yield stamp_ns, image
