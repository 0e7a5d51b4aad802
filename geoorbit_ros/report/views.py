"""The drawings of the page: the camera's view, the map, histograms across the road."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.homography import Homography
from geoorbit_ros.core.lanes import CrossSection, Lane, LaneMap
from geoorbit_ros.report.lane_drawing import (
    DIRECTION_GAP_DEG,
    direction_groups,
    draw_lanes,
    draw_paths,
)
from geoorbit_ros.report.map_frame import MapFrame, draw_north, draw_scale_bar, fit_map_frame
from geoorbit_ros.report.svg import Canvas, nice_step
from geoorbit_ros.report.text import compass

IMAGE_WIDTH_PX = SECTION_WIDTH_PX = 1040.0
"""Width of drawings, as of maps. Layout of the page."""
JPEG_QUALITY = 75
"""Of the camera's image. Chosen: larger makes the page larger, smaller blurs the paint."""
SECTION_HEIGHT_PX = 220.0
"""Of a histogram. Layout of the page."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 48.0, 16.0, 26.0, 40.0
"""Margins of a histogram. Layout of the page."""
_EMPTY = 0.01
"""Bins below this share of the highest one count as empty road and are not drawn. Chosen: larger
cuts off lanes with little traffic."""


def image_view(
    lane_map: LaneMap,
    paths: Sequence[NDArray[np.float64]],
    homography: Homography,
    image_size: tuple[int, int],
    background: NDArray[np.uint8] | None = None,
) -> Canvas:
    """Draw what lies on the road over an image of the camera, an empty one where there is none.

    Args:
        lane_map: The lanes.
        paths: Of the vehicles, in metres.
        homography: The camera's calibration.
        image_size: (width, height) in pixels.
        background: (H, W, 3) uint8 BGR of any size with the same view; None: empty.
    """
    scale = IMAGE_WIDTH_PX / image_size[0]
    size = np.array(image_size) * scale
    canvas = Canvas(size[0], size[1], "The camera's view with lanes and the paths of the vehicles")
    colour = direction_groups(lane_map.lanes)

    def to_pixel(local_m: NDArray[np.float64]) -> NDArray[np.float64]:
        return homography.to_pixel(local_m) * scale

    def inside(pixel: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(np.all((pixel > 14) & (pixel < size - 14), axis=1))

    if background is not None:
        canvas.image(_jpeg(background))
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


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    """The image as JPEG, no wider than it is shown."""
    scale = min(IMAGE_WIDTH_PX / image.shape[1], 1.0)
    smaller = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", smaller, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()


def _horizon(
    canvas: Canvas, homography: Homography, scale: float, size: NDArray[np.float64]
) -> None:
    """The line where the road plane ends, when it crosses the image."""
    a, b, c = homography.matrix[2]
    if abs(b) < 1e-12:
        return
    lens = homography.lens
    width = size[0] / scale
    u = np.array([0.0, width]) if lens is None else np.linspace(-width, 2 * width, 301)
    line = np.column_stack((u, -(a * u + c) / b))
    if lens is not None:
        line = lens.distort(line)
        line = line[(line[:, 0] >= 0.0) & (line[:, 0] <= width)]  # NaN is not
    line = line * scale
    if len(line) and np.all((line[:, 1] > 0) & (line[:, 1] < size[1])):
        canvas.line(line, "horizon", "Horizon")
        canvas.text(size[0] - 10, line[-1, 1] - 6, "horizon", "label", "end")


def map_view(
    lane_map: LaneMap, paths: Sequence[NDArray[np.float64]], truth: Sequence[Lane] = ()
) -> tuple[Canvas, MapFrame, int]:
    """Draw the map.

    Returns:
        The drawing, its frame, and how many vehicle paths it shows.
    """
    lines = [x for lane in lane_map.lanes for x in (lane.left_m, lane.right_m)]
    lines += [lane.centerline_m for lane in truth]
    frame = fit_map_frame(np.vstack(lines))
    canvas = Canvas(*frame.size_px, "Map of the lanes with the paths of the vehicles")
    colour = direction_groups(lane_map.lanes)
    canvas.open_clip("map-clip", 0, 0, *frame.size_px)
    if len(lane_map.visible_m):
        canvas.area(frame.to_pixel(lane_map.visible_m), "visible")
    drawn = draw_paths(canvas, paths, frame.to_pixel, lane_map.lanes, colour)
    for lane in truth:
        for line in (lane.left_m, lane.right_m):
            canvas.line(frame.to_pixel(line), "truth")
        canvas.line(frame.to_pixel(lane.centerline_m), "truth middle", f"True lane {lane.lane_id}")
    draw_lanes(canvas, lane_map.lanes, frame.to_pixel, colour, frame.inside)
    canvas.close()
    draw_scale_bar(canvas, frame)
    draw_north(canvas, frame)
    return canvas, frame, drawn


def section_view(section: CrossSection, lane_map: LaneMap) -> Canvas:
    """Draw one direction's histogram as the driver sees the road, left on the left."""
    canvas = Canvas(
        SECTION_WIDTH_PX,
        SECTION_HEIGHT_PX,
        f"Traffic across the road towards {compass(section.heading_deg)}",
    )
    colour = _colour(section, lane_map)
    top = max(float(section.density.max(initial=0.0)), 1e-9)
    used = section.offset_m[section.density > _EMPTY * top]
    ends = np.concatenate((used, section.peak_m))
    low, high = (ends.min() - 2.0, ends.max() + 2.0) if len(ends) else (-5.0, 5.0)
    wide = (SECTION_WIDTH_PX - _LEFT - _RIGHT) / (high - low)
    base = SECTION_HEIGHT_PX - _BOTTOM

    def x(offset_m: float) -> float:
        return float(_LEFT + (high - offset_m) * wide)

    step = nice_step(high - low, 12)
    for tick in np.arange(np.ceil(low / step) * step, high, step):
        canvas.line(np.array([[x(tick), base], [x(tick), base + 4]]), "axis")
        canvas.text(x(tick), base + 17, f"{tick + 0.0:g}", "label", "middle")
    canvas.text(_LEFT, SECTION_HEIGHT_PX - 6, "← driver's left", "label")
    canvas.text(
        SECTION_WIDTH_PX - _RIGHT, SECTION_HEIGHT_PX - 6, "driver's right →", "label", "end"
    )
    middle = (SECTION_WIDTH_PX + _LEFT - _RIGHT) / 2
    canvas.text(middle, SECTION_HEIGHT_PX - 6, "metres across the road", "label", "middle")

    inside = (section.offset_m >= low) & (section.offset_m <= high)
    across, density = section.offset_m[inside], section.density[inside]
    tall = (base - _TOP) / top
    curve = np.column_stack((_LEFT + (high - across) * wide, base - density * tall))
    if len(curve) > 1:
        foot = np.array([[curve[-1, 0], base], [curve[0, 0], base]])
        canvas.area(np.vstack((curve, foot)), f"histogram d{colour}")
        canvas.line(curve, f"centerline confirmed d{colour}")
    canvas.line(np.array([[_LEFT, base], [SECTION_WIDTH_PX - _RIGHT, base]]), "axis")
    canvas.text(_LEFT - 6, _TOP + 4, f"{top:.2g}", "label", "end")
    canvas.text(_LEFT - 6, base, "0", "label", "end")
    canvas.text(_LEFT - 42, 12, "vehicles per metre", "label")

    peaks = np.sort(section.peak_m)[::-1]
    for k, peak in enumerate(peaks):
        canvas.line(np.array([[x(peak), _TOP - 6], [x(peak), base]]), "peak")
        if k:
            gap = peaks[k - 1] - peak
            canvas.text(
                (x(peaks[k - 1]) + x(peak)) / 2, _TOP - 8, f"{gap:.2f} m", "label", "middle"
            )
    return canvas


def _colour(section: CrossSection, lane_map: LaneMap) -> int:
    colour = direction_groups(lane_map.lanes)
    gap = {
        lane.lane_id: abs((lane.heading_deg - section.heading_deg + 180.0) % 360.0 - 180.0)
        for lane in lane_map.lanes
    }
    nearest = min(gap, key=gap.__getitem__, default=None)
    if nearest is None or gap[nearest] > DIRECTION_GAP_DEG:
        return 5
    return colour[nearest]
