"""From ground tracks to passages and crossings, on one lane map, as data comes in."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.plane import RoadPlane
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import MOTORCYCLE, Frames
from geoorbit_ros.traffic.class_schemes import BICYCLE, MOVING_CLASSES
from geoorbit_ros.traffic.lane_sequence import LaneMatcher, cut_at_oncoming
from geoorbit_ros.traffic.motion_fit import VEHICLE_SCALE
from geoorbit_ros.traffic.passages import classes, find_passages, find_pieces, find_runs
from geoorbit_ros.traffic.records import CROSSING_DTYPE, NO_LANE, PASSAGE_DTYPE, PIECE_DTYPE
from geoorbit_ros.traffic.road_coordinates import RoadCoordinates
from geoorbit_ros.traffic.stations import StationPlace, find_crossings, place_stations
from geoorbit_ros.traffic.vehicle_paths import PathCollector, Paths

Array = NDArray[np.float64]

LENGTH_SHARE, GAP_S = 0.8, 0.1
"""Two vehicles that cross a line nearer to one another than 0.8 of their mean length and what they
drive in 0.1 s are one with two ids. Chosen: lengths are known within a fifth, and no driver keeps
a tenth of a second; more takes a queue's close followers for one."""
NARROW_CLASSES = (BICYCLE, MOTORCYCLE)
"""Riders share a lane side by side."""
RIDER_M = 2.0
"""Length of a rider of whom none is known."""
RIDER_APART_M = 0.8
"""Riders side by side are farther apart, from middle to middle. Chosen: the width of handlebars;
more takes two who ride together for one, less takes one with two ids for two."""
CAR_LENGTH_M = 4.5
"""Length of a vehicle of which none is known. Chosen: a car's."""
FORGET_NS = 20_000_000_000
"""Crossings so long before another are no hindrance to it. Chosen: in this time the slowest vehicle
that counts has moved on by a lorry's half."""
KEPT_NS = 600_000_000_000
"""Crossings are remembered for so long: vehicles are counted when they are gone, so that those of a
queue come later than who passed it."""


@dataclass(frozen=True, slots=True)
class Counted:
    """Vehicles that are gone, in the order in which they were last seen.

    Attributes:
        passages: (P,) `PASSAGE_DTYPE`.
        crossings: (C,) `CROSSING_DTYPE`.
        pieces: (Q,) `PIECE_DTYPE`.
        vehicles: How many vehicles these are, those in no lane included.
        in_no_lane: How many of them drove along no lane.
    """

    passages: NDArray[np.void]
    crossings: NDArray[np.void]
    pieces: NDArray[np.void]
    vehicles: int
    in_no_lane: int


def nobody() -> Counted:
    """No vehicle."""
    passages, crossings = np.empty(0, PASSAGE_DTYPE), np.empty(0, CROSSING_DTYPE)
    return Counted(passages, crossings, np.empty(0, PIECE_DTYPE), 0, 0)


class TrafficCounter:
    """Counts vehicles in the lanes of one map.

    The map may be replaced (`use_lanes`); vehicles that are still in view are then counted on the
    new one.

    Args:
        lanes: The lanes, in the tracks' frame; at least one.
        plane: The calibration, for the error that is common to all speeds; None: it is exact.
        place: Where the counting stations are; None: where traffic is seen best.

    Attributes:
        vehicles: Vehicles so far that are gone.
    """

    def __init__(
        self,
        lanes: Sequence[Lane],
        plane: RoadPlane | None = None,
        place: StationPlace | None = None,
    ) -> None:
        self._plane, self._place = plane, place
        self._paths = PathCollector()
        self._places = _OccupiedPlaces()
        self.vehicles = 0
        self.use_lanes(lanes)

    def use_lanes(self, lanes: Sequence[Lane]) -> None:
        """Count on these lanes from now on."""
        roads = RoadCoordinates(lanes)
        self.lanes = roads.lanes
        self._matcher = LaneMatcher(roads)
        self._lane_id = np.array([*(lane.lane_id for lane in lanes), NO_LANE], np.int64)
        self.stations = place_stations(lanes, self._place)
        self._scale_sigma = np.array([scale_sigma(lane, self._plane) for lane in lanes])

    def add(self, frames: Frames) -> None:
        """Take frames of `TRACK_DTYPE`, later than those before."""
        self._paths.add(frames)

    def take(self) -> Counted:
        """Vehicles that have gone since the last call."""
        return self._count(self._paths.take())

    @property
    def open_since_ns(self) -> int | None:
        """When the first of the vehicles was first seen that may still be in view; None: none."""
        return self._paths.open_since_ns

    def finish(self) -> Counted:
        """All vehicles that are left."""
        return self._count(self._paths.finish())

    def _count(self, paths: Paths) -> Counted:
        if not len(paths):
            return nobody()
        found = self._matcher.lanes_of(paths)
        paths = cut_at_oncoming(paths, found)
        moving = np.isin(classes(paths), MOVING_CLASSES)
        runs = find_runs(paths, found)
        tables = (
            find_passages(paths, found, runs),
            find_crossings(paths, found, self.stations),
            find_pieces(paths, found, runs),
        )
        passages, crossings, pieces = (
            self._named(table[moving[table["vehicle_id"]]]) for table in tables
        )
        first_ns, last_ns = self._paths.observed_ns
        inside = (crossings["stamp_ns"] >= first_ns) & (crossings["stamp_ns"] <= last_ns)
        crossings = crossings[inside]
        twice = self._places.seen_before(crossings)
        crossings = crossings[~np.isin(crossings["vehicle_id"], twice)]
        passages = passages[~np.isin(passages["vehicle_id"], twice)]
        pieces = pieces[~np.isin(pieces["vehicle_id"], twice)]
        self.vehicles += len(paths)
        seen = int(np.count_nonzero(moving)) - len(twice)
        missing = seen - len(np.unique(passages["vehicle_id"]))
        return Counted(passages, crossings, pieces, seen, missing)

    def _named(self, table: NDArray[np.void]) -> NDArray[np.void]:
        """Give vehicles and lanes their ids, and speeds the errors that places don't show."""
        if "speed_sigma_mps" in (table.dtype.names or ()):
            scale = np.hypot(self._scale_sigma[table["lane_id"]], VEHICLE_SCALE)
            sigma = np.hypot(table["speed_sigma_mps"], scale * table["speed_mps"])
            table["speed_sigma_mps"] = sigma
        if "speed_scale_sigma" in (table.dtype.names or ()):
            table["speed_scale_sigma"] = self._scale_sigma[table["lane_id"]]
        table["vehicle_id"] += self.vehicles + 1
        for name in {"lane_id", "from_lane", "to_lane"}.intersection(table.dtype.names or ()):
            table[name] = self._lane_id[table[name]]
        return table


