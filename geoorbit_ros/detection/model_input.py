"""Images as the tensor that a model reads, in memory that is kept from run to run.

Fresh memory of five megabytes for each image costs more than all the work on it: the system has to
clear every page first. Kept memory needs that once, and its grey border is painted once, too.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Image
from geoorbit_ros.detection.letterbox import GREY, Letterbox


class ModelInput:
    """The input tensor of one model.

    Args:
        dtype: Of the tensor, float32 or float16.
        batch: Images per run that the model asks for; 0 when it takes any number.
        scale: Factor on samples from 0 to 255.
        swap: Whether the model reads red first; images are blue first.
    """

    def __init__(self, dtype: type[np.floating], batch: int, *, scale: float, swap: bool) -> None:
        self._batch, self._scale, self._swap = batch, np.float32(scale), swap
        self._tensor = np.zeros((0, 3, 0, 0), dtype=dtype)
        self._drawn: list[Letterbox | None] = []
        self._planes: list[NDArray[np.uint8]] = []

    def filled(self, boxes: Sequence[Letterbox], images: Sequence[Image]) -> NDArray[np.floating]:
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
            canvas[...] = self._scale * np.float32(GREY)
        self._drawn[number] = box
        (left, top), (width, height) = box.offset, box.scaled_size
        inner = canvas[:, top : top + height, left : left + width]
        if not self._planes or self._planes[0].shape != (height, width):
            self._planes = [np.empty((height, width), dtype=np.uint8) for _ in range(3)]
        # Plane by plane: both loops then read and write memory in order.
        cv2.split(box.scaled(image), self._planes)
        for channel, plane in enumerate(reversed(self._planes) if self._swap else self._planes):
            np.multiply(plane, self._scale, out=inner[channel], casting="same_kind")
