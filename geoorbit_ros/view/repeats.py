"""Notices a stream that stands still, or that shows the same sequence again."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.view.looks import Blindness

FROZEN_S = 5.0
"""The same image for this long is no live one. Chosen: encoders send an image anew every two to
four seconds, which changes some pixel; larger counts a dead stream's road as empty for longer."""
REPEATED_S = 3.0
"""So much of a sequence must have been shown before. Chosen: a picture without noise, black for
instance, comes again by chance; a sequence of three seconds does not."""
STILL_S = 60.0
"""Where an encoder sends a dead stream's image anew, pixels change by a level or two each time. An
image that is still for so long but for that is no live one. Chosen: at night a quiet road may be
empty for so long, and then nothing is lost; shorter leaves quiet times out of what was watched."""
STILL_LEVELS = 1.5
"""Levels of 255 by which the mean of no block of 8 x 8 pixels changes meanwhile. Chosen: a car's
lamp in the distance changes one by more, an image that is sent anew by less."""
SAME_SHARE = 0.5
"""Share of the images that are bit by bit those before, in an image that is still. Chosen: encoders
send it anew once or twice a second at most; live cameras have noise in each image, or send no
change where there is none."""
BLOCK_PX = 8
"""Side of a block. Chosen: larger hides a far car, smaller shows the noise of an encoder."""
MEMORY_S = 1800.0
"""Images are remembered for so long. Chosen: loops are seconds to minutes long; half an hour of 25
images a second takes 5 MB."""
MEMORY_IMAGES = 50_000
"""And no more of them than this: memory stays bounded whatever the stamps say."""


class RepeatWatch:
    """Looks at fingerprints of all images, which cost next to nothing.

    A camera's images differ by noise alone: the same bytes again are the same image.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget all images: the source starts again at an earlier time."""
        self._seen: OrderedDict[int, int] = OrderedDict()
        self._last_ns: int | None = None
        self._last = -1
        self._same_since_ns = 0
        self._offset_ns: int | None = None
        self._repeats_since_ns = 0
        self._different = 0
        self._still: NDArray[np.float32] | None = None
        self._still_since_ns = 0
        self._images = self._same = 0

    def look(self, stamp_ns: int, picture: NDArray[np.uint8]) -> Blindness:
        """Take the picture of an image that is looked at; what its stillness says."""
        size = (picture.shape[1] // BLOCK_PX, picture.shape[0] // BLOCK_PX)
        blocks = cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        still = self._still
        if still is None or still.shape != blocks.shape or _changed(blocks, still):
            self._still, self._still_since_ns = np.asarray(blocks), stamp_ns
            self._images = self._same = 0
        long = stamp_ns - self._still_since_ns >= STILL_S * 1e9
        if long and self._same >= SAME_SHARE * max(self._images, 1):
            return Blindness.FROZEN
        return Blindness.NONE

    def add(self, stamp_ns: int, fingerprint: int) -> Blindness:
        """Take one image; what it says about the stream."""
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            self.restart()
        self._images += 1
        self._same += fingerprint == self._last
        if fingerprint != self._last or self._last_ns is None:
            self._same_since_ns = stamp_ns
            self._follow(stamp_ns, fingerprint)
            self._seen[fingerprint] = stamp_ns
            self._seen.move_to_end(fingerprint)
            self._forget(stamp_ns)
        self._last, self._last_ns = fingerprint, stamp_ns
        if stamp_ns - self._same_since_ns >= FROZEN_S * 1e9:
            return Blindness.FROZEN
        repeats = self._offset_ns is not None and self._different >= 8
        if repeats and stamp_ns - self._repeats_since_ns >= REPEATED_S * 1e9:
            return Blindness.REPEATED
        return Blindness.NONE

    def _follow(self, stamp_ns: int, fingerprint: int) -> None:
        """Whether this image was seen as long ago as the one before was."""
        before_ns = self._seen.get(fingerprint)
        if before_ns is None:
            self._offset_ns = None
            return
        offset_ns = stamp_ns - before_ns
        tolerance_ns = 0.5e9
        if self._offset_ns is None or abs(offset_ns - self._offset_ns) > tolerance_ns:
            self._repeats_since_ns, self._different = stamp_ns, 0
        self._offset_ns = offset_ns
        self._different += 1

    def _forget(self, stamp_ns: int) -> None:
        while self._seen:
            oldest, seen_ns = next(iter(self._seen.items()))
            if len(self._seen) <= MEMORY_IMAGES and stamp_ns - seen_ns <= MEMORY_S * 1e9:
                return
            del self._seen[oldest]


def _changed(now: NDArray[Any], then: NDArray[np.float32]) -> bool:
    return float(np.abs(now - then).max()) > STILL_LEVELS
