"""Images as views are compared in: grey, reduced, slightly blurred; and motions between them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
"""(H, W) uint8."""
Matrix = NDArray[np.float64]
"""(3, 3) from pixels (x, y, 1) to pixels."""

LEAST_WIDTH_PX = 640
"""Pictures are compared at this width or up to twice of it. Chosen: a motion is known to a tenth of
a pixel of a 1280 px wide image; wider ones take more time, narrower ones lose far lines."""
BLUR_PX = 0.8
"""1-sigma of the blur against noise and compression. Chosen: more loses fine patterns."""


def reduction(width: int) -> int:
    """By how much an image of this width is reduced: 1, 2, 4 or 8, which JPEG decoders can do."""
    return next((step for step in (8, 4, 2) if width >= step * LEAST_WIDTH_PX), 1)


def picture_of(image: NDArray[np.uint8], step: int) -> Grey:
    """The picture of an image (H, W, 3) or (H, W): each pixel the mean of `step` x `step`.

    Args:
        image: The image, or one that a decoder has already reduced.
        step: What is left to reduce it by.
    """
    height, width = (side // step * step for side in image.shape[:2])
    reduced = image[:height, :width]
    if reduced.ndim == 3:
        reduced = np.asarray(cv2.cvtColor(reduced, cv2.COLOR_BGR2GRAY), np.uint8)
    if step > 1:
        size = (width // step, height // step)
        reduced = np.asarray(cv2.resize(reduced, size, interpolation=cv2.INTER_AREA), np.uint8)
    return np.asarray(cv2.GaussianBlur(reduced, (0, 0), BLUR_PX), np.uint8)


def in_image(motion: Matrix, step: int) -> Matrix:
    """A motion between pictures as one between the images they were reduced from."""
    to_image = np.array([[step, 0.0, (step - 1) / 2], [0.0, step, (step - 1) / 2], [0.0, 0.0, 1.0]])
    moved = to_image @ motion @ np.linalg.inv(to_image)
    return np.asarray(moved / moved[2, 2])


def in_picture(motion: Matrix, step: int) -> Matrix:
    """The reverse of `in_image`."""
    to_image = np.array([[step, 0.0, (step - 1) / 2], [0.0, step, (step - 1) / 2], [0.0, 0.0, 1.0]])
    moved = np.linalg.inv(to_image) @ motion @ to_image
    return np.asarray(moved / moved[2, 2])


def moved(motion: Matrix, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels (N, 2) after a motion."""
    mapped = pixel @ motion[:, :2].T + motion[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def displacement(motion: Matrix, size: tuple[int, int]) -> NDArray[np.float64]:
    """(5, 2) by how many pixels the middle of an image and of its four quarters move."""
    width, height = size
    share = np.array([[0.5, 0.5], [0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    points = share * [width - 1, height - 1]
    return np.asarray(moved(motion, points) - points)


def size_of_move(motion: Matrix, size: tuple[int, int]) -> float:
    """Pixels by which a motion moves an image, in the mean over it (root of squares)."""
    return float(np.sqrt((displacement(motion, size) ** 2).sum(axis=1).mean()))


def shifted(right: float, down: float) -> Matrix:
    """The motion by so many pixels."""
    return np.array([[1.0, 0.0, right], [0.0, 1.0, down], [0.0, 0.0, 1.0]])


def warped_back(picture: Grey, motion: Matrix) -> Grey:
    """A moved picture as it was before: pixel p shows what the picture has at motion(p)."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = (picture.shape[1], picture.shape[0])
    back = cv2.warpPerspective(picture, motion, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(back, np.uint8)
