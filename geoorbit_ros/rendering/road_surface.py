"""The surface of a scene's roads, or of the lanes of a map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.rendering.surface import (
    Line,
    RoadSurface,
    Strip,
    arc_length,
    outside_of,
    shifted,
)
from geoorbit_ros.scenes.road_plan import LaneRef
from geoorbit_ros.scenes.roads import PlacedRoad, successors

Roads = Mapping[str, PlacedRoad] | Sequence[Lane]
"""What an image can be made of: a scene's placed roads, or lanes alone."""

SHOULDER_M = 2.2
"""Paved shoulder right of a motorway. Chosen: usual is 2 to 3 m."""
INNER_SHOULDER_M = 0.9
"""Paved shoulder left of a motorway. Chosen: usual is 0.5 to 1 m."""
CITY_SHOULDER_M = 0.6
"""Pavement beside the lines of other roads. Chosen: usual is 0.5 m."""
PAVED_MEDIAN_M = 2.5
"""A narrower median is paved, not grass. Chosen by appearance."""
TAPER_M = 45.0
"""Length over which the edge line of a lane that begins or ends crosses it. Chosen: between those
of a city street and of a motorway."""
MOTORWAY_KMH = 75.0
"""Roads with a higher speed limit look like motorways. Chosen: between 70 and 80 km/h."""
MOTORWAY_DASH = (6.0, 12.0)
"""Dash and gap in metres (RMS-1 of Germany; others differ little)."""
CITY_DASH = (3.0, 6.0)
"""Dash and gap in metres (RMS-1 of Germany)."""
MARGIN_M = 0.35
"""Lines of one road that lie further than this inside another road's lanes are not painted. Chosen:
two lines' widths; smaller paints lines across ramps."""
NEIGHBOUR_M = 0.9
"""Boundaries of two lanes closer than this are one line. Chosen: a quarter of a lane."""
RUN_OUT_M = 150.0
"""Roads go on in the image behind their free ends. Chosen: shorter shows the end of the road."""
STEP_M = 2.0
"""Spacing of points on a prolonged border: as in `scenes.roads`."""


def surface_of(roads: Roads) -> RoadSurface:
    """The surface of placed roads, or of lanes."""
    return _road_surface(dict(roads)) if isinstance(roads, Mapping) else _lane_surface(roads)


def _road_surface(placed: dict[str, PlacedRoad]) -> RoadSurface:
    surface = RoadSurface()
    core: dict[str, Strip] = {}
    lines: list[tuple[str, Line, tuple[float, float] | None]] = []
    yellow: list[Line] = []
    for name, place in placed.items():
        border, extra = _run_out(place, placed)
        lanes, width = place.road.lanes, place.width_m
        right = -(lanes * width + extra)
        fast = place.road.speed_kmh > MOTORWAY_KMH
        shoulder = SHOULDER_M if fast else CITY_SHOULDER_M
        inner = _inner_shoulder(name, placed, fast)
        surface.paved.append(Strip(shifted(border, inner), shifted(border, right - shoulder)))
        core[name] = Strip(shifted(border, -MARGIN_M), shifted(border, MARGIN_M - lanes * width))
        for k in range(lanes):
            left = shifted(border, -k * width)
            surface.lanes.append(Strip(left, shifted(border, -(k + 1) * width)))
            if k > 0:
                lines.append((name, left, MOTORWAY_DASH if fast else CITY_DASH))
        lines.append((name, border, None))
        lines.append((name, shifted(border, right), None))
        if place.road.yellow_left_line:
            yellow.append(border)
    for name, line, dash in lines:
        for piece in outside_of(line, [strip for other, strip in core.items() if other != name]):
            if any(line is other for other in yellow):
                surface.yellow.append(piece)
            elif dash is None:
                surface.solid.append(piece)
            else:
                surface.dashed.append((piece, *dash))
    return surface


def _inner_shoulder(name: str, placed: dict[str, PlacedRoad], fast: bool) -> float:
    """Pavement left of the left border."""
    for other, place in placed.items():
        ref = place.road.opposite
        if ref and name in (other, ref.road) and ref.median_m <= PAVED_MEDIAN_M:
            return ref.median_m
    return INNER_SHOULDER_M if fast else CITY_SHOULDER_M


