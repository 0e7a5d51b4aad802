"""The image of a road: without vehicles, and rectified along a line that the road follows."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.elementwise import through
from geoorbit_ros.calibration.plane import RoadPlane

ALONG_M = 0.25
"""Distance of two stations. Chosen: a third of the shortest dashes (1 m); shorter takes more time
and shows no more."""
ACROSS_M = 0.02
"""Distance of two offsets. Chosen: a fifth of the narrowest lines (0.1 m)."""
BORDER_PX = 2.0
"""Pixels at the image's border that are not used: encoders and undistortion leave edges there."""


SPACING_S = 2.0
"""Time between the images of a background. Chosen: a vehicle drives on by its length and more."""
MAX_IMAGES = 15
"""Images of which the median is taken. Chosen: a place that vehicles cover in a third of the images
is free in most of 15; more take memory (6 MB each at 1920x1080)."""


class RoadBackground:
    """The road without vehicles: the median of images that are spread over the time of a film."""

    def __init__(self) -> None:
        self._images: list[NDArray[np.uint8]] = []
        self._stride, self._count = 1, 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """Take one image (H, W, 3); of a long film fewer and fewer are kept."""
        if self._count % self._stride == 0:
            if len(self._images) == MAX_IMAGES:
                self._images = self._images[::2]
                self._stride *= 2
            if self._count % self._stride == 0:
                self._images.append(image.copy())
        self._count += 1

    def image(self) -> NDArray[np.uint8] | None:
        """(H, W, 3) uint8; None before the first image.

        The larger half of each pixel's values floats to the end, image by image: ten times as fast
        as numpy's median, which sorts each pixel by itself.
        """
        images = list(self._images)
        if not images:
            return None
        middle = len(images) // 2
        for last in range(len(images) - 1, middle - 1, -1):
            for k in range(last):
                pair = images[k], images[k + 1]
                images[k], images[k + 1] = (
                    np.asarray(choose(*pair), dtype=np.uint8) for choose in (cv2.min, cv2.max)
                )
        return images[middle]


@dataclass(frozen=True, slots=True)
class RoadStrip:
    """A rectified image: S stations along a reference line, D offsets across it.

    Attributes:
        station_m: (S,) arc length from the reference line's beginning; evenly spaced.
        offset_m: (D,) distance from the reference line, positive to its left; evenly spaced.
        point_m: (S, 2) the stations in the map frame.
        normal: (S, 2) unit vectors to the left.
        bgr: (S, D, 3) float32 colours, 0 where nothing is seen.
        seen: (S, D) whether the place lies in the image.
        across_m: (S, D) metres across the road that a pixel covers; infinite where not seen.
        along_m: (S, D) metres along the road that a pixel covers; infinite where not seen.
    """

    station_m: NDArray[np.float64]
    offset_m: NDArray[np.float64]
    point_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    bgr: NDArray[np.float32]
    seen: NDArray[np.bool_]
    across_m: NDArray[np.float64]
    along_m: NDArray[np.float64]

    def place(self, offset_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """(S, 2) points in the map frame at one offset (S,) for each station."""
        return np.asarray(self.point_m + offset_m[:, None] * self.normal, dtype=np.float64)


def rectify(
    image: NDArray[np.uint8],
    homography: RoadPlane,
    reference_m: NDArray[np.float64],
    right_m: float,
    left_m: float,
) -> RoadStrip:
    """Sample an image along and across a line on the road.

    Args:
        image: (H, W, 3) BGR.
        homography: The camera's road plane.
        reference_m: (K, 2) line in the map frame; it is resampled evenly.
        right_m: Offset at which the strip begins, negative to the right of the line.
        left_m: Offset at which it ends.
    """
    station, point, tangent = _stations(reference_m)
    normal = np.column_stack((-tangent[:, 1], tangent[:, 0]))
    offset = np.arange(right_m, left_m, ACROSS_M)
    # Along a station's normal the homogeneous pixel is linear in the offset: one division each.
    to_pixel = homography.inverse
    start = np.column_stack((point, np.ones(len(point)))) @ to_pixel.T
    ahead, aside = tangent @ to_pixel[:, :2].T, normal @ to_pixel[:, :2].T
    places = start[:, None] + offset[None, :, None] * aside[:, None]
    depth = places[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = places[..., 0] / depth, places[..., 1] / depth
        # How far the pixel moves for a metre across, and along: the quotient rule, times the depth.
        across, along = (
            np.stack([move[:, k, None] - p * move[:, 2, None] for k, p in enumerate((u, v))])
            for move in (aside, ahead)
        )
        # Behind the camera the depth has the other sign than at the control points.
        seen = u * homography.matrix[2, 0] + v * homography.matrix[2, 1] > -homography.matrix[2, 2]
        if homography.lens is not None:
            (u, v), bend = homography.lens.distort_columns(np.stack((u, v)))
            across, along = (through(bend, move[:, None])[:, 0] for move in (across, along))
        height, width = image.shape[:2]
        low, high = BORDER_PX, np.array([width, height]) - 1.0 - BORDER_PX
        seen &= (u >= low) & (u <= high[0]) & (v >= low) & (v <= high[1])
        across_m, along_m = (np.abs(depth) / np.hypot(*move) for move in (across, along))
    # Coordinates count from the corner of the first pixel, as boxes do; OpenCV from its middle.
    at = [np.where(seen, p - 0.5, -1.0).astype(np.float32) for p in (u, v)]
    sampled = cv2.remap(image, at[0], at[1], cv2.INTER_LINEAR, borderValue=0)
    bgr = np.where(seen[..., None], sampled, 0).astype(np.float32)
    return RoadStrip(
        station, offset, point, normal, bgr, seen,
        np.where(seen, across_m, np.inf), np.where(seen, along_m, np.inf),
    )  # fmt: skip


def _stations(
    line_m: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Arc lengths (S,), points (S, 2) and unit tangents (S, 2), `ALONG_M` apart."""
    arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line_m, axis=0).T)))
    station = np.arange(0.0, arc[-1], ALONG_M)
    point = np.column_stack([np.interp(station, arc, line_m[:, k]) for k in (0, 1)])
    tangent = np.gradient(point, axis=0)
    return station, point, tangent / np.hypot(*tangent.T)[:, None]
