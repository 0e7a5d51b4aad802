"""Draws a camera's calibration into one of its images: control points, errors, range."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.report.image_overlay import text_width, write_text

Image = NDArray[np.uint8]

PIXEL_SIGMA = 1.0
"""1-sigma error of a box edge, for which the errors on the road are given. Chosen: a good detector;
others can be read off, as the error on the road is proportional."""
LEVELS_M = (0.1, 0.25, 0.5, 1.0, 2.0)
"""Ground errors at which a line is drawn. Chosen: from a lane marking's width to more than half a
lane."""
ERROR_SCALE = 10.0
"""Reprojection errors are drawn this many times as long. Chosen: they are a pixel or two."""
REACH_M = 1.0
"""The camera sees lanes up to this ground error. Chosen: neighbouring lanes are told apart up to
about 1 m; larger promises a range in which they are not."""
_GOOD, _BAD, _LINE = (80, 220, 80), (60, 60, 255), (255, 220, 120)
"""Colours of used points, rejected points and lines of equal error, as blue, green, red."""
_TEXT = 0.45
"""Size of text in an image of 720 lines. Chosen: larger labels cover each other."""
_STEP_PX = 8
"""Of the grid on which errors are computed. Chosen: smaller is slower, larger rougher."""


@dataclass(frozen=True, slots=True)
class Reach:
    """How far a camera can see.

    Attributes:
        farthest_m: From the lower end of the image's middle column to where the ground error of a
            pixel grows to `REACH_M`.
        share: Part of the image below that.
    """

    farthest_m: float
    share: float


def ground_error_m(homography: Homography, image_size: tuple[int, int]) -> NDArray[np.float64]:
    """Worst 1-sigma ground error of a pixel, on a grid of `_STEP_PX`; infinite above the horizon.

    Args:
        homography: The road plane.
        image_size: (width, height).
    """
    width, height = image_size
    u, v = np.meshgrid(np.arange(0, width, _STEP_PX), np.arange(0, height, _STEP_PX))
    pixel = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    error = np.full(len(pixel), np.inf)
    seen = homography.visible(pixel)
    error[seen] = homography.sigma_m(pixel[seen], np.full(int(seen.sum()), PIXEL_SIGMA))
    return np.where(np.isfinite(error), error, np.inf).reshape(u.shape)


def reach(homography: Homography, image_size: tuple[int, int]) -> Reach:
    """How far the camera can see along the middle of its image."""
    error = ground_error_m(homography, image_size)
    column = error[:, error.shape[1] // 2]
    sharp = np.flatnonzero(column <= REACH_M)
    if len(sharp) == 0:
        return Reach(0.0, 0.0)
    rows = sharp[[-1, 0]] * float(_STEP_PX)
    ends = homography.to_ground(np.column_stack([np.full(2, image_size[0] / 2.0), rows]))
    distance = float(np.hypot(*(ends[1] - ends[0])))
    return Reach(distance, float(np.mean(error <= REACH_M)))


def draw_calibration(image: Image, homography: Homography) -> Image:
    """A new image with the control points, their errors, and lines of equal ground error.

    Used points are green, rejected ones red; errors are drawn ten times as long.

    Args:
        image: (H, W, 3) uint8 BGR; it is not changed.
        homography: The road plane, with its control points.
    """
    height, width = image.shape[:2]
    scale = max(height / 720.0, 0.5)
    drawn = image.copy()
    _draw_levels(drawn, ground_error_m(homography, (width, height)), scale)
    points, residual = homography.points, homography.residual
    expected = homography.to_pixel(points.local_m)
    for k, (pixel, should) in enumerate(zip(points.pixel, expected, strict=True)):
        colour = _GOOD if residual.inlier[k] else _BAD
        centre = tuple(round(c) for c in pixel)
        cv2.circle(drawn, centre, round(6 * scale), colour, round(2 * scale), cv2.LINE_AA)
        if np.isfinite(should).all():
            tip = pixel + ERROR_SCALE * (should - pixel)
            tip = np.clip(tip, -4.0 * width, 4.0 * width)
            end = tuple(round(c) for c in tip)
            cv2.line(drawn, centre, end, colour, max(round(2 * scale), 1), cv2.LINE_AA)
        label = f"{k + 1}: {residual.pixel_error[k]:.1f} px, {residual.ground_error_m[k]:.2f} m"
        beside = round(9 * scale)
        if centre[0] + beside + text_width(label, _TEXT * scale) > width:
            beside = -beside - text_width(label, _TEXT * scale)
        at = (centre[0] + beside, centre[1] - round(6 * scale))
        _label(drawn, label, at, scale, colour)
    used = int(residual.inlier.sum())
    caption = (
        f"{used} of {len(points)} control points used; errors drawn {ERROR_SCALE:g} times too long"
    )
    _label(drawn, caption, (round(10 * scale), round(24 * scale)), 1.3 * scale, (255, 255, 255))
    return drawn


def _draw_levels(drawn: Image, error: NDArray[np.float64], scale: float) -> None:
    """A line and its value wherever the ground error passes a level."""
    full = cv2.resize(
        np.minimum(error, 1e3).astype(np.float32),
        drawn.shape[1::-1],
        interpolation=cv2.INTER_LINEAR,
    )
    for level in LEVELS_M:
        mask = (full > level).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            line = contour.reshape(-1, 2)
            inside = np.all((line > 1) & (line < np.array(drawn.shape[1::-1]) - 2), axis=1)
            kept = line[inside]
            if len(kept) < drawn.shape[1] // 8:
                continue
            for x, y in kept:
                drawn[y, x] = _LINE
            x, y = kept[np.argmin(np.abs(kept[:, 0] - drawn.shape[1] * 0.93))]
            _label(drawn, f"{level:g} m", (int(x) - round(10 * scale), int(y)), scale, _LINE)


def _label(
    image: Image, text: str, at: tuple[int, int], scale: float, colour: tuple[int, int, int]
) -> None:
    write_text(image, text, at, _TEXT * scale, colour, max(round(scale), 1))
