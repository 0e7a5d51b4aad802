"""Counting stations: lines across the lanes of one direction, and who crosses them when.

A volume is "the number of vehicles that pass a point on a roadway" (FHWA, Traffic Monitoring
Guide), so each vehicle is counted where it crosses one line, in the lane that it is in there: once,
whatever lanes it used before and after, and however its track begins and ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lane_order import SAME_COS, lane_numbers
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project, sample
from geoorbit_ros.traffic.lane_sequence import LaneSequence
from geoorbit_ros.traffic.motion_fit import Motions, fit_motions
from geoorbit_ros.traffic.passages import classes, lengths, place_sigma
from geoorbit_ros.traffic.records import CROSSING_DTYPE
from geoorbit_ros.traffic.vehicle_paths import BIN_NS, Paths

Array = NDArray[np.float64]

BESIDE_M = 18.0
"""Lanes this near, side by side, may have a common station (`core.lane_order.BESIDE_M`)."""
REACH_S = 1.0
"""A vehicle that is first seen this long behind the line, or last seen this long before it, crossed
it all the same. Chosen: trackers need some images to begin a track; longer counts vehicles that
turned off, or whose track is in two parts, twice."""
SPOT_S = 1.5
"""Places up to this long before and after the line give the time and the speed there. Chosen: a
shorter time gives noise, in a longer one speeds change."""
SPOT_ROWS = round(SPOT_S * 1e9 / BIN_NS)
"""At most so many rows either way."""
CLEAR_M = 2.0
"""Who began this far before the line and ended this far behind it has crossed it, however slowly.
Chosen: half a car's length, more than the noise of places."""
SLOWEST_MPS = 0.5
"""A place moves on slower than this by noise alone. Chosen: 2 km/h."""
STEADY_MPS, NEAR_ROWS = 5.0, round(1e9 / BIN_NS)
"""Who is faster in the second before the line and in that after it covers it for the length over
the speed. Slower vehicles may have stopped on it. Chosen: from 18 km/h none stands within a second;
more takes time to look, less misses who stops short."""
FAR_M = 40.0
"""A chosen place is not this far beside a road's lanes. Chosen: one place serves both carriageways
of a motorway."""


@dataclass(frozen=True, slots=True)
class Station:
    """One line across lanes.

    Attributes:
        station_id: From 1.
        lanes: Indices of its lanes in the map.
        arc_m: Where the line is along each of these.
        place_m: (2,) middle of the line, map frame.
        heading_rad: Direction of the traffic there.
    """

    station_id: int
    lanes: tuple[int, ...]
    arc_m: tuple[float, ...]
    place_m: Array
    heading_rad: float


@dataclass(frozen=True, slots=True)
class StationPlace:
    """Where somebody wants the counting stations to be.

    Attributes:
        point_m: (2,) the place beside it, map frame; None: `along_m` says it.
        along_m: Metres along the longest lane of each direction.
    """

    point_m: Array | None = None
    along_m: float = 0.0

    def on(self, lane: Lane) -> float | None:
        """Metres along a lane; None: it isn't beside it."""
        if self.point_m is None:
            return self.along_m if 0.0 <= self.along_m <= lane.length_m else None
        at = project(self.point_m[None], lane.centerline_m)
        beside = bool(at.inside[0]) and abs(float(at.offset_m[0])) < FAR_M
        return float(at.arc_m[0]) if beside else None


def place_stations(lanes: Sequence[Lane], place: StationPlace | None = None) -> tuple[Station, ...]:
    """As few lines as cross every lane once, each in the middle of what its lanes have in common.

    Lanes begin and end where traffic is seen badly; in the middle it is seen best.

    Args:
        lanes: The lanes.
        place: Lines are there where lanes pass it; the other lanes are crossed as without.
    """
    left, stations = list(range(len(lanes))), list[Station]()
    while left:
        base = max(left, key=lambda k: (lanes[k].length_m, -k))
        points = sample(lanes[base].centerline_m, 1.0)
        point_m = points.point_m.copy()
        arc = (np.arange(len(point_m)) + 0.5) * points.piece_m
        wanted = place.on(lanes[base]) if place else None
        if wanted is not None:
            chosen_row = int(np.abs(arc - wanted).argmin())
            arc[chosen_row], point_m[chosen_row] = wanted, _point(lanes[base], wanted)
        crossed = np.zeros((len(left), len(arc)), np.bool_)
        at = np.zeros((len(left), len(arc)))
        for row, k in enumerate(left):
            found = project(point_m, lanes[k].centerline_m)
            along = (points.tangent * found.tangent).sum(axis=1)
            near = np.abs(found.offset_m) < BESIDE_M
            crossed[row], at[row] = found.inside & near & (along > SAME_COS), found.arc_m
        crossed[left.index(base)] = True
        at[left.index(base)] = arc
        middle = _middle_of_most(crossed.sum(axis=0)) if wanted is None else chosen_row
        chosen = [row for row in range(len(left)) if crossed[row, middle]]
        stations.append(
            Station(
                len(stations) + 1,
                tuple(left[row] for row in chosen),
                tuple(float(at[row, middle]) for row in chosen),
                np.mean([_point(lanes[left[row]], at[row, middle]) for row in chosen], axis=0),
                float(np.arctan2(points.tangent[middle, 1], points.tangent[middle, 0])),
            )
        )
        left = [k for row, k in enumerate(left) if row not in chosen]
    return tuple(stations)


