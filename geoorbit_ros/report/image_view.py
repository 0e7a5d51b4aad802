"""The road as the camera sees it: vehicle paths and lanes projected back into the image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.homography import Homography
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.report.lane_drawing import direction_groups, draw_lanes, draw_paths
from geoorbit_ros.report.svg import Canvas

WIDTH_PX = 1040.0


def image_view(
    lane_map: LaneMap,
    paths: Sequence[NDArray[np.float64]],
    homography: Homography,
    image_size: tuple[int, int],
) -> Canvas:
    """Draw what lies on the road over an empty image of the camera's size."""
    scale = WIDTH_PX / image_size[0]
    size = np.array(image_size) * scale
    canvas = Canvas(size[0], size[1], "The camera's view with lanes and the paths of the vehicles")
    colour = direction_groups(lane_map.lanes)

    def to_pixel(local_m: NDArray[np.float64]) -> NDArray[np.float64]:
        return homography.to_pixel(local_m) * scale

    def inside(pixel: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(np.all((pixel > 14) & (pixel < size - 14), axis=1))

    canvas.open_clip("image-clip", 0, 0, size[0], size[1])
    _horizon(canvas, homography, scale, size)
    draw_paths(canvas, paths, to_pixel, lane_map.lanes, colour)
    if len(lane_map.visible_m):
        canvas.line(to_pixel(np.vstack((lane_map.visible_m, lane_map.visible_m[:1]))), "limit")
    draw_lanes(canvas, lane_map.lanes, to_pixel, colour, inside)
    for k, (u, v) in enumerate(homography.points.pixel * scale):
        css = "control" if homography.residual.inlier[k] else "control rejected"
        tip = f"Control point, line {homography.points.line_number[k]}"
        canvas.raw(
            f'<path d="M{u - 4:.1f} {v:.1f}h8M{u:.1f} {v - 4:.1f}v8" class="{css}">'
            f"<title>{tip}</title></path>"
        )
    canvas.close()
    return canvas


def _horizon(
    canvas: Canvas, homography: Homography, scale: float, size: NDArray[np.float64]
) -> None:
    """The line where the road plane ends, when it crosses the image."""
    a, b, c = homography.matrix[2]
    if abs(b) < 1e-12:
        return
    u = np.array([0.0, size[0] / scale])
    v = -(a * u + c) / b
    if np.all((v > 0) & (v * scale < size[1])):
        canvas.line(np.column_stack((u, v)) * scale, "horizon", "Horizon")
        canvas.text(size[0] - 10, v[1] * scale - 6, "horizon", "label", "end")
