"""The map of the lanes, coloured by speed, with the counting stations."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.report.lane_drawing import draw_lane_numbers
from geoorbit_ros.report.map_frame import MapFrame, draw_north, draw_scale_bar, fit_map_frame
from geoorbit_ros.report.svg import Canvas
from geoorbit_ros.report.traffic.content import TrafficContent
from geoorbit_ros.report.traffic.speed_scale import SpeedScale
from geoorbit_ros.traffic.stations import Station

Array = NDArray[np.float64]

CELL_M = 10.0
"""Length of lane that has one colour. Chosen: shorter pieces show single vehicles."""


def speed_map(content: TrafficContent, scale: SpeedScale) -> tuple[Canvas, MapFrame]:
    """Draw the lanes from above.

    Returns:
        The drawing and its frame.
    """
    frame = fit_map_frame(np.vstack([side for lane in content.lanes for side in _sides(lane)]))
    canvas = Canvas(
        *frame.size_px,
        "Map of the lanes, coloured by speed",
        "The lanes from above with their numbers, the mean speed on each piece as a colour, and "
        "the counting stations as lines across the lanes.",
    )
    canvas.open_clip("speed-map-clip", 0, 0, *frame.size_px)
    for lane in content.lanes:
        for outline, speed_kmh in lane_cells(lane, content.tracks):
            known = bool(np.isfinite(speed_kmh))
            css = scale.css(int(scale.class_of(np.array([speed_kmh]))[0])) if known else "unknown"
            tip = f"Lane {lane.lane_id}: {speed_kmh:.0f} km/h" if known else ""
            canvas.area(frame.to_pixel(outline), f"cell {css}", tip)
        left, right = _sides(lane)
        canvas.area(frame.to_pixel(np.vstack((left, right[::-1]))), "outline")
    canvas.close()
    kinds = content.lane_css()
    draw_lane_numbers(canvas, content.lanes, frame.to_pixel, kinds, frame.inside, "plain")
    for station in content.stations:
        _draw_station(canvas, frame, content, station)
    scale.draw_legend(canvas, 0.28 * frame.size_px[0], frame.size_px[1] - 14)
    draw_scale_bar(canvas, frame)
    draw_north(canvas, frame)
    return canvas, frame


def lane_cells(lane: Lane, tracks: NDArray[np.void]) -> Iterator[tuple[Array, float]]:
    """Outline of each piece of a lane in metres, and the mean speed there in km/h, NaN: unknown.

    The mean is over the time that vehicles spent in the piece: the space mean speed (Edie 1963).
    """
    arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(lane.centerline_m, axis=0).T)))
    count = max(round(arc[-1] / CELL_M), 1)
    edges = np.linspace(0.0, arc[-1], count + 1)
    rows = tracks[tracks["lane_id"] == lane.lane_id]
    cell = np.searchsorted(edges, rows["arc_m"], side="right") - 1
    inside = (cell >= 0) & (cell < count)
    number = np.bincount(cell[inside], minlength=count)
    total = np.bincount(cell[inside], 3.6 * rows["speed_mps"][inside], count)
    speed = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    for k in range(count):
        between = arc[(arc > edges[k]) & (arc < edges[k + 1])]
        at = np.concatenate((edges[k : k + 1], between, edges[k + 1 : k + 2]))
        left, right = (_points(arc, side, at) for side in _sides(lane))
        yield np.vstack((left, right[::-1])), float(speed[k])


def _sides(lane: Lane) -> tuple[Array, Array]:
    """Left and right boundary, point by point beside the centreline."""
    if len(lane.left_m) == len(lane.right_m) == len(lane.centerline_m):
        return lane.left_m, lane.right_m
    half = lane.width_m / 2
    return offset_line(lane.centerline_m, half), offset_line(lane.centerline_m, -half)


def _points(arc: Array, line: Array, at: Array) -> Array:
    return np.column_stack([np.interp(at, arc, line[:, k]) for k in (0, 1)])


def _draw_station(
    canvas: Canvas, frame: MapFrame, content: TrafficContent, station: Station
) -> None:
    """A line from the outermost boundary to the other, and the station's number beside it."""
    ends = list[Array]()
    for index, at in zip(station.lanes, station.arc_m, strict=True):
        lane = content.lanes[index]
        arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(lane.centerline_m, axis=0).T)))
        ends += [_points(arc, side, np.array([at]))[0] for side in _sides(lane)]
    heading = station.heading_rad
    across = np.array([-np.sin(heading), np.cos(heading)])
    ends.sort(key=lambda point: float(point @ across))
    line = frame.to_pixel(np.array([ends[0], ends[-1]]))
    way = (line[1] - line[0]) / max(float(np.hypot(*(line[1] - line[0]))), 1e-9)
    line = np.vstack((line[0] - 6 * way, line[1] + 6 * way))
    canvas.line(line, "station", f"Counting station {station.station_id}")
    outer = line[int(np.hypot(*(line - np.array(frame.size_px) / 2).T).argmax())]
    away = way if np.allclose(outer, line[1]) else -way
    place = outer + 12 * away
    canvas.text(place[0], place[1] + 4, f"station {station.station_id}", "halo", "middle")
