"""How an image gets into a model's input, and boxes back out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Image

GREY = 114
"""Value of the border in every channel: that of the predictors of Ultralytics and YOLOX."""
_MEAN = np.array([0.485, 0.456, 0.406], np.float32)[:, None, None]
_DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)[:, None, None]
"""Of ImageNet's samples from 0 to 1, red first: what torchvision's backbones are trained with."""
_HALF_TIE = 0.1
"""Keeps half pixels from being rounded to even: an odd rest goes to the right and to the bottom."""


@dataclass(frozen=True, slots=True)
class Letterbox:
    """An image scaled into a canvas, the rest of it grey.

    Attributes:
        image_size: Width and height of the image.
        scaled_size: Width and height of its copy in the canvas.
        offset: Left and top border in the canvas.
        canvas_size: Width and height of the canvas.
        gain: Canvas pixels per image pixel, right and down.
    """

    image_size: tuple[int, int]
    scaled_size: tuple[int, int]
    offset: tuple[int, int]
    canvas_size: tuple[int, int]
    gain: tuple[float, float]

    def scaled(self, image: Image) -> Image:
        """`image`, whose size is `image_size`, at its size in the canvas."""
        if self.scaled_size == self.image_size:
            return image
        smaller = cv2.resize(image, self.scaled_size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(smaller, dtype=np.uint8)

    def to_image(self, boxes: NDArray[np.floating]) -> NDArray[np.float64]:
        """Boxes (N, 4) left, top, right, bottom from canvas pixels to image pixels."""
        offset, gain = np.array(self.offset * 2, dtype=np.float64), np.array(self.gain * 2)
        return np.asarray((boxes - offset) / gain)


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
    return Letterbox(image_size, scaled, offset, full, (gain, gain))


def cornered(image_size: tuple[int, int], canvas: tuple[int, int]) -> Letterbox:
    """The image in the top left corner of its canvas: YOLOX (Ge et al., 2021, its demo code)."""
    width, height = image_size
    gain = min(canvas[0] / width, canvas[1] / height)
    scaled = (max(int(width * gain), 1), max(int(height * gain), 1))
    return Letterbox(image_size, scaled, (0, 0), canvas, (gain, gain))


def stretched(image_size: tuple[int, int], canvas: tuple[int, int]) -> Letterbox:
    """The image over the whole canvas, whatever its shape: RT-DETR, D-FINE, RF-DETR."""
    gain = (canvas[0] / image_size[0], canvas[1] / image_size[1])
    return Letterbox(image_size, canvas, (0, 0), canvas, gain)


class ModelInput:
    """The input tensor of one model.

    Args:
        dtype: Of the tensor, floats or uint8.
        batch: Images per run that the model asks for; 0 when it takes any number.
        scale: Factor on samples from 0 to 255; bytes keep these.
        swap: Whether the model reads red first; images are blue first.
        normalised: Whether it reads deviations from the mean of ImageNet instead.
    """

    def __init__(
        self,
        dtype: type[np.number],
        batch: int,
        *,
        scale: float,
        swap: bool,
        normalised: bool = False,
    ) -> None:
        bytes_ = dtype is np.uint8
        self._scale = np.uint8(1) if bytes_ else np.float32(scale)
        self._batch, self._swap = batch, swap
        self._normalised = normalised and not bytes_
        self._grey = self._scale * (GREY if bytes_ else np.float32(GREY))
        self._tensor = np.zeros((0, 3, 0, 0), dtype=dtype)
        self._drawn: list[Letterbox | None] = []
        self._planes: list[NDArray[np.uint8]] = []

    def filled(self, boxes: Sequence[Letterbox], images: Sequence[Image]) -> NDArray[np.number]:
        """(B, 3, H, W) tensor with each image in its letterbox; valid until the next call.

        Args:
            boxes: One for each image, all with the same canvas.
            images: At most as many as the model asks for; what the rest of a fixed batch holds is
                left from before, and so are its results.
        """
        width, height = boxes[0].canvas_size
        count = self._batch or len(boxes)
        if self._tensor.shape[2:] != (height, width) or len(self._tensor) < count:
            self._tensor = np.zeros((count, 3, height, width), dtype=self._tensor.dtype)
            self._drawn = [None] * count
        for number, (box, image) in enumerate(zip(boxes, images, strict=True)):
            self._draw(number, box, image)
        return self._tensor[:count]

    def _draw(self, number: int, box: Letterbox, image: Image) -> None:
        canvas, before = self._tensor[number], self._drawn[number]
        if before is None or (before.offset, before.scaled_size) != (box.offset, box.scaled_size):
            canvas[...] = self._grey
            if self._normalised:
                canvas -= _MEAN
                canvas /= _DEVIATION
        self._drawn[number] = box
        (left, top), (width, height) = box.offset, box.scaled_size
        inner = canvas[:, top : top + height, left : left + width]
        if not self._planes or self._planes[0].shape != (height, width):
            self._planes = [np.empty((height, width), dtype=np.uint8) for _ in range(3)]
        # Plane by plane: both loops then read and write memory in order.
        cv2.split(box.scaled(image), self._planes)
        for channel, plane in enumerate(reversed(self._planes) if self._swap else self._planes):
            np.multiply(plane, self._scale, out=inner[channel], casting="same_kind")
        if self._normalised:
            inner -= _MEAN
            inner /= _DEVIATION
