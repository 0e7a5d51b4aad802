"""Lanes of the traffic and lines of the paint, together: which line bounds which lane.

Vehicles say how many lanes there are and about where; paint says where each one ends. A boundary
without a line stays where the traffic has it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import hypot

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.plane import RoadPlane
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.core.lanes import Lane, LaneEdge, LaneMap
from geoorbit_ros.core.polylines import project
from geoorbit_ros.markings.assignment import (
    CLEAR_CONTRAST,
    NEIGHBOUR_M,
    Choice,
    choose_lines,
    in_one_painted_lane,
)
from geoorbit_ros.markings.dashes import DashPattern, dashes_of, usual_dashes
from geoorbit_ros.markings.lines import PaintedLine, find_lines
from geoorbit_ros.markings.road_image import ALONG_M, RoadStrip, rectify
from geoorbit_ros.markings.unused import BESIDE_M, REACH_M, unused_lanes

Array = NDArray[np.float64]

MAX_MOVE_M, MAX_GROWTH = 0.3, 1.1
"""Lanes of a later map are nearly the same if they moved by no more and are at most so much longer.
Chosen: lines are looked for 0.8 m beside where they begin, and 15 m before and after the lanes."""
MAX_STRETCH = 0.02
"""Proportions of an image may differ by rounding, not by more. Chosen."""
MIN_RANGE = 4.0
"""Least range of brightness of an image that shows anything, in levels of 255. Chosen: a covered
lens has less, the darkest night more."""
PIXEL_SIGMA = 0.5
"""1-sigma of a line's middle in the image. Chosen: optics and encoding leave half a pixel."""
PARALLEL_M = 1.5
"""Most by which the distance of two parallel lanes changes: a ramp has lines of its own. Chosen."""
BESIDE_SHARE = 0.3
"""Share of the shorter of two lanes along which neighbours run side by side. Chosen."""
MARGIN_M = 5.0
"""Road beside the outermost lanes that is looked at."""
EXTENSION_M = 15.0
"""Road before and after the lanes that is looked at: dashes are easier to tell where more of them
are seen. Chosen: on a curve of 200 m the straight extension is 0.6 m off."""
UNUSED_ID = 1_000_000
"""Numbers of painted lanes that nobody used begin here, and follow from that of the lane beside
them: a map counts its lanes from 1, and would take a million of them to come here."""
UNUSED_MISSING = 6
"""Vehicles that would confirm such a lane: as for every lane (`lanes.confidence`)."""


@dataclass(frozen=True, slots=True)
class Road:
    """Lanes side by side, and the lines found along them.

    Attributes:
        lanes: From right to left of the reference line.
        centre_m: (N, S) their offsets from the reference line, by station; NaN beside its ends.
        strip: The rectified image.
        lines: From right to left.
        homography: The camera's road plane.
        dashes: The pattern of each line; None for those that have none.
        beyond: Lines beside the road, where dashes are at its edge.
    """

    lanes: tuple[Lane, ...]
    centre_m: Array
    strip: RoadStrip
    lines: tuple[PaintedLine, ...]
    homography: RoadPlane
    dashes: tuple[DashPattern | None, ...]
    beyond: tuple[PaintedLine, ...] = ()


