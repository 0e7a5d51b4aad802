"""The frame of a map on the page: the long way of the road along the page, a scale bar, north."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.report.svg import Canvas, nice_step

MAP_WIDTH_PX = 1040.0
"""Width of all drawings. Layout of the page."""
MIN_HEIGHT_PX, MAX_HEIGHT_PX = 260.0, 760.0
"""Of a map. Layout of the page."""
MAX_STRETCH = 4
"""A long road is drawn at most so many times wider across than along. Chosen: more makes lanes look
like squares."""
FOOT_PX = 32.0
"""Room below the road for the scale bar. Layout of the page."""
ELONGATED = 1.6
"""A road this much longer than wide is turned to lie along the page; others keep north up. Chosen:
smaller turns junctions, too."""


@dataclass(frozen=True, slots=True)
class MapFrame:
    """From map metres to pixels of the drawing.

    Attributes:
        turn: (2, 2) rotation that brings the road level.
        middle_m: (2,) middle of the drawing, in turned metres.
        scale: (2,) pixels per metre along and across the page.
        size_px: (width, height) of the drawing.
    """

    turn: NDArray[np.float64]
    middle_m: NDArray[np.float64]
    scale: NDArray[np.float64]
    size_px: tuple[float, float]

    def to_pixel(self, local_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) pixels of (N, 2) metres."""
        flat = (local_m @ self.turn.T - self.middle_m) * self.scale * np.array([1.0, -1.0])
        return np.asarray(flat + np.array(self.size_px) / 2)

    def inside(self, pixel: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which (N, 2) pixels lie in the drawing, a margin away from its border."""
        return np.asarray(np.all((pixel > 14) & (pixel < np.array(self.size_px) - 14), axis=1))

    @property
    def stretch(self) -> float:
        """How much wider than true the road is drawn; 1 when to scale."""
        return float(self.scale[1] / self.scale[0])


def fit_map_frame(points_m: NDArray[np.float64]) -> MapFrame:
    """A frame that holds all of (N, 2) metres, the long way along the page."""
    centred = points_m - points_m.mean(axis=0)
    _, extent, axes = np.linalg.svd(centred, full_matrices=False)
    turn = np.eye(2)
    elongated = bool(extent[0] > ELONGATED * extent[1])
    if elongated:
        along = axes[0] * (1.0 if axes[0, 0] + 1e-6 * axes[0, 1] >= 0 else -1.0)
        turn = np.array([[along[0], along[1]], [-along[1], along[0]]])
    flat = points_m @ turn.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    span = np.maximum(high - low, 5.0) * 1.04 + 6.0
    scale = min(MAP_WIDTH_PX / span[0], MAX_HEIGHT_PX / span[1])
    stretch = 1
    if elongated:
        stretch = int(np.clip(MIN_HEIGHT_PX // (scale * span[1]) + 1, 1, MAX_STRETCH))
    scales = np.array([scale, scale * stretch])
    height = float(np.clip(span[1] * scales[1], 160.0, MAX_HEIGHT_PX))
    middle = (low + high) / 2 - np.array([0.0, FOOT_PX / 2 / scales[1]])
    return MapFrame(turn, middle, scales, (MAP_WIDTH_PX, height + FOOT_PX))


def draw_scale_bar(canvas: Canvas, frame: MapFrame) -> None:
    """A length along the road, in the lower left corner."""
    length = nice_step(frame.size_px[0] / frame.scale[0] / 6, 1)
    x0, y0 = 16.0, frame.size_px[1] - 16.0
    x1 = x0 + length * frame.scale[0]
    canvas.line(np.array([[x0, y0 - 5], [x0, y0], [x1, y0], [x1, y0 - 5]]), "axis")
    canvas.text((x0 + x1) / 2, y0 - 6, f"{length:g} m", "label", "middle")


def draw_north(canvas: Canvas, frame: MapFrame) -> None:
    """Where north is, in the upper right corner."""
    middle = np.array([frame.size_px[0] - 40.0, 40.0])
    # The compass is not stretched: it shows the direction of north on the level road.
    north = frame.turn @ np.array([0.0, 1.0]) * np.array([1.0, -1.0])
    side = np.array([-north[1], north[0]])
    tip, tail = middle + 16 * north, middle - 10 * north
    canvas.area(np.stack((tip, tail + 6 * side, middle - 6 * north, tail - 6 * side)), "north")
    at = middle + 24 * north
    canvas.text(at[0], at[1] + 4, "N", "label", "middle")
