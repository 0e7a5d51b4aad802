"""Flow and speed of each lane over time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.report.svg import Canvas
from geoorbit_ros.report.text import compass
from geoorbit_ros.report.traffic.axes import (
    LEFT_PX,
    RIGHT_PX,
    WIDTH_PX,
    Panel,
    draw_unwatched,
    draw_x_axis,
    draw_y_axis,
    limits,
    spread,
    time_ticks,
    unwatched_spans,
    value_ticks,
)
from geoorbit_ros.report.traffic.content import TrafficContent
from geoorbit_ros.traffic.interval_clock import NS
from geoorbit_ros.traffic.measures import LEAST_WATCHED
from geoorbit_ros.traffic.stations import Station

Array = NDArray[np.float64]

HEIGHT_PX, TOP_PX, BETWEEN_PX, BOTTOM_PX = 190.0, 34.0, 46.0, 46.0
"""Of one panel, and room above, between and below. Layout of the page."""
APART_PX = 15.0
"""Between labels at the ends of lines. Layout of the page."""


def over_time(content: TrafficContent, station: Station) -> Canvas:
    """Draw flow and speed of a station's lanes, a line per lane, a step per interval."""
    canvas = Canvas(
        WIDTH_PX,
        TOP_PX + 2 * HEIGHT_PX + BETWEEN_PX + BOTTOM_PX,
        f"Flow and speed over time, station {station.station_id}",
        "Two diagrams with a line per lane: vehicles per hour and kilometres per hour over time, "
        f"towards {compass(content.lane(content.lane_ids(station)[0]).heading_deg)}.",
    )
    first_ns, last_ns = content.span_ns
    ticks, clock_label = time_ticks(first_ns, last_ns, content.clock.zone)
    span_s = max((last_ns - first_ns) / NS, 1e-3)
    unwatched = unwatched_spans(
        content.traffic.observed, first_ns, last_ns, 1.5 * span_s / WIDTH_PX
    )
    lines = {k: content.rows_of(content.steps, station, k) for k in content.lane_ids(station)}
    unwatched = _with_empty_steps(unwatched, next(iter(lines.values())), first_ns)
    for row, (column, label, from_zero) in enumerate(
        (
            ("flow_veh_per_h", "flow, vehicles per hour", True),
            ("time_mean_speed_kmh", "mean speed, km/h", False),
        )
    ):
        values = np.concatenate([rows[column] for rows in lines.values()])
        scale = limits(values, from_zero=from_zero)
        top = TOP_PX + row * (HEIGHT_PX + BETWEEN_PX)
        panel = Panel(LEFT_PX, top, WIDTH_PX - LEFT_PX - RIGHT_PX, HEIGHT_PX, (0.0, span_s), scale)
        draw_unwatched(canvas, panel, unwatched, f"hatch-{column[:4]}-{station.station_id}")
        draw_y_axis(canvas, panel, value_ticks(*scale), label)
        draw_x_axis(canvas, panel, ticks, clock_label, written=row == 1)
        canvas.open_clip(
            f"clip-{column[:4]}-{station.station_id}",
            *(panel.left, panel.top - 2, panel.width, panel.height + 4),
        )
        points = {
            k: panel.to_pixel(*_steps(rows, column, first_ns, span_s)) for k, rows in lines.items()
        }
        for lane_id, line in points.items():
            canvas.line(line, f"series {content.lane_css()[lane_id]}", f"Lane {lane_id}")
        canvas.close()
        _draw_names(canvas, panel, points, content.lane_css())
    return canvas


def _with_empty_steps(
    spans: list[tuple[float, float]], rows: NDArray[np.void], first_ns: int
) -> list[tuple[float, float]]:
    """Also whole steps of which next to nothing was watched."""
    unknown = rows[rows["observed"] < LEAST_WATCHED]
    steps = [
        ((int(row["start_ns"]) - first_ns) / NS, (int(row["end_ns"]) - first_ns) / NS)
        for row in unknown
    ]
    merged = list[tuple[float, float]]()
    for begin, end in sorted([*spans, *steps]):
        if merged and begin <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(end, merged[-1][1]))
        else:
            merged.append((begin, end))
    return merged


def _draw_names(canvas: Canvas, panel: Panel, lines: dict[int, Array], css: dict[int, str]) -> None:
    """The name of each lane at its line's end, clear of the others."""
    named = list[tuple[int, float]]()
    for lane_id, points in lines.items():
        known = points[np.isfinite(points[:, 1]), 1]
        if len(known):
            named.append((lane_id, float(known[-1])))
    places = spread([y for _, y in named], APART_PX, panel.top + 4, panel.bottom - 2)
    for (lane_id, y), place in zip(named, places, strict=True):
        x = panel.right
        canvas.line(np.array([[x + 3, y], [x + 14, place]]), f"leader {css[lane_id]}")
        canvas.text(x + 17, place + 4, f"lane {lane_id}", f"name {css[lane_id]}")


def _steps(
    rows: NDArray[np.void], column: str, first_ns: int, span_s: float
) -> tuple[Array, Array]:
    """Corners of a step line in seconds and values; interrupted where a value isn't known."""
    begin = np.maximum((rows["start_ns"] - first_ns) / NS, 0.0)
    end = np.minimum((rows["end_ns"] - first_ns) / NS, span_s)
    return np.column_stack((begin, end)).ravel(), np.repeat(rows[column], 2)
