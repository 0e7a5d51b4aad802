"""Time-space diagrams: where along its lane each vehicle was at which time."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.report.svg import Canvas, path_data
from geoorbit_ros.report.traffic.axes import (
    LEFT_PX,
    RIGHT_PX,
    WIDTH_PX,
    Panel,
    draw_unwatched,
    draw_x_axis,
    draw_y_axis,
    time_ticks,
    unwatched_spans,
    value_ticks,
)
from geoorbit_ros.report.traffic.content import TrafficContent
from geoorbit_ros.report.traffic.speed_scale import SpeedScale
from geoorbit_ros.traffic.interval_clock import NS
from geoorbit_ros.traffic.stations import Station

Array = NDArray[np.float64]

HEIGHT_PX, TOP_PX, BETWEEN_PX, BOTTOM_PX = 140.0, 56.0, 14.0, 46.0
"""Of a lane's panel, and room above, between and below. Layout of the page."""
THIN_PX = 0.4
"""Lines leave out points that would move them by less. Chosen: not visible; makes pages small."""


def time_space(content: TrafficContent, station: Station, scale: SpeedScale) -> Canvas:
    """Draw a panel per lane of a station, with a line per vehicle, coloured by speed."""
    lane_ids = content.lane_ids(station)
    canvas = Canvas(
        WIDTH_PX,
        TOP_PX + len(lane_ids) * (HEIGHT_PX + BETWEEN_PX) - BETWEEN_PX + BOTTOM_PX,
        f"Time-space diagram, station {station.station_id}",
        "A diagram per lane with a line per vehicle: metres along the lane over time. The steeper "
        "a line, the faster the vehicle.",
    )
    scale.draw_legend(canvas, LEFT_PX, 16)
    first_ns, last_ns = content.window_ns
    span_s = max((last_ns - first_ns) / NS, 1e-3)
    ticks, clock_label = time_ticks(first_ns, last_ns, content.clock.zone)
    unwatched = unwatched_spans(
        content.traffic.observed, first_ns, last_ns, 1.5 * span_s / WIDTH_PX
    )
    width = WIDTH_PX - LEFT_PX - RIGHT_PX
    for k, lane_id in enumerate(lane_ids):
        top = TOP_PX + k * (HEIGHT_PX + BETWEEN_PX)
        length = content.lane(lane_id).length_m
        panel = Panel(LEFT_PX, top, width, HEIGHT_PX, (0.0, span_s), (0.0, length))
        name = f"{station.station_id}-{lane_id}"
        draw_unwatched(canvas, panel, unwatched, f"hatch-track-{name}")
        label = "" if k else "along the lane, metres from its beginning"
        draw_y_axis(canvas, panel, value_ticks(0.0, length, 3), label)
        draw_x_axis(canvas, panel, ticks, clock_label, written=k == len(lane_ids) - 1)
        _draw_station(canvas, panel, content, station, lane_id)
        canvas.open_clip(f"clip-{name}", panel.left, panel.top, panel.width, panel.height)
        tracks = content.tracks[content.tracks["lane_id"] == lane_id]
        _draw_tracks(canvas, panel, tracks, scale, first_ns)
        canvas.close()
        canvas.text(panel.right + 12, top + 14, f"lane {lane_id}", "name")
    return canvas


def _draw_station(
    canvas: Canvas, panel: Panel, content: TrafficContent, station: Station, lane_id: int
) -> None:
    """Where the counting station crosses the lane."""
    index = next(k for k in station.lanes if content.lanes[k].lane_id == lane_id)
    y = panel.y_pixel(station.arc_m[station.lanes.index(index)])
    canvas.line(np.array([[panel.left, y], [panel.right + 8, y]]), "limit")
    canvas.text(panel.right + 12, y + 4, f"station {station.station_id}", "label")


def _draw_tracks(
    canvas: Canvas, panel: Panel, tracks: NDArray[np.void], scale: SpeedScale, first_ns: int
) -> None:
    """All tracks of a lane, one SVG path per class of speed."""
    parts = dict[int, list[str]]()
    begin = np.flatnonzero(np.diff(tracks["run"], prepend=-1))
    for rows in np.split(tracks, begin[1:]):
        if not len(rows):
            continue
        pixel = panel.to_pixel((rows["stamp_ns"] - first_ns) / NS, rows["arc_m"])
        kind = scale.steady_class_of(3.6 * rows["speed_mps"])
        cuts = np.flatnonzero(np.diff(kind)) + 1
        for a, b in zip([0, *cuts.tolist()], [*cuts.tolist(), len(rows)], strict=True):
            line = _thin(pixel[max(a - 1, 0) : b])  # from the last place of the colour before
            parts.setdefault(int(kind[a]), []).append(path_data(line))
    for number, lines in sorted(parts.items()):
        canvas.raw(f'<path d="{"".join(lines)}" class="track {scale.css(number)}"/>')


def _thin(line: Array) -> Array:
    """The line without points that hardly bend it (Douglas and Peucker 1973)."""
    if len(line) < 3:
        return line
    kept = cv2.approxPolyDP(line.astype(np.float32)[:, None], THIN_PX, closed=False)
    return np.asarray(kept[:, 0], np.float64)