@dataclass(frozen=True, slots=True)
class MeasuredLanes:
    """The lanes in the order of the tables.

    Attributes:
        lane_id: (L,) ids.
        number: (L,) numbers from the outer edge of the road.
        length_m: (L,) lengths.
        station: (L,) id of the station that crosses each.
    """

    lane_id: NDArray[np.int64]
    number: NDArray[np.int64]
    length_m: Array
    station: NDArray[np.int64]


def measured_lanes(lanes: Sequence[Lane], stations: Sequence[Station]) -> MeasuredLanes:
    """Lanes ordered by station and number."""
    numbers = lane_numbers(lanes)
    rows = sorted(
        (station.station_id, numbers[lanes[k].lane_id], lanes[k].lane_id, lanes[k].length_m)
        for station in stations
        for k in station.lanes
    )
    station_id, number, lane_id, length = zip(*rows, strict=True)
    return MeasuredLanes(
        np.array(lane_id), np.array(number), np.array(length), np.array(station_id)
    )


def _middle_of_most(count: NDArray[np.int64]) -> int:
    """Middle of the longest stretch on which the count is greatest."""
    most = np.append(np.append(0, count == count.max()), 0)
    begin = np.flatnonzero(np.diff(most) == 1)
    end = np.flatnonzero(np.diff(most) == -1)
    k = int((end - begin).argmax())
    return int((begin[k] + end[k] - 1) // 2)


def _point(lane: Lane, arc_m: float) -> Array:
    step = np.hypot(*np.diff(lane.centerline_m, axis=0).T)
    arc = np.append(0.0, np.cumsum(step))
    return np.array([np.interp(arc_m, arc, lane.centerline_m[:, k]) for k in (0, 1)])


def find_crossings(
    paths: Paths, found: LaneSequence, stations: Sequence[Station]
) -> NDArray[np.void]:
    """Who crossed which station, ordered by vehicle, then by station.

    Args:
        paths: Whole paths.
        found: Their lanes.
        stations: The lines.

    Returns:
        (C,) `CROSSING_DTYPE`, with numbers of paths and lanes from 0 in place of ids, and speed
        errors without that of the calibration.
    """
    tables = [_crossings_of(paths, found, station) for station in stations]
    table = np.concatenate([np.empty(0, CROSSING_DTYPE), *tables])
    return table[np.lexsort((table["station_id"], table["vehicle_id"]))]


def _crossings_of(paths: Paths, found: LaneSequence, station: Station) -> NDArray[np.void]:
    line = np.full(found.places.arc_m.shape[1] + 1, np.nan)  # the last one is that of no lane
    line[list(station.lanes)] = station.arc_m
    rows = np.flatnonzero(~np.isnan(line[found.lane]))
    lane, owner = found.lane[rows], paths.owner[rows]
    beyond = found.places.arc_m[rows, lane] - line[lane]
    time_s = (paths.rows["stamp_ns"][rows] - paths.rows["stamp_ns"][paths.offset[owner]]) * 1e-9
    at = _nearest_rows(owner, beyond)
    when, fit = _spot(at, owner, time_s, beyond, place_sigma(paths)[rows])
    speed = fit.speed_at(np.where(np.isfinite(when), when - time_s[at], 0.0))
    earlier = np.maximum(at - 1, 0)
    between = (owner[earlier] == owner[at]) & (beyond[earlier] < 0.0) & (beyond[at] >= 0.0)
    between &= (when >= time_s[earlier] - REACH_S) & (when <= time_s[at] + REACH_S)
    slow = speed <= SLOWEST_MPS
    passed = _passed(owner, beyond) if len(owner) else np.zeros(0, np.bool_)
    when = np.where(slow & passed, time_s[at], when)  # it crept over the line
    speed = np.maximum(speed, 0.0)
    crossed = (~slow | passed) & (between | (np.abs(time_s[at] - when) <= REACH_S))
    at, when, speed = at[crossed], when[crossed], speed[crossed]
    vehicle = owner[at]
    out = np.zeros(len(at), CROSSING_DTYPE)
    out["vehicle_id"], out["lane_id"] = vehicle, lane[at]
    out["track_id"] = paths.rows["track_id"][paths.offset[vehicle]]
    out["station_id"] = station.station_id
    out["class_id"], out["length_m"] = classes(paths)[vehicle], lengths(paths)[vehicle]
    begin_ns = paths.rows["stamp_ns"][paths.offset[vehicle]]
    out["stamp_ns"] = begin_ns + np.round(when * 1e9).astype(np.int64)
    out["speed_mps"], out["speed_sigma_mps"] = speed, fit.noise_mps[crossed]
    out["offset_m"] = found.places.offset_m[rows, lane][at]
    first_s, last_s = _on_line(owner, time_s, beyond, at, when, out)
    out["front_ns"] = begin_ns + np.round(first_s * 1e9).astype(np.int64)
    out["rear_ns"] = begin_ns + np.round(last_s * 1e9).astype(np.int64)
    return out


def _on_line(
    owner: NDArray[np.int64],
    time_s: Array,
    beyond: Array,
    at: NDArray[np.int64],
    when: Array,
    crossings: NDArray[np.void],
) -> tuple[Array, Array]:
    """When each vehicle's front came to the line, and when its rear left it.

    Args:
        owner: (N,) vehicle of each row.
        time_s: (N,) time of each row.
        beyond: (N,) how far behind the line it was.
        at: (C,) the row behind the line of each crossing.
        when: (C,) time of each crossing.
        crossings: (C,) `CROSSING_DTYPE`, with speeds and lengths.
    """
    half = np.nan_to_num(crossings["length_m"] / 2.0)
    half_s = half / np.maximum(crossings["speed_mps"], STEADY_MPS)
    first, last = when - half_s, when + half_s
    slow = np.zeros(len(at), np.bool_)
    for step in (-NEAR_ROWS, NEAR_ROWS):
        # A row beyond the table is another vehicle's, whoever else is in the table.
        inside = (at + step >= 0) & (at + step < len(owner))
        other = np.where(inside, at + step, at)
        way, spent_s = np.abs(beyond[other] - beyond[at]), np.abs(time_s[other] - time_s[at])
        slow |= inside & (owner[other] == owner[at]) & (way < STEADY_MPS * spent_s)
    for k in np.flatnonzero(slow & (half > 0.0)).tolist():
        row = int(at[k])
        begin, end = np.searchsorted(owner, (owner[row], owner[row] + 1)).tolist()
        step_s = np.diff(time_s[begin:end], append=time_s[end - 1])
        # A sum, as the noise of a vehicle that stands beside the line puts some places on it.
        over_s = np.where(np.abs(beyond[begin:end]) <= half[k], step_s, 0.0)
        first[k] = min(first[k], when[k] - over_s[: row - begin].sum())
        last[k] = max(last[k], when[k] + over_s[row - begin :].sum())
    # Nobody is on the line before anybody saw it: live, earlier intervals are finished by then.
    return np.maximum(first, np.minimum(when, 0.0)), last


def _nearest_rows(owner: NDArray[np.int64], beyond: Array) -> NDArray[np.int64]:
    """(V,) of each vehicle the row behind its last change to the far side, or the nearest row.

    The last one, because the noise of a vehicle that waits on the line changes sides, too.
    """
    if not len(owner):
        return np.empty(0, np.int64)
    begin = np.flatnonzero(np.diff(owner, prepend=-1))
    behind = beyond >= 0.0
    steps = np.zeros(len(owner), np.bool_)
    steps[1:] = behind[1:] & ~behind[:-1]
    steps[begin] = False
    last = np.maximum.reduceat(np.where(steps, np.arange(len(owner)), -1), begin)
    end = np.append(begin[1:], len(owner))
    nearest = np.where(behind[begin], begin, end - 1)
    return np.where(last >= 0, last, nearest)


def _passed(owner: NDArray[np.int64], beyond: Array) -> NDArray[np.bool_]:
    """(V,) whether each vehicle began well before the line and ended well behind it."""
    begin = np.flatnonzero(np.diff(owner, prepend=-1))
    end = np.append(begin[1:], len(owner)) - 1
    return np.asarray((beyond[begin] < -CLEAR_M) & (beyond[end] > CLEAR_M))


def _spot(
    at: NDArray[np.int64], owner: NDArray[np.int64], time_s: Array, beyond: Array, sigma: Array
) -> tuple[Array, Motions]:
    """When each vehicle crossed the line, and its motion there in time since row `at`."""
    reach = at[:, None] + np.arange(-SPOT_ROWS, SPOT_ROWS)
    inside = (reach >= 0) & (reach < len(owner))
    reach = np.clip(reach, 0, max(len(owner) - 1, 0))
    inside &= owner[reach] == owner[at][:, None]
    side = np.arange(-SPOT_ROWS, SPOT_ROWS) < 0
    edge = np.where(side, np.maximum(at - 1, 0)[:, None], at[:, None])  # of a gap on the line
    inside &= np.abs(time_s[reach] - time_s[edge]) <= SPOT_S
    group = np.repeat(np.arange(len(at)), inside.sum(axis=1))
    rows = reach[inside]
    fit = fit_motions(group, len(at), time_s[rows] - time_s[at][group], beyond[rows], sigma[rows])
    return fit.crossing_s() + time_s[at], fit