class RoadPaint:
    """The painted lines of one image, for a lane map that is renewed again and again.

    Args:
        image: (H, W, 3) BGR of the camera that saw the traffic, in any size of its proportions.
        homography: Its road plane, in the frame of the lanes.
        image_size: (width, height) of the images that the homography is of.

    Attributes:
        sentence: What came of the last map, or why the image can't be used.
        dashes: What the lengths of dashes say about the calibration; empty for nothing.
    """

    def __init__(
        self, image: NDArray[np.uint8], homography: RoadPlane, image_size: tuple[int, int]
    ) -> None:
        fault = _fault(image, image_size)
        self.sentence = f"{fault}: lane boundaries are where the traffic has them" if fault else ""
        self._usable = not fault
        if self._usable and image.shape[1::-1] != image_size:
            image = np.asarray(cv2.resize(image, image_size), dtype=np.uint8)
        self._image, self._homography = image, homography
        self.dashes = ""
        self._roads: list[Road] = []

    def follow(self, lane_map: LaneMap, *, anew: bool = True) -> LaneMap:
        """The map with boundaries on the lines.

        Args:
            lane_map: Lanes by the traffic.
            anew: Look at the image again. Otherwise the lines found for an earlier map are taken
                where its lanes were nearly the same: that costs a fiftieth.
        """
        if not self._usable:
            return lane_map
        known = None if anew else _moved(self._roads, lane_map)
        self._roads = known or find_roads(lane_map, self._image, self._homography)
        pattern = usual_dashes(dashes for road in self._roads for dashes in road.dashes)
        self.dashes = "" if pattern is None else pattern.sentence()
        found = with_painted_edges(lane_map, self._roads)
        edges = [edge for lane in found.lanes for edge in (lane.left_edge, lane.right_edge)]
        painted = sum(edge is not None and edge.source == "paint" for edge in edges)
        self.sentence = f"{painted} of {len(edges)} lane boundaries follow a painted line"
        if not painted:
            self.sentence = "no painted line is seen along the lanes"
            if any(line.contrast >= CLEAR_CONTRAST for road in self._roads for line in road.lines):
                self.sentence = "lines are seen, but none where a lane may end (has the camera "
                self.sentence += "moved since it was calibrated?)"
            self.sentence += ": boundaries are where the traffic has them"
        return found


def _moved(roads: Sequence[Road], lane_map: LaneMap) -> list[Road] | None:
    """The same roads with the lanes of a later map; None where these are not nearly the same."""
    lanes = {lane.lane_id: lane for lane in lane_map.lanes}
    if sorted(lanes) != sorted(lane.lane_id for road in roads for lane in road.lanes):
        return None
    moved = []
    for road in roads:
        ours = tuple(lanes[lane.lane_id] for lane in road.lanes)
        centre = np.array([_by_station(lane, road.strip) for lane in ours])
        apart = np.abs(centre - road.centre_m)
        both = np.isfinite(apart)
        grown = np.isfinite(centre).sum() > MAX_GROWTH * np.isfinite(road.centre_m).sum()
        if grown or not both.any() or apart[both].max() > MAX_MOVE_M:
            return None
        moved.append(replace(road, lanes=ours, centre_m=centre))
    return moved


def follow_paint(
    lane_map: LaneMap,
    image: NDArray[np.uint8],
    homography: RoadPlane,
    image_size: tuple[int, int],
    report: InputReport,
) -> LaneMap:
    """The map with boundaries on the lines that an image shows; what was found is noted.

    Args:
        lane_map: Lanes by the traffic.
        image: See `RoadPaint`.
        homography: See `RoadPaint`.
        image_size: See `RoadPaint`.
        report: On the image.
    """
    paint = RoadPaint(image, homography, image_size)
    if not lane_map.lanes:
        return lane_map
    found = paint.follow(lane_map)
    for sentence in filter(None, (paint.sentence, paint.dashes)):
        report.note(Treatment.NOTED, sentence)
    return found


def _fault(image: NDArray[np.uint8], image_size: tuple[int, int]) -> str:
    """Why an image can't show the lines of this camera's road; empty where it may."""
    height, width = image.shape[:2]
    if abs(width * image_size[1] / (height * image_size[0]) - 1.0) > MAX_STRETCH:
        wanted = "{}x{}".format(*image_size)
        return f"an image of {width}x{height} is not of this camera, whose images are {wanted}"
    low, high = np.quantile(image, (0.02, 0.98))
    if high - low < MIN_RANGE:
        return f"nearly all of the image is of one brightness ({low:.0f} to {high:.0f} of 255)"
    return ""


