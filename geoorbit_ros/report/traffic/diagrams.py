"""Speed-flow diagrams and histograms of headways."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.report.svg import Canvas
from geoorbit_ros.report.traffic.axes import (
    LEFT_PX,
    RIGHT_PX,
    WIDTH_PX,
    Panel,
    draw_x_axis,
    draw_y_axis,
    limits,
    value_ticks,
)
from geoorbit_ros.report.traffic.content import TrafficContent
from geoorbit_ros.traffic.measures import FOLLOWING_S, headways_s
from geoorbit_ros.traffic.stations import Station

Array = NDArray[np.float64]

SPEED_FLOW_HEIGHT_PX = 300.0
"""Of the panel. Layout of the page."""
TOP_PX, BOTTOM_PX = 40.0, 48.0
"""Above and below panels. Layout of the page."""
COLUMNS, CELL_HEIGHT_PX, CELL_GAP_PX = 4, 130.0, 40.0
"""Histograms side by side, their height and the room between them. Layout of the page."""
BINS = 20
"""Bars of a histogram."""
BIN_S = (0.5, 1.25, 2.5)
"""Widths of bars: the limit of platoons is the edge of one. The shortest is chosen with which 90 %
of the headways are in the picture."""
MARKS = (
    "m-3.5 0a3.5 3.5 0 1 0 7 0a3.5 3.5 0 1 0 -7 0",
    "m-3.2 -3.2h6.4v6.4h-6.4z",
    "m0 -4.2l4.2 7.4h-8.4z",
    "m0 -4.4l4.4 4.4l-4.4 4.4l-4.4 -4.4z",
    "m0 4.2l4.2 -7.4h-8.4z",
    "m-4 -1.2h8v2.4h-8z",
)
"""Circle, square, triangle, diamond, triangle upside down, bar, around a point."""


def speed_flow(content: TrafficContent, station: Station) -> Canvas:
    """Draw a point per step and lane: space mean speed over flow."""
    canvas = Canvas(
        WIDTH_PX,
        TOP_PX + SPEED_FLOW_HEIGHT_PX + BOTTOM_PX,
        f"Speed-flow diagram, station {station.station_id}",
        "A mark per lane and interval: space mean speed in kilometres per hour over flow in "
        "vehicles per hour.",
    )
    css, lanes = content.lane_css(), content.lane_ids(station)
    rows = {k: content.rows_of(content.steps, station, k) for k in lanes}
    flow = np.concatenate([r["flow_veh_per_h"] for r in rows.values()])
    speed = np.concatenate([r["space_mean_speed_kmh"] for r in rows.values()])
    drawn = np.isfinite(speed) & np.isfinite(flow)
    across = limits(flow[drawn], 8)
    upright = limits(speed[drawn], 5, from_zero=False)
    panel = Panel(
        LEFT_PX, TOP_PX, WIDTH_PX - LEFT_PX - RIGHT_PX, SPEED_FLOW_HEIGHT_PX, across, upright
    )
    draw_y_axis(canvas, panel, value_ticks(*upright, 5), "space mean speed, km/h")
    draw_x_axis(canvas, panel, value_ticks(*across, 8), "flow of the lane, vehicles per hour")
    for k, (lane_id, table) in enumerate(rows.items()):
        points = panel.to_pixel(table["flow_veh_per_h"], table["space_mean_speed_kmh"])
        points = points[np.isfinite(points).all(axis=1)]
        mark = MARKS[k % len(MARKS)]
        data = "".join(f"M{x:.1f} {y:.1f}{mark}" for x, y in points)
        if data:
            canvas.raw(
                f'<path d="{data}" class="mark {css[lane_id]}"><title>Lane {lane_id}</title></path>'
            )
        y = TOP_PX + 8 + 20 * k
        canvas.raw(
            f'<path d="M{panel.right + 12:.1f} {y - 4:.1f}{mark}" class="mark {css[lane_id]}"/>'
        )
        canvas.text(panel.right + 22, y, f"lane {lane_id}", "name")
    return canvas


def headway_bins(headway_s: Array) -> Array:
    """(BINS + 1,) edges of the bars for headways, NaN for unknown ones; the last holds all more."""
    known = headway_s[np.isfinite(headway_s)]
    far = float(np.percentile(known, 90)) if len(known) else 0.0
    width = next((w for w in BIN_S if far <= w * (BINS - 1)), BIN_S[-1])
    return np.asarray(np.arange(BINS + 1) * width, np.float64)


def headways(content: TrafficContent, station: Station) -> Canvas:
    """Draw a histogram of time headways for each lane of a station."""
    lanes = content.lane_ids(station)
    columns = min(COLUMNS, len(lanes))
    lines = -(-len(lanes) // columns)
    canvas = Canvas(
        WIDTH_PX,
        TOP_PX + lines * (CELL_HEIGHT_PX + TOP_PX + BOTTOM_PX) - TOP_PX,
        f"Headways, station {station.station_id}",
        "A histogram per lane: which share of vehicles followed the one before at which time "
        f"headway. Bars below {FOLLOWING_S:g} seconds are of vehicles in a platoon.",
    )
    crossings = content.traffic.crossings
    headway, _ = headways_s(crossings, content.traffic.observed)
    at_station = crossings["station_id"] == station.station_id
    edges = headway_bins(headway[at_station])
    of_lane = {k: headway[at_station & (crossings["lane_id"] == k)] for k in lanes}
    share = {k: _shares(values, edges) for k, values in of_lane.items()}
    top_percent = limits(np.concatenate(list(share.values())), 3)
    width = (WIDTH_PX - LEFT_PX - 16.0 - (columns - 1) * CELL_GAP_PX) / columns
    for k, lane_id in enumerate(lanes):
        left = LEFT_PX + (k % columns) * (width + CELL_GAP_PX)
        top = TOP_PX + (k // columns) * (CELL_HEIGHT_PX + TOP_PX + BOTTOM_PX)
        panel = Panel(left, top, width, CELL_HEIGHT_PX, (0.0, float(edges[-1])), top_percent)
        count = int(np.isfinite(of_lane[lane_id]).sum())
        _histogram(canvas, panel, share[lane_id], edges, first=k % columns == 0)
        canvas.text(left, top - 12, f"lane {lane_id}: {count} headways", "name")
    return canvas


def _shares(headway_s: Array, edges: Array) -> Array:
    """(BINS,) share of the known headways in each bar, in percent."""
    known = headway_s[np.isfinite(headway_s)]
    inside = np.clip(known, 0.0, edges[-1] - 1e-9)
    counted, _ = np.histogram(inside, edges)
    return np.asarray(100.0 * counted / max(len(known), 1))


def _histogram(canvas: Canvas, panel: Panel, share: Array, edges: Array, *, first: bool) -> None:
    for value, text in value_ticks(*panel.y, 3):
        y = panel.y_pixel(value)
        canvas.line(np.array([[panel.left, y], [panel.right, y]]), "grid")
        canvas.text(panel.left - 6, y + 4, f"{text} %" if first else text, "label", "end")
    follows = edges[:-1] < FOLLOWING_S
    for chosen, css in ((follows, "bar-follow"), (~follows, "bar-free")):
        data = ""
        for a, b, height in zip(edges[:-1][chosen], edges[1:][chosen], share[chosen], strict=True):
            if height > 0.0:
                x0, x1, y = panel.x_pixel(a), panel.x_pixel(b), panel.y_pixel(height)
                data += (
                    f"M{x0 + 0.5:.1f} {panel.bottom:.1f}V{y:.1f}H{x1 - 0.5:.1f}V{panel.bottom:.1f}Z"
                )
        if data:
            canvas.raw(f'<path d="{data}" class="{css}"/>')
    x = panel.x_pixel(FOLLOWING_S)
    canvas.line(np.array([[x, panel.top - 4], [x, panel.bottom]]), "peak")
    canvas.text(x + 4, panel.top + 8, f"{FOLLOWING_S:g} s", "label")
    ticks = [(v, t) for v, t in value_ticks(0.0, float(edges[-1]), 4) if v < edges[-1]]
    for value, text in (*ticks, (float(edges[-1]), "more")):
        tick = panel.x_pixel(value)
        canvas.line(np.array([[tick, panel.bottom], [tick, panel.bottom + 4]]), "axis")
        canvas.text(tick, panel.bottom + 17, text, "label", "middle")
    canvas.line(np.array([[panel.left, panel.bottom], [panel.right, panel.bottom]]), "axis")
    middle = (panel.left + panel.right) / 2
    canvas.text(middle, panel.bottom + 34, "headway, s", "label", "middle")