def _run_out(place: PlacedRoad, placed: dict[str, PlacedRoad]) -> tuple[Line, NDArray[np.float64]]:
    """Left border with its free ends prolonged, and how far right of the lanes the edge is."""
    border = place.border_m
    arc = arc_length(border)
    begin, end = _tapers(place, placed)
    extra = begin * np.clip(1.0 - arc / TAPER_M, 0.0, 1.0)
    extra = np.maximum(extra, end * np.clip(1.0 - (arc[-1] - arc) / TAPER_M, 0.0, 1.0))
    free_start, free_end = _free_ends(place, placed)
    steps = np.arange(STEP_M, RUN_OUT_M, STEP_M)[:, None]
    heading = place.heading_rad
    if free_end:
        ahead = np.array([np.cos(heading[-1]), np.sin(heading[-1])])
        border = np.concatenate([border, border[-1] + steps * ahead])
        extra = np.append(extra, np.zeros(len(steps)))
    if free_start:
        behind = -np.array([np.cos(heading[0]), np.sin(heading[0])])
        border = np.concatenate([(border[0] + steps * behind)[::-1], border])
        extra = np.append(np.zeros(len(steps)), extra)
    return border, extra


def _tapers(place: PlacedRoad, placed: dict[str, PlacedRoad]) -> tuple[float, float]:
    """Width of the lanes that end where this road begins, and that begin where it ends."""
    after = successors(placed)
    into = {lane for followers in after.values() for lane in followers}
    name, begin, end = place.road.id, 0.0, 0.0
    if place.road.follows:
        before = placed[place.road.follows].road
        missing = before.lanes - place.road.lanes
        dead = [k for k in range(max(missing, 0)) if not after[before.id, k]]
        begin = len(dead) * place.width_m
    for other in placed.values():
        if other.road.follows == name:
            new = other.road.lanes - place.road.lanes
            fresh = [k for k in range(max(new, 0)) if (other.road.id, k) not in into]
            end = len(fresh) * other.width_m
    return begin, end


def _free_ends(place: PlacedRoad, placed: dict[str, PlacedRoad]) -> tuple[bool, bool]:
    """Whether no other road touches the start, and the end."""
    road = place.road
    roads = [p.road for p in placed.values()]
    start = not (road.follows or road.leaves or any(_joins(r.joins, road.id) for r in roads))
    end = not (road.joins or any(r.follows == road.id for r in roads))
    end &= not any(_joins(r.leaves, road.id) for r in roads)
    return start, end


def _joins(ref: LaneRef | None, name: str) -> bool:
    return ref is not None and ref.road == name


def _lane_surface(lanes: Sequence[Lane]) -> RoadSurface:
    """Lanes side by side share a line: dashed in one direction, solid between two."""
    surface = RoadSurface()
    strips = [Strip(lane.left_m, lane.right_m) for lane in lanes]
    surface.lanes.extend(strips)
    for k, lane in enumerate(lanes):
        surface.paved.append(
            Strip(shifted(lane.left_m, CITY_SHOULDER_M), shifted(lane.right_m, -CITY_SHOULDER_M))
        )
        core = [
            Strip(shifted(s.left_m, -2 * MARGIN_M), shifted(s.right_m, 2 * MARGIN_M))
            for i, s in enumerate(strips)
            if i != k
        ]
        others = [other for i, other in enumerate(lanes) if i != k]
        for line, opposite_side in ((lane.left_m, "right_m"), (lane.right_m, "left_m")):
            beside = _near(line, [getattr(other, opposite_side) for other in others])
            shared = line is lane.right_m
            for piece in _runs(line, ~beside):
                surface.solid.extend(outside_of(piece, core))
            if shared:  # the lane to the left of a line paints it
                surface.dashed.extend((piece, *MOTORWAY_DASH) for piece in _runs(line, beside))
    return surface


def _near(line: Line, others: list[Line]) -> NDArray[np.bool_]:
    """Whether each point of a line has a point of another line beside it."""
    found = np.zeros(len(line), bool)
    for other in others:
        gap = np.hypot(*(line[:, None] - other[None]).transpose(2, 0, 1))
        spacing = float(np.max(np.hypot(*np.diff(other, axis=0).T), initial=0.0))
        found |= gap.min(axis=1, initial=np.inf) < np.hypot(NEIGHBOUR_M, 0.5 * spacing)
    return found


def _runs(line: Line, flag: NDArray[np.bool_]) -> list[Line]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flag.astype(np.int8), [0]])))
    return [line[a:b] for a, b in edges.reshape(-1, 2) if b - a > 1]