def find_roads(lane_map: LaneMap, image: NDArray[np.uint8], homography: RoadPlane) -> list[Road]:
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
        lines = tuple(find_lines(strip))
        dashes = tuple(dashes_of(strip, line) for line in lines)
        road = Road(ordered, centre, strip, lines, homography, dashes)
        roads.append(replace(road, beyond=_beyond(road, image, reference)))
    return roads


def _beyond(road: Road, image: NDArray[np.uint8], reference_m: Array) -> tuple[PaintedLine, ...]:
    """Lines beside a road at whose edge there are dashes as between lanes."""
    if len(road.lanes) < 2:
        return ()
    found: list[PaintedLine] = []
    choice = choose_lines(road.lines, road.centre_m, _oncoming(road))
    for side, chosen in ((-1.0, choice[0][0]), (1.0, choice[-1][1])):
        if chosen is None or road.dashes[chosen] is None:
            continue
        here = road.lines[chosen].offset_m
        ends = side * BESIDE_M, side * -REACH_M
        low, high = np.nanmin(here) - max(ends), np.nanmax(here) - min(ends)
        found += find_lines(rectify(image, road.homography, reference_m, low, high))
    return tuple(found)


def with_painted_edges(lane_map: LaneMap, roads: Sequence[Road]) -> LaneMap:
    """The map with boundaries on the lines; lanes between two lines have their middle there.

    Neighbours that are two bundles of traffic in one painted lane become that lane. Painted lanes
    that nobody used are added.
    """
    changed: dict[int, Lane | None] = {}
    unused: list[Lane] = []
    for road in roads:
        changed |= {lane.lane_id: None for lane in road.lanes}
        whole, choice = _assigned(road)
        for k, lane in enumerate(whole.lanes):
            changed[lane.lane_id] = _bounded(whole, k, *choice[k])
        unused += _unused(whole, choice)
    found = (changed.get(lane.lane_id, lane) for lane in lane_map.lanes)
    return replace(lane_map, lanes=(*(lane for lane in found if lane is not None), *unused))


def _unused(road: Road, choice: Sequence[Choice]) -> list[Lane]:
    """Painted lanes that nobody used, beside a road whose lanes all lead the same way."""
    if len({_leads_along(lane, road.strip) for lane in road.lanes}) != 1 or len(road.lanes) < 2:
        return []
    lanes = []
    for found in unused_lanes(road.lines, road.dashes, road.beyond, choice, road.centre_m):
        beside, centre = road.lanes[found.neighbour], road.centre_m[found.neighbour]
        right, left = (found.outer, found.inner)[:: -found.side]
        middle = 0.5 * (_along(right, centre) + _along(left, centre))
        station = project(beside.centerline_m, road.strip.point_m).arc_m / ALONG_M
        lane = replace(
            beside,
            lane_id=UNUSED_ID + 2 * beside.lane_id + (found.side > 0),
            centerline_m=_points(station, road.strip, middle),
            confidence=0.0,
            status="tentative",
            vehicles=0.0,
            vehicles_missing=UNUSED_MISSING,
            evidence=None,
        )
        alone = replace(road, lanes=(lane,), centre_m=middle[None], lines=(right, left))
        lanes.append(replace(_bounded(alone, 0, 0, 1), driven_offset_m=float("nan")))
    return lanes


def _assigned(road: Road) -> tuple[Road, list[Choice]]:
    """The road with the lines that bound its lanes, and one lane for bundles in one painted lane.

    A lane of several bundles that is not bounded by two lines is none.
    """
    whole, joined = _without_bundles(road)
    choice = choose_lines(whole.lines, whole.centre_m, _oncoming(whole))
    if any(None in choice[k] for k in joined):
        return road, choose_lines(road.lines, road.centre_m, _oncoming(road))
    return whole, choice


def _oncoming(road: Road) -> list[bool]:
    """For each lane but the last whether the next leads the other way."""
    along = [_leads_along(lane, road.strip) for lane in road.lanes]
    return [here != there for here, there in pairwise(along)]


