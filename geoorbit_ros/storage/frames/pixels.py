"""Whatever a camera or a file delivers becomes 8-bit blue, green, red, always of one size."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.storage.frames.source import FrameSourceError, Image


def to_bgr8(image: NDArray[Any], place: str) -> Image:
    """An image as uint8 (H, W, 3).

    Grey becomes three equal channels, a fourth channel (opacity) is dropped, 16-bit values keep
    their upper eight bits.

    Args:
        image: (H, W), or (H, W, C) with 1, 3 or 4 channels; uint8 or uint16.
        place: Where it came from, for the error.

    Raises:
        FrameSourceError: Other shapes or types.
    """
    channels = image.shape[2] if image.ndim == 3 else 1
    usable = image.ndim in (2, 3) and channels in (1, 3, 4) and image.size > 0
    if not usable or image.dtype not in (np.uint8, np.uint16):
        shape = "x".join(map(str, image.shape))
        found = f"an image of {shape} values, {image.dtype}"
        raise FrameSourceError(place, found, "grey or colour, 8 or 16 bits a channel")
    eight = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
    if channels == 3:
        return np.ascontiguousarray(eight)
    if channels == 4:
        return np.ascontiguousarray(eight[:, :, :3])
    return np.repeat(eight.reshape(*eight.shape[:2], 1), 3, axis=2)


class FrameCheck:
    """Turns what a source reads into images of one size, and skips what can't be used.

    Control points are pixels of one image size: boxes in an image of another size would land
    somewhere else on the road.

    Args:
        place: The source, for the error.
        on_bad_frame: Takes what is wrong with an image; may raise it.
    """

    def __init__(self, place: str, on_bad_frame: Callable[[FrameSourceError], None]) -> None:
        self._place, self._on_bad_frame = place, on_bad_frame
        self._size: tuple[int, int] | None = None

    def usable(self, image: NDArray[Any] | None, place: str = "") -> Image | None:
        """The image as 8-bit blue, green, red; None when it was skipped.

        Args:
            image: As read; None when it could not be.
            place: The file, where each image has its own.
        """
        try:
            if image is None:
                found, expected = "no readable image", "a complete one"
                raise FrameSourceError(place or self._place, found, expected)
            return self._checked(to_bgr8(image, place or self._place), place or self._place)
        except FrameSourceError as error:
            self._on_bad_frame(error)
            return None

    def _checked(self, image: Image, place: str) -> Image:
        size = (image.shape[1], image.shape[0])
        if self._size is None:
            self._size = size
        if size != self._size:
            found = f"a frame of {size[0]}x{size[1]} pixels"
            raise FrameSourceError(place, found, f"{self._size[0]}x{self._size[1]} as before")
        return image
