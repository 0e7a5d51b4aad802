"""Lanes of the traffic and lines of the paint, together: which line bounds which lane.

Vehicles say how many lanes there are and about where; paint says where each one ends. Both are
weighed in one sum of squared errors over all lanes of a road, smallest over all choices (dynamic
programming across the road): a line is where vehicles pass on both sides of it, lanes are about as
wide as lanes are, drivers keep about to the middle, and what is clearly painted counts more than
what may be a seam or a tyre track. A boundary without a line stays where the traffic has it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.core.lanes import Lane, LaneEdge, LaneMap
from geoorbit_ros.core.polylines import project
from geoorbit_ros.markings.lines import PaintedLine, find_lines
from geoorbit_ros.markings.strip import ALONG_M, RoadStrip, rectify

Array = NDArray[np.float64]

LANE_WIDTH_M, LANE_WIDTH_SIGMA_M = 3.5, 0.45
"""Width of lanes and its 1-sigma: 2.75 m in towns to 4.25 m (AASHTO Green Book 2018: 2.7 to 3.6 m;
RAA, Germany: 3.25 to 3.75 m; older roads and curves more)."""
DRIVER_SIGMA_M = 0.40
"""1-sigma of how far the median driver is from the lane's middle. Measured on real motorway cameras:
0.24 m towards the neighbouring lane in edge lanes, up to 0.56 m."""
LINE_WORTH = 6.0
"""What a clear line speaks for itself, as a sum of squared errors. Chosen: a line that makes a lane
2.4 sigma too wide is another line."""
CLEAR_CONTRAST = 5.0
"""Contrast of a clear line where there is paint, in units of noise; tyre tracks have about 2.5."""
WORTHLESS_CONTRAST = 2.4
"""Contrast that says nothing. Measured on the same cameras: tyre tracks and seams."""
NEAREST_M, FARTHEST_M = 0.8, 3.0
"""Distance of a lane's boundary from where its drivers are. Half of the narrowest lane (2.5 m) less
the largest offset of drivers, and half of the widest (4.5 m) and that offset."""
NEIGHBOUR_M = 5.5
"""Lanes farther apart have no boundary in common. Chosen: larger takes a painted island for paint
between two lanes."""
MARGIN_M = 5.0
"""Road beside the outermost lanes that is looked at."""
EXTENSION_M = 15.0
"""Road before and after the lanes that is looked at: dashes are easier to tell where more of them
are seen. Chosen: on a curve of 200 m the straight extension is 0.6 m off."""
LEAST_SHARE = 0.3
"""A line that accompanies less of a lane is no boundary of it. Chosen."""
CENTRE_SIGMA_M = 0.15
"""1-sigma of a lane's centreline by the traffic, as part of the sum."""


@dataclass(frozen=True, slots=True)
class Road:
    """Lanes side by side, and the lines found along them.

    Attributes:
        lanes: From right to left of the reference line.
        centre_m: (N, S) their offsets from the reference line, by station; NaN beside a lane's ends.
        strip: The rectified image.
        lines: From right to left.
    """

    lanes: tuple[Lane, ...]
    centre_m: Array
    strip: RoadStrip
    lines: tuple[PaintedLine, ...]


def find_roads(lane_map: LaneMap, image: NDArray[np.uint8], homography: Homography) -> list[Road]:
    """Group the lanes that run side by side, and find the lines along each group.

    Args:
        lane_map: Lanes by the traffic.
        image: (H, W, 3) BGR, of the camera that saw the traffic.
        homography: Its road plane, in the frame of the lanes.
    """
    roads = []
    for lanes in _side_by_side(lane_map.lanes):
        reference = _extended(max(lanes, key=lambda lane: lane.length_m).centerline_m)
        middle = [project(lane.centerline_m, reference).offset_m for lane in lanes]
        low, high = min(m.min() for m in middle), max(m.max() for m in middle)
        strip = rectify(image, homography, reference, low - MARGIN_M, high + MARGIN_M)
        order = sorted(range(len(lanes)), key=lambda k: float(np.median(middle[k])))
        ordered = tuple(lanes[k] for k in order)
        centre = np.array([_by_station(lane, strip) for lane in ordered])
        roads.append(Road(ordered, centre, strip, tuple(find_lines(strip))))
    return roads


def with_painted_edges(lane_map: LaneMap, roads: Sequence[Road]) -> LaneMap:
    """The map with boundaries on the lines; lanes between two lines have their middle there."""
    changed = {}
    for road in roads:
        choice = _choose(road)
        for k, lane in enumerate(road.lanes):
            changed[lane.lane_id] = _bounded(road, k, *choice[k])
    lanes = tuple(changed.get(lane.lane_id, lane) for lane in lane_map.lanes)
    return replace(lane_map, lanes=lanes)


