"""Draws lanes, directions and vehicle paths, through any mapping from metres to pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.report.svg import Canvas
from geoorbit_ros.report.text import compass, number

ToPixel = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""(N, 2) metres in the map frame to (N, 2) pixels of the drawing; NaN where not in view."""

MAX_PATHS = 500
"""Vehicle paths that are drawn. Chosen: more make the page large and the drawing black."""
DIRECTION_GAP_DEG = 60.0
"""Lanes whose directions differ by less share a colour. Chosen: larger joins the arms of a
junction, smaller splits a bend."""
COLOURS = 6
"""In `page.css`, `d0` to `d5`."""
CHEVRON_EVERY_PX = 110.0
"""Between travel arrows. Layout of the drawing."""
BADGE_PX = 26.0
"""Least distance of two lane numbers: they are 20 pixels wide. Layout of the drawing."""


def direction_groups(lanes: Sequence[Lane]) -> dict[int, int]:
    """Colour number of each lane id: lanes that lead the same way share one."""
    groups: list[list[float]] = []
    colour: dict[int, int] = {}
    for lane in sorted(lanes, key=lambda x: (x.status != "confirmed", x.lane_id)):
        gap = [abs((lane.heading_deg - g[0] + 180.0) % 360.0 - 180.0) for g in groups]
        if not gap or min(gap) > DIRECTION_GAP_DEG:
            groups.append([lane.heading_deg])
            gap.append(0.0)
        k = int(np.argmin(gap))
        groups[k].append(lane.heading_deg)
        colour[lane.lane_id] = k % COLOURS
    return colour


def draw_paths(
    canvas: Canvas,
    paths: Sequence[NDArray[np.float64]],
    to_pixel: ToPixel,
    lanes: Sequence[Lane],
    colour: dict[int, int],
) -> int:
    """Draw at most `MAX_PATHS` vehicle paths, coloured like lanes of their direction.

    Returns:
        How many were drawn.
    """
    chosen = np.unique(np.linspace(0, len(paths) - 1, min(len(paths), MAX_PATHS)).astype(int))
    heading = {lane.lane_id: lane.middle[2] for lane in lanes}
    for k in chosen:
        dx, dy = paths[k][-1] - paths[k][0]
        driven = np.arctan2(dy, dx)
        gap = {i: abs(float(np.angle(np.exp(1j * (driven - h))))) for i, h in heading.items()}
        nearest = min(gap, key=gap.__getitem__, default=-1)
        same_way = nearest >= 0 and gap[nearest] < np.radians(DIRECTION_GAP_DEG)
        css = f"path d{colour[nearest]}" if same_way else "path"
        canvas.line(to_pixel(paths[k]), css)
    return len(chosen)


def draw_lanes(
    canvas: Canvas,
    lanes: Sequence[Lane],
    to_pixel: ToPixel,
    colour: dict[int, int],
    inside: Callable[[NDArray[np.float64]], NDArray[np.bool_]],
) -> None:
    """Draw each lane's surface, centreline, travel arrows and number.

    Args:
        canvas: Where to draw.
        lanes: Lanes in the map frame.
        to_pixel: Map frame to drawing.
        colour: Colour number by lane id.
        inside: Which (N, 2) pixels lie in the drawing, for placing numbers.
    """
    for lane in lanes:
        css = f"d{colour[lane.lane_id]} {lane.status}"
        outline = to_pixel(np.vstack((lane.left_m, lane.right_m[::-1])))
        canvas.area(outline, f"surface {css}", lane_tip(lane))
    for lane in lanes:
        css = f"d{colour[lane.lane_id]} {lane.status}"
        canvas.line(to_pixel(lane.centerline_m), f"centerline {css}")
    kinds = {lane.lane_id: f"d{colour[lane.lane_id]} {lane.status}" for lane in lanes}
    draw_lane_numbers(canvas, lanes, to_pixel, kinds, inside)


def draw_lane_numbers(
    canvas: Canvas,
    lanes: Sequence[Lane],
    to_pixel: ToPixel,
    kinds: Mapping[int, str],
    inside: Callable[[NDArray[np.float64]], NDArray[np.bool_]],
    arrows: str | None = None,
) -> None:
    """Draw each lane's travel arrows and number, clear of one another.

    Args:
        canvas: Where to draw.
        lanes: Lanes in the map frame.
        to_pixel: Map frame to drawing.
        kinds: CSS classes by lane id.
        inside: Which (N, 2) pixels lie in the drawing.
        arrows: CSS classes of the arrows; None: those of their lanes.
    """
    badges: list[NDArray[np.float64]] = []
    for lane, fraction in _label_places(lanes, direction_groups(lanes)):
        css = kinds[lane.lane_id]
        line = _dense(to_pixel(_dense(lane.centerline_m, 400)), 400)
        line = line[np.isfinite(line).all(axis=1)]
        line = line[inside(line)]
        if len(line) < 3:
            continue
        arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
        at = _free_place(line, arc, fraction * arc[-1], badges)
        for s in np.arange(CHEVRON_EVERY_PX / 2, arc[-1], CHEVRON_EVERY_PX):
            if abs(s - at) > 18.0:
                k = min(int(np.searchsorted(arc, s)), len(line) - 1)
                canvas.chevron(line[k], line[k] - line[max(k - 1, 0)], arrows or css)
        k = int(np.searchsorted(arc, at))
        badges.append(line[k])
        canvas.badge(line[k], str(lane.lane_id), css, lane_tip(lane))


def lane_tip(lane: Lane) -> str:
    """One line about a lane, shown when the pointer rests on it."""
    return (
        f"Lane {lane.lane_id}, {lane.status}: towards {compass(lane.heading_deg)}, "
        f"{number(lane.width_m)} m wide, {number(lane.vehicles, 0)} vehicles, "
        f"confidence {number(lane.confidence)}"
    )


def _label_places(lanes: Sequence[Lane], colour: dict[int, int]) -> list[tuple[Lane, float]]:
    """Where along each lane its number goes: neighbours apart, so that numbers don't touch."""
    places = []
    for group in sorted(set(colour.values())):
        members = [lane for lane in lanes if colour[lane.lane_id] == group]
        if not members:
            continue
        heading = members[0].middle[2]
        left = np.array([-np.sin(heading), np.cos(heading)])
        members.sort(key=lambda lane: float(left @ np.array(lane.middle[:2])))
        shares = np.linspace(0.32, 0.68, len(members)) if len(members) > 1 else [0.5]
        places += [(lane, float(f)) for lane, f in zip(members, shares, strict=True)]
    return places


def _free_place(
    line: NDArray[np.float64],
    arc: NDArray[np.float64],
    wanted: float,
    taken: Sequence[NDArray[np.float64]],
) -> float:
    """The arc length nearest to the wanted one that keeps clear of the numbers drawn so far."""
    apart = np.full(len(line), np.inf)
    for other in taken:
        apart = np.minimum(apart, np.hypot(*(line - other).T))
    free = np.flatnonzero(apart >= BADGE_PX)
    if not len(free):
        return float(arc[int(np.argmax(apart))])
    return float(arc[free[int(np.argmin(np.abs(arc[free] - wanted)))]])


def _dense(line: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """`count` points evenly along a polyline; NaN points are skipped."""
    line = line[np.isfinite(line).all(axis=1)]
    if len(line) < 2:
        return line
    arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    at = np.linspace(0.0, arc[-1], count)
    return np.column_stack([np.interp(at, arc, line[:, axis]) for axis in (0, 1)])
