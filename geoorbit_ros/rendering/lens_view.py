"""What a lens makes of a pinhole's image: the image, and where vehicles are in it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.occlusion import Outlines
from geoorbit_ros.scenes.camera import PinholeCamera

MARGIN_PX = 2.0
"""The pinhole's image reaches so much farther, for interpolation."""


class LensView:
    """Bends the image of a pinhole that sees all that the lens shows.

    Args:
        camera: The camera, with a lens.

    Attributes:
        pinhole: The same camera without it; its image is larger for a barrel, smaller for a
            pincushion, at the same focal length.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        assert camera.lens is not None
        self._lens, (width, height) = camera.lens, camera.image_size
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        ideal = self._lens.undistort(np.stack((u, v), axis=-1))
        low = np.floor(ideal.min(axis=(0, 1)) - MARGIN_PX)
        high = np.ceil(ideal.max(axis=(0, 1)) + MARGIN_PX)
        shift = np.array([[1.0, 0.0, -low[0]], [0.0, 1.0, -low[1]], [0.0, 0.0, 1.0]])
        size = (int(high[0] - low[0]), int(high[1] - low[1]))
        self._low = low
        self.pinhole = PinholeCamera(shift @ camera.matrix, camera.centre_m, camera.focal_px, size)
        # OpenCV counts from the middle of the first pixel.
        at = (ideal - low - 0.5).astype(np.float32)
        self._maps = cv2.convertMaps(at[..., 0], at[..., 1], cv2.CV_16SC2)

    def show(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image (H, W, 3) through the lens, of the pinhole's."""
        at, between = self._maps
        bent = cv2.remap(image, at, between, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(bent, dtype=np.uint8)

    def outlines(self, seen: Outlines) -> Outlines:
        """Outlines through the lens, of those in the pinhole's image; boxes are round them."""
        hulls: list[NDArray[np.float32] | None] = []
        boxes = np.full_like(seen.boxes, np.nan)
        for k, hull in enumerate(seen.hulls):
            hulls.append(None)
            if hull is None:
                continue
            real = self._lens.distort(hull.astype(np.float64) + self._low)
            if np.isfinite(real).all():
                boxes[k] = *real.min(axis=0), *real.max(axis=0)
                hulls[k] = np.asarray(cv2.convexHull(real.astype(np.float32))[:, 0], np.float32)
        return Outlines(hulls, boxes)
