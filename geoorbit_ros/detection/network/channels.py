"""What the network sees: the image, its difference from the empty road and from the past."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Image

CHANNELS = 5
"""Blue, green, red, difference from the empty road, difference from an earlier image."""
STRIDE_PX = 4
"""Side of an output cell."""
COARSEST_PX = 32
"""Images have sides of multiples of this."""
WORK_AREA_PX = 165_000
"""Images are worked on at about this many pixels, as 544 x 304. Chosen: with 215 000, as it was
trained, no more vehicles of at least 20 px in real films were found, in 30 % more time."""
LARGEST_SCALE = 2.0
"""Small images are enlarged by at most this. Chosen: beyond it only time is spent."""
PAST_S = 0.12
"""The earlier image is this old at least. Chosen: older ones show two vehicles in the place of one,
newer ones do not show slow vehicles."""


def work_size(size: tuple[int, int]) -> tuple[int, int]:
    """Width and height at which an image of this width and height is worked on."""
    scale = min((WORK_AREA_PX / (size[0] * size[1])) ** 0.5, LARGEST_SCALE)
    width, height = (max(round(side * scale / COARSEST_PX), 1) * COARSEST_PX for side in size)
    return width, height


def channels(image: Image, road: Image | None, past: Image | None) -> NDArray[np.uint8]:
    """(H, W, CHANNELS) of an image, the empty road and an earlier image, all (H, W, 3).

    What is not known leaves its channel 0.
    """
    seen = np.zeros((*image.shape[:2], CHANNELS), dtype=np.uint8)
    seen[..., :3] = image
    for k, other in ((3, road), (4, past)):
        if other is not None:
            blue, green, red = cv2.split(cv2.absdiff(image, other))
            seen[..., k] = cv2.max(cv2.max(blue, green), red)
    return seen