def _without_bundles(road: Road) -> tuple[Road, list[int]]:
    """The road with one lane wherever neighbours are in one painted lane, and which these are."""
    lanes, centre = list(road.lanes), list(road.centre_m)
    joined: list[int] = []
    for k in np.flatnonzero(in_one_painted_lane(road.lines, road.centre_m))[::-1].tolist():
        pair = lanes[k : k + 2]
        if _leads_along(pair[0], road.strip) == _leads_along(pair[1], road.strip):
            lanes[k : k + 2] = [_joined(*pair)]
            weight = [max(lane.vehicles, 1e-9) for lane in pair]
            mean = np.average(centre[k : k + 2], axis=0, weights=weight)
            known = [np.where(np.isfinite(mean), mean, line) for line in centre[k : k + 2]]
            centre[k : k + 2] = [np.where(np.isfinite(known[0]), *known)]
            joined = [k, *(j - 1 for j in joined if j > k + 1)]
    return replace(road, lanes=tuple(lanes), centre_m=np.array(centre)), joined


def _joined(a: Lane, b: Lane) -> Lane:
    """One lane of two bundles: the longer one's lines, the older one's id, the traffic of both."""
    confirmed = "confirmed" in (a.status, b.status)
    return replace(
        max(a, b, key=lambda lane: lane.length_m),
        lane_id=min(a.lane_id, b.lane_id),
        vehicles=a.vehicles + b.vehicles,
        confidence=max(a.confidence, b.confidence),
        status="confirmed" if confirmed else "tentative",
        vehicles_missing=min(a.vehicles_missing, b.vehicles_missing),
    )


def _side_by_side(lanes: Sequence[Lane]) -> list[list[Lane]]:
    """Lanes in groups, in each of which every lane runs parallel to a neighbour."""
    group = list(range(len(lanes)))
    for i, a in enumerate(lanes):
        for j, b in enumerate(lanes[:i]):
            at = project(a.centerline_m, b.centerline_m)
            beside = np.abs(at.offset_m[at.inside])
            enough = len(beside) > BESIDE_SHARE * min(len(at.inside), len(b.centerline_m))
            if enough and np.median(beside) < NEIGHBOUR_M and np.ptp(beside) < PARALLEL_M:
                old, new = group[i], group[j]
                group = [new if g == old else g for g in group]
    groups = sorted(set(group))
    return [[lane for lane, g in zip(lanes, group, strict=True) if g == k] for k in groups]


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
    offset = np.interp(arc, at.arc_m[order], at.offset_m[order], left=np.nan, right=np.nan)
    return np.asarray(offset, dtype=np.float64)


