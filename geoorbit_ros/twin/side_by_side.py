"""What the camera saw, what the twin shows, and the difference, as one picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from geoorbit_ros.report.image_text import write_text

SEEN, TWIN = (0, 165, 255), (80, 220, 80)
"""Orange and green, blue-green-red."""
MIN_OVERLAP = 0.1
"""Boxes that overlap by less (IoU) are not the same vehicle."""


@dataclass(frozen=True, slots=True)
class Difference:
    """How the twin's boxes lie on those that were seen.

    Attributes:
        matched: Vehicles in both.
        seen_only, twin_only: In one of them.
        overlap: Mean intersection over union of those in both; NaN without any.
        apart_px: Mean distance of their boxes' lower middles, in pixels of the camera's image.
    """

    matched: int
    seen_only: int
    twin_only: int
    overlap: float
    apart_px: float

    @property
    def words(self) -> str:
        """In one line."""
        both = f"{self.matched} in both"
        if self.matched:
            both += f" (overlap {self.overlap:.2f}, {self.apart_px:.0f} px apart)"
        return f"{both}, {self.seen_only} only seen, {self.twin_only} only in the twin"


def compare_boxes(seen: NDArray[np.float64], twin: NDArray[np.float64], scale: float) -> Difference:
    """Match boxes (N, 4) and (M, 4) of left, top, right, bottom; NaN rows are left out."""
    seen, twin = (boxes[np.isfinite(boxes).all(axis=1)] for boxes in (seen, twin))
    if not len(seen) or not len(twin):
        return Difference(0, len(seen), len(twin), float("nan"), float("nan"))
    low = np.maximum(seen[:, None, :2], twin[None, :, :2])
    high = np.minimum(seen[:, None, 2:], twin[None, :, 2:])
    inner = np.prod(np.maximum(high - low, 0.0), axis=2)
    area = [np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) for boxes in (seen, twin)]
    overlap = inner / (area[0][:, None] + area[1][None] - inner)
    a, b = linear_sum_assignment(-overlap)
    good = overlap[a, b] >= MIN_OVERLAP
    a, b = a[good], b[good]
    if not len(a):
        return Difference(0, len(seen), len(twin), float("nan"), float("nan"))
    feet = [
        np.column_stack((0.5 * (boxes[k, 0] + boxes[k, 2]), boxes[k, 3]))
        for boxes, k in ((seen, a), (twin, b))
    ]
    return Difference(
        matched=len(a),
        seen_only=len(seen) - len(a),
        twin_only=len(twin) - len(a),
        overlap=float(overlap[a, b].mean()),
        apart_px=float(np.hypot(*(feet[0] - feet[1]).T).mean()) / scale,
    )


def side_by_side(
    image: NDArray[np.uint8] | None,
    seen: NDArray[np.float64],
    rendered: NDArray[np.uint8],
    twin: NDArray[np.float64],
    scale: float,
) -> tuple[NDArray[np.uint8], Difference]:
    """The camera's image, the twin's, and both their boxes over one another.

    Args:
        image: The camera's, in any size; None where there is none: its boxes stand for it.
        seen: (N, 4) boxes in the rendered picture's pixels.
        rendered: (H, W, 3) of the twin.
        twin: (M, 4) boxes in it.
        scale: The rendered picture's against the camera's.

    Returns:
        (H, 3 W, 3) and the difference in figures.
    """
    height, width = rendered.shape[:2]
    if image is None:
        left = np.full_like(rendered, 40)
    else:
        left = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
    below = left if image is not None else np.rint(0.5 * rendered).astype(np.uint8)
    right = np.rint(0.6 * below).astype(np.uint8)
    _draw(left, seen, SEEN)
    _draw(right, seen, SEEN)
    _draw(right, twin, TWIN)
    difference = compare_boxes(seen, twin, scale)
    panels = [left, rendered.copy(), right]
    for panel, text in zip(panels, ("seen", "twin", difference.words), strict=True):
        write_text(panel, text, (8, 20), 0.45, (255, 255, 255))
    return np.hstack(panels), difference


def boxes_of(rows: NDArray[np.void], scale: float) -> NDArray[np.float64]:
    """(N, 4) left, top, right, bottom of `PIXEL_TRACK_DTYPE` rows, in the rendered pixels."""
    middle = np.column_stack((rows["x"], rows["y"])).astype(np.float64)
    half = 0.5 * np.column_stack((rows["width"], rows["height"])).astype(np.float64)
    return scale * np.hstack((middle - half, middle + half))


def _draw(
    image: NDArray[np.uint8], boxes: NDArray[np.float64], colour: tuple[int, int, int]
) -> None:
    for box in boxes[np.isfinite(boxes).all(axis=1)]:
        left, top, right, bottom = np.rint(box).astype(int).tolist()
        cv2.rectangle(image, (left, top), (right, bottom), colour, 1, cv2.LINE_AA)