_Crossed = tuple[int, float, float, float]
"""When a vehicle crossed a line, in nanoseconds, its speed in m/s, its length in metres, and how
far left of the lane's middle it was."""


class _OccupiedPlaces:
    """Where and when vehicles crossed the stations of late: no other can have been there."""

    def __init__(self) -> None:
        # By lane and whether they ride, in the order of time.
        self._crossed: dict[tuple[int, bool], list[_Crossed]] = {}

    def seen_before(self, crossings: NDArray[np.void]) -> NDArray[np.int64]:
        """Ids of vehicles that are a second track of one that was counted already.

        Two bodies in one place are one vehicle with two ids. Of these the one that is gone first
        counts.
        """
        twice = list[int]()
        names = ("stamp_ns", "speed_mps", "length_m", "offset_m")
        columns = [crossings[name].tolist() for name in ("vehicle_id", "lane_id", "class_id")]
        rows = zip(*columns, *(crossings[name].tolist() for name in names), strict=True)
        for vehicle_id, lane_id, class_id, at_ns, speed, length_m, left_m in rows:
            rides = class_id in NARROW_CLASSES
            if not math.isfinite(length_m):
                length_m = RIDER_M if rides else CAR_LENGTH_M
            lane = self._crossed.setdefault((lane_id, rides), [])
            del lane[: bisect_left(lane, (at_ns - KEPT_NS + 1,))]
            near = lane[
                bisect_left(lane, (at_ns - FORGET_NS + 1,)) : bisect_left(
                    lane, (at_ns + FORGET_NS,)
                )
            ]
            if rides:
                near = [other for other in near if abs(other[3] - left_m) < RIDER_APART_M]
            crossed = at_ns, speed, length_m, left_m
            if _overlaps(crossed, near):
                twice.append(vehicle_id)
            else:
                insort(lane, crossed)
        return np.unique(np.array(twice, np.int64))


def _overlaps(crossed: _Crossed, others: list[_Crossed]) -> bool:
    """Whether at one line a vehicle would be in one place with another."""
    at_ns, own_speed, own_m, _ = crossed
    for other_ns, other_speed, other_m, _ in others:
        # The faster of the two speeds: who starts at a signal crosses the line slowly, and is gone
        # by the time that the next one comes.
        speed = own_speed if own_speed > other_speed else other_speed
        distance_m = (abs(at_ns - other_ns) * 1e-9 - GAP_S) * speed
        if distance_m < LENGTH_SHARE * (own_m + other_m) / 2:
            return True
    return False


def scale_sigma(lane: Lane, plane: RoadPlane | None) -> float:
    """1-sigma relative error of a lane's length: what the control points' errors leave."""
    if plane is None:
        return 0.0
    ends = plane.to_pixel(lane.centerline_m[[0, -1]])
    if not np.isfinite(ends).all():
        return 0.0
    shift = plane.fit_shifts(ends)
    way = lane.centerline_m[-1] - lane.centerline_m[0]
    length = float(np.hypot(*way))
    return float(np.linalg.norm((shift[1] - shift[0]) @ (way / length)) / length)