def _bounded(road: Road, k: int, right: int | None, left: int | None) -> Lane:
    """Lane `k` of a road with boundaries on its lines."""
    lane, centre, strip = road.lanes[k], road.centre_m[k], road.strip
    known = np.isfinite(centre)
    same_way = _leads_along(lane, strip)
    if right is None and left is None:
        edge = LaneEdge("traffic", lane.width_sigma_m)
        return replace(lane, left_edge=edge, right_edge=edge)
    # A boundary without a line stays where the traffic has it.
    low, high = (
        centre + sign * 0.5 * lane.width_m if i is None else _along(road.lines[i], centre)
        for i, sign in ((right, -1.0), (left, 1.0))
    )
    station = project(lane.centerline_m, strip.point_m).arc_m / ALONG_M
    edges = [_edge(road, i, known, lane, station) for i in (right, left)]
    middle = 0.5 * (low + high)
    lines = [_points(station, strip, offset) for offset in (low, middle, high)]
    if not same_way:
        lines, edges = lines[::-1], edges[::-1]
    both = right is not None and left is not None
    if right is None or left is None:
        width_sigma_m, sigma_m = hypot(*(edge.sigma_m for edge in edges)), lane.sigma_m
    else:
        width_sigma_m, sigma_m = _sigma_between_m(road, right, left, known)
    driven = float(np.nanmedian((centre - middle)[known])) * (1.0 if same_way else -1.0)
    return replace(
        lane,
        right_m=lines[0],
        centerline_m=lines[1],
        left_m=lines[2],
        width_m=float(np.nanmean((high - low)[known])),
        width_sigma_m=width_sigma_m,
        sigma_m=sigma_m,
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


def _edge(
    road: Road, line: int | None, known: NDArray[np.bool_], lane: Lane, station: Array
) -> LaneEdge:
    """What the boundary on a line was taken from, at the stations (K,) of the lane's points."""
    if line is None:
        return LaneEdge("traffic", lane.width_sigma_m)
    found = road.lines[line]
    here = known & np.isfinite(found.offset_m)
    share = float(np.count_nonzero(here) / np.count_nonzero(known))
    at, sigma = _sigma_m(road, found, here)
    along = np.interp(station, at, sigma)
    # Where the line has ended, or is hidden, the boundary goes on as the lane does.
    seen = np.interp(station, np.arange(len(here)), here) > 0.5
    along = np.where(seen, along, np.hypot(along, lane.width_sigma_m))
    sigma_m = float(np.sqrt(np.mean(np.square(sigma))))
    points = tuple(along.tolist())
    return LaneEdge("paint", sigma_m, found.kind, found.colour, share, found.width_m, points)


def _sigma_m(
    road: Road, line: PaintedLine, here: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], Array]:
    """1-sigma of a line's place across the road: of its image, and of the road plane below it.

    Returns:
        Some of the stations `here`, and the errors there.
    """
    strip, at = road.strip, np.flatnonzero(here)
    at = at[:: max(len(at) // 20, 1)]
    pixel = road.homography.to_pixel(strip.place(line.offset_m)[at])
    covariance = road.homography.covariance(pixel, PIXEL_SIGMA)
    normal = strip.normal[at]
    plane = np.einsum("ni,nij,nj->n", normal, covariance, normal)
    return at, np.sqrt(plane + np.square(line.sigma_m[at]))


def _sigma_between_m(
    road: Road, right: int, left: int, known: NDArray[np.bool_]
) -> tuple[float, float]:
    """1-sigma of the distance of two lines, and of the middle between them.

    An error of the calibration moves both lines nearly alike: the width feels little of it, the
    middle all of it.
    """
    strip = road.strip
    lines = (road.lines[right], road.lines[left])
    at = np.flatnonzero(known & np.isfinite(lines[0].offset_m) & np.isfinite(lines[1].offset_m))
    if not len(at):  # one ends where the other begins
        sigma = [float(np.nanmean(_sigma_m(road, line, known)[1])) for line in lines]
        return hypot(*sigma), 0.5 * hypot(*sigma)
    at = at[:: max(len(at) // 20, 1)]
    shifts, noise = [], np.zeros(len(at))
    for line in lines:
        pixel = road.homography.to_pixel(strip.place(line.offset_m)[at])
        shifts.append(np.einsum("nki,ni->nk", road.homography.fit_shifts(pixel), strip.normal[at]))
        across = np.einsum("nij,ni->nj", road.homography.jacobian(pixel), strip.normal[at])
        noise += PIXEL_SIGMA**2 * np.square(across).sum(axis=1) + np.square(line.sigma_m[at])
    apart, middle = shifts[1] - shifts[0], 0.5 * (shifts[1] + shifts[0])
    of_width = np.square(apart).sum(axis=1) + noise
    of_middle = np.square(middle).sum(axis=1) + 0.25 * noise
    return float(np.sqrt(of_width.mean())), float(np.sqrt(of_middle.mean()))


def _points(station: Array, strip: RoadStrip, offset_m: Array) -> Array:
    """(K, 2) points at stations (K,), at offsets (S,) from the reference line."""
    index = np.arange(len(offset_m))
    known = np.isfinite(offset_m)
    offset = np.interp(station, index[known], offset_m[known])
    columns = [np.interp(station, index, values) for values in (*strip.point_m.T, *strip.normal.T)]
    x, y, normal_x, normal_y = columns
    return np.column_stack((x + offset * normal_x, y + offset * normal_y))