def _side_by_side(lanes: Sequence[Lane]) -> list[list[Lane]]:
    """Lanes in groups, in each of which every lane has a neighbour."""
    group = list(range(len(lanes)))
    for i, a in enumerate(lanes):
        for j, b in enumerate(lanes[:i]):
            at = project(a.centerline_m, b.centerline_m)
            near = at.inside & (np.abs(at.offset_m) < NEIGHBOUR_M)
            if np.count_nonzero(near) > 0.3 * min(len(near), len(b.centerline_m)):
                old, new = group[i], group[j]
                group = [new if g == old else g for g in group]
    return [[lane for lane, g in zip(lanes, group, strict=True) if g == k] for k in sorted(set(group))]


def _extended(line_m: Array) -> Array:
    """The line with straight extensions at both ends."""
    ends = []
    for line in (line_m, line_m[::-1]):
        inner = line[min(len(line) - 1, 4)]
        direction = (line[0] - inner) / np.hypot(*(line[0] - inner))
        ends.append(line[0] + EXTENSION_M * direction)
    return np.vstack([ends[0], line_m, ends[1]])


def _by_station(lane: Lane, strip: RoadStrip) -> Array:
    """(S,) offset of the lane's centreline."""
    at = project(lane.centerline_m, strip.point_m)
    order = np.argsort(at.arc_m)
    arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(strip.point_m, axis=0).T)))
    return np.interp(arc, at.arc_m[order], at.offset_m[order], left=np.nan, right=np.nan)


def _beside(line: PaintedLine, centre_m: Array) -> float:
    """Median distance of a line to the left of a lane's centre; NaN if it accompanies too little."""
    apart = line.offset_m - centre_m
    known = np.isfinite(apart)
    if np.count_nonzero(known) < LEAST_SHARE * np.count_nonzero(np.isfinite(centre_m)):
        return float("nan")
    return float(np.median(apart[known]))


def _worth(line: PaintedLine) -> float:
    """What the line speaks for itself: 0 for a seam, `LINE_WORTH` for clear paint."""
    clear = (line.contrast - WORTHLESS_CONTRAST) / (CLEAR_CONTRAST - WORTHLESS_CONTRAST)
    return LINE_WORTH * min(max(clear, 0.0), 1.0)


Choice = tuple[int | None, int | None]
"""Numbers of the lines right and left of a lane."""


def _choose(road: Road) -> list[Choice]:
    """The lines that bound each lane: the cheapest choice over all lanes together."""
    lanes = len(road.lanes)
    side = np.array([[_beside(line, centre) for line in road.lines] for centre in road.centre_m])
    worth = [_worth(line) for line in road.lines]
    spacing = [
        float(np.nanmedian(b - a)) if np.isfinite(b - a).any() else np.inf
        for a, b in zip(road.centre_m[:-1], road.centre_m[1:], strict=True)
    ]
    joined = [gap < NEIGHBOUR_M for gap in spacing]

    def options(k: int, sign: float) -> list[int | None]:
        if not len(road.lines):
            return [None]
        distance = sign * side[k]
        with np.errstate(invalid="ignore"):
            near = (distance > NEAREST_M) & (distance < FARTHEST_M)
        return [None, *(int(i) for i in np.flatnonzero(near) if worth[i] > 0.0)]

    def own(k: int, right: int | None, left: int | None) -> float:
        """Squared errors of one lane."""
        a = None if right is None else side[k][right]
        b = None if left is None else side[k][left]
        if a is not None and b is not None:
            width, middle = b - a, 0.5 * (a + b)
            wide = (width - LANE_WIDTH_M) / LANE_WIDTH_SIGMA_M
            return float(np.square(wide) + np.square(middle / DRIVER_SIGMA_M))
        one = -a if a is not None else b
        if one is None:
            return 0.0
        sigma = np.hypot(0.5 * LANE_WIDTH_SIGMA_M, DRIVER_SIGMA_M)
        return float(np.square((one - 0.5 * LANE_WIDTH_M) / sigma))

    def speaks(line: int | None) -> float:
        return 0.0 if line is None else -worth[line]

    # best[left] = (cost, choices so far) of the lanes up to k whose last left boundary is `left`.
    best: dict[int | None, tuple[float, list[Choice]]] = {}
    for k in range(lanes):
        before: dict[int | None, tuple[float, list[Choice]]]
        if k and joined[k - 1]:
            shared = set(options(k, -1.0))
            before = {line: value for line, value in best.items() if line in shared or line is None}
        else:
            start = min(best.values(), key=lambda value: value[0], default=(0.0, []))
            before = {
                line: (start[0] + speaks(line), start[1]) for line in options(k, -1.0)
            }
        lefts = options(k, 1.0)
        if k + 1 < lanes and joined[k]:
            following = set(options(k + 1, -1.0))
            lefts = [line for line in lefts if line is None or line in following]
        best = {
            left: min(
                (
                    (cost + own(k, right, left) + speaks(left), [*chosen, (right, left)])
                    for right, (cost, chosen) in before.items()
                ),
                key=lambda value: value[0],
            )
            for left in lefts
        }
    return min(best.values(), key=lambda value: value[0])[1]


