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


def channel_max(picture: Image) -> NDArray[np.uint8]:
    """(H, W) the largest of the three channels."""
    blue, green, red = cv2.split(picture)
    return np.asarray(cv2.max(cv2.max(blue, green), red), dtype=np.uint8)


def busy_rows(mask: NDArray[np.uint8]) -> slice:
    """The rows from the first to the last that has a pixel set; at least one."""
    busy = np.flatnonzero(mask.any(axis=1))
    return slice(int(busy[0]), int(busy[-1]) + 1) if len(busy) else slice(0, 1)
