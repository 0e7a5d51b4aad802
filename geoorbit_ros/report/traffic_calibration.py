"""A calibration from traffic, drawn into the camera's image: a person sees whether it is right."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.traffic.estimate import TrafficCalibration
from geoorbit_ros.calibration.vehicle_fit import corners, vehicle_axes
from geoorbit_ros.report.image_overlay import write_text

Image = NDArray[np.uint8]

GREY = 60
"""Brightness of the picture where no image is given."""
CUBOIDS = 14
"""Vehicles that are drawn, those with the largest boxes among every eighth of the places. Chosen:
more cover each other."""
EDGES = (
    *((0, 2), (2, 6), (6, 4), (4, 0), (1, 3), (3, 7), (7, 5), (5, 1)),
    *((0, 1), (2, 3), (4, 5), (6, 7)),
)
"""Of a cuboid, by the numbers of its corners (`vehicle_fit.CORNER`)."""
SPACINGS_M = (2.0, 5.0, 10.0, 20.0, 50.0)
LINES = 14
"""The grid is the finest of these with at most so many lines to a side."""
_GRID, _HORIZON, _CUBOID, _BOX = (200, 200, 90), (80, 160, 255), (90, 220, 90), (180, 180, 180)
_TEXT = (255, 255, 255)


def draw_traffic_calibration(
    found: TrafficCalibration, points: ControlPoints, image: Image | None = None
) -> Image:
    """Metre grid on the road, horizon, boxes and the cuboids that explain them.

    Args:
        found: The camera.
        points: Its control points.
        image: (H, W, 3) BGR of the camera; a grey canvas without.
    """
    width, height = found.image_size
    canvas = np.full((height, width, 3), GREY, np.uint8) if image is None else image.copy()
    thin = max(1, round(height / 720))
    spacing = _draw_grid(canvas, points, thin)
    _draw_horizon(canvas, found, thin)
    _draw_vehicles(canvas, found, thin)
    text = f"grid {spacing:g} m; green: vehicles as the camera has them; orange: horizon"
    write_text(canvas, text, (12, height - 14), 0.6 * height / 720, _TEXT, thin)
    return canvas


def _line(
    canvas: Image, pixel: NDArray[np.float64], colour: tuple[int, int, int], thin: int
) -> None:
    good = np.isfinite(pixel).all(axis=1) & (np.abs(pixel) < 1e5).all(axis=1)
    for a, b in zip(np.flatnonzero(good)[:-1], np.flatnonzero(good)[1:], strict=True):
        if b == a + 1:
            start, end = (tuple(np.round(pixel[k]).astype(int).tolist()) for k in (a, b))
            cv2.line(canvas, start, end, colour, thin, cv2.LINE_AA)


def _draw_grid(canvas: Image, points: ControlPoints, thin: int) -> float:
    plane = fit_homography(points)
    low, high = points.local_m.min(axis=0), points.local_m.max(axis=0)
    spacing = next((s for s in SPACINGS_M if (high - low).max() / s <= LINES), SPACINGS_M[-1])
    low, high = np.floor(low / spacing) * spacing, np.ceil(high / spacing) * spacing
    for axis in (0, 1):
        along = np.linspace(low[1 - axis], high[1 - axis], 60)
        for value in np.arange(low[axis], high[axis] + spacing / 2, spacing):
            xy = np.column_stack((np.full(60, value), along))
            _line(canvas, plane.to_pixel(xy if axis == 0 else xy[:, ::-1]), _GRID, thin)
    return float(spacing)


def _draw_horizon(canvas: Image, found: TrafficCalibration, thin: int) -> None:
    angle = np.radians(np.linspace(-85.0, 85.0, 120))
    far = np.stack((np.sin(angle), np.cos(angle), np.zeros_like(angle)))
    uvw = found.projection[:, :3] @ far
    pixel = np.where(uvw[2] > 1e-6, uvw[:2] / np.maximum(uvw[2], 1e-6), np.nan).T
    pixel = pixel if found.lens is None else found.lens.distort(pixel)
    _line(canvas, pixel, _HORIZON, thin)


def _draw_vehicles(canvas: Image, found: TrafficCalibration, thin: int) -> None:
    explained, model = found.explained, found.model
    fit, matrix = explained.fit, found.projection
    area = np.where(fit.good, model.side.prod(axis=0), 0.0)
    parts = np.array_split(np.arange(len(area)), CUBOIDS)
    chosen = np.array([part[np.argmax(area[part])] for part in parts if len(part)])
    size = explained.size_m[:, model.vehicle[chosen]]
    axes = vehicle_axes(matrix, explained.headings.angle[chosen]) * size[:, None]
    uv, depth = corners(matrix, fit.xy[:, chosen], axes)
    for k in np.flatnonzero((depth > 0).all(axis=0)):
        half, middle = model.side[:, chosen[k]] / 2, model.centre[:, chosen[k]]
        box = middle + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        lens = found.lens
        _line(canvas, box if lens is None else lens.distort(box), _BOX, thin)
        for a, b in EDGES:
            edge = uv[:, [a, b], k].T
            _line(canvas, edge if lens is None else lens.distort(edge), _CUBOID, thin)