def _bounded(road: Road, k: int, right: int | None, left: int | None) -> Lane:
    """Lane `k` of a road with boundaries on its lines."""
    lane, centre, strip = road.lanes[k], road.centre_m[k], road.strip
    known = np.isfinite(centre)
    same_way = _leads_along(lane, strip)
    if right is None and left is None:
        edge = LaneEdge("traffic", lane.width_sigma_m)
        return replace(lane, left_edge=edge, right_edge=edge)
    offsets = [None if i is None else _along(road.lines[i], centre) for i in (right, left)]
    edges = [_edge(road, i, known, lane) for i in (right, left)]
    if offsets[0] is None or offsets[1] is None:
        width = _width_beside_one_line(lane, offsets[0], offsets[1], centre)
        if offsets[0] is None:
            assert offsets[1] is not None
            offsets[0] = offsets[1] - width
        else:
            offsets[1] = offsets[0] + width
    low, high = offsets
    assert low is not None
    assert high is not None
    middle = 0.5 * (low + high)
    lines = [_points(lane, strip, offset) for offset in (low, middle, high)]
    if not same_way:
        lines, edges = lines[::-1], edges[::-1]
    both = right is not None and left is not None
    driven = float(np.nanmedian((centre - middle)[known])) * (1.0 if same_way else -1.0)
    sigma = [edge.sigma_m for edge in edges]
    return replace(
        lane,
        right_m=lines[0],
        centerline_m=lines[1],
        left_m=lines[2],
        width_m=float(np.nanmean((high - low)[known])),
        width_sigma_m=float(np.hypot(*sigma)),
        sigma_m=0.5 * float(np.hypot(*sigma)) if both else lane.sigma_m,
        right_edge=edges[0],
        left_edge=edges[1],
        driven_offset_m=driven if both else float("nan"),
    )


def _leads_along(lane: Lane, strip: RoadStrip) -> bool:
    """Whether the lane leads in the direction of the stations."""
    at = project(lane.centerline_m[[0, -1]], strip.point_m)
    return bool(at.arc_m[1] > at.arc_m[0])


def _along(line: PaintedLine, centre_m: Array) -> Array:
    """(S,) the line's offset, continued beside the lane where the line has ended."""
    apart = line.offset_m - centre_m
    known = np.flatnonzero(np.isfinite(apart))
    stations = np.arange(len(apart))
    return np.where(
        np.isfinite(line.offset_m) & np.isfinite(centre_m),
        line.offset_m,
        centre_m + np.interp(stations, known, apart[known]),
    )


def _edge(road: Road, line: int | None, known: NDArray[np.bool_], lane: Lane) -> LaneEdge:
    if line is None:
        return LaneEdge("traffic", lane.width_sigma_m)
    found = road.lines[line]
    here = known & np.isfinite(found.offset_m)
    share = float(np.count_nonzero(here) / np.count_nonzero(known))
    return LaneEdge("paint", float(found.sigma_m[here].mean()), found.kind, found.colour, share)


def _width_beside_one_line(lane: Lane, low: Array | None, high: Array | None, centre: Array) -> float:
    """Width of a lane of which one boundary is painted: what the traffic and the line say."""
    line = low if low is not None else high
    assert line is not None
    half = float(np.nanmedian(np.abs(line - centre)))
    says = np.array([lane.width_m, 2.0 * half, LANE_WIDTH_M])
    sigma = np.array([LANE_WIDTH_SIGMA_M, 2.0 * DRIVER_SIGMA_M, LANE_WIDTH_SIGMA_M])
    return float(np.average(says, weights=sigma**-2))


def _points(lane: Lane, strip: RoadStrip, offset_m: Array) -> Array:
    """(K, 2) points beside the lane's own, at offsets (S,) from the reference line."""
    at = project(lane.centerline_m, strip.point_m)
    station = at.arc_m / ALONG_M
    index = np.arange(len(offset_m))
    known = np.isfinite(offset_m)
    offset = np.interp(station, index[known], offset_m[known])
    columns = [
        np.interp(station, index, values)
        for values in (*strip.point_m.T, *strip.normal.T)
    ]
    x, y, normal_x, normal_y = columns
    return np.column_stack((x + offset * normal_x, y + offset * normal_y))
