"""How an image gets into a model's input, and boxes back out of it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Image

GREY = 114
"""Both families pad with this value in every channel."""
_HALF_TIE = 0.1
"""Keeps half pixels from being rounded to even: an odd rest goes to the right and to the bottom."""


@dataclass(frozen=True, slots=True)
class Letterbox:
    """An image scaled by one factor into a canvas, the rest of it grey.

    Attributes:
        image_size: Width and height of the image.
        scaled_size: Width and height of its copy in the canvas.
        offset: Left and top border in the canvas.
        canvas_size: Width and height of the canvas.
        gain: Canvas pixels per image pixel.
    """

    image_size: tuple[int, int]
    scaled_size: tuple[int, int]
    offset: tuple[int, int]
    canvas_size: tuple[int, int]
    gain: float

    def scaled(self, image: Image) -> Image:
        """`image`, whose size is `image_size`, at its size in the canvas."""
        if self.scaled_size == self.image_size:
            return image
        smaller = cv2.resize(image, self.scaled_size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(smaller, dtype=np.uint8)

    def to_image(self, boxes: NDArray[np.floating]) -> NDArray[np.float64]:
        """Boxes (N, 4) left, top, right, bottom from canvas pixels to image pixels."""
        left, top = self.offset
        return np.asarray((boxes - np.array([left, top, left, top], dtype=np.float64)) / self.gain)


def centred(image_size: tuple[int, int], canvas: tuple[int, int], stride: int = 0) -> Letterbox:
    """The image in the middle of its canvas: YOLOv8, 11, 12 and 26 exported by Ultralytics.

    Published behaviour of that predictor: one gain, up or down; rounded size; bilinear; borders of
    grey, the odd pixel right and below.

    Args:
        image_size: Width and height of the image.
        canvas: Width and height of the model's input.
        stride: Where not 0, as exports with a dynamic shape are fed: borders only up to the next
            multiple of it, so that the canvas is at most `canvas`.
    """
    width, height = image_size
    gain = min(canvas[0] / width, canvas[1] / height)
    scaled = (max(round(width * gain), 1), max(round(height * gain), 1))
    spare = (canvas[0] - scaled[0], canvas[1] - scaled[1])
    if stride:
        spare = (spare[0] % stride, spare[1] % stride)
    offset = (round(spare[0] / 2 - _HALF_TIE), round(spare[1] / 2 - _HALF_TIE))
    full = (scaled[0] + spare[0], scaled[1] + spare[1])
    return Letterbox(image_size, scaled, offset, full, gain)


def cornered(image_size: tuple[int, int], canvas: tuple[int, int]) -> Letterbox:
    """The image in the top left corner of its canvas: YOLOX (Ge et al., 2021, its demo code)."""
    width, height = image_size
    gain = min(canvas[0] / width, canvas[1] / height)
    scaled = (max(int(width * gain), 1), max(int(height * gain), 1))
    return Letterbox(image_size, scaled, (0, 0), canvas, gain)
