"""Arithmetic on whole pictures that more than one part of the motion detector needs."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Image


def scaled(picture: Image, ratio: NDArray[np.floating]) -> Image:
    """The picture with blue, green and red times `ratio` (3,), rounded, at most 255."""
    table = np.rint(np.arange(256)[:, None] * ratio.astype(np.float64))
    table = np.clip(table, 0, 255).astype(np.uint8).reshape(1, 256, 3)
    return np.asarray(cv2.LUT(picture, table), dtype=np.uint8)
