"""From counted vehicles to ways through a network: which edges, in which lanes, what vehicles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.mapcheck.lane_edges import LaneEdges
from geoorbit_ros.roadnet.network import NO_LANE
from geoorbit_ros.roadnet.routing import RouteFinder
from geoorbit_ros.traffic.stations import Station
from geoorbit_ros.twin.vehicles import type_of_class


class Way(NamedTuple):
    """What vehicles that drove alike have in common.

    Attributes:
        edges: Edges of the network, in travel order.
        lane: The network's lane in which they begin.
        counted: The network's lanes in which they crossed counting stations.
        kind: Their type, a number in `TYPES`.
    """

    edges: tuple[str, ...]
    lane: int
    counted: tuple[int, ...]
    kind: int


@dataclass(frozen=True, slots=True)
class CountedVehicles:
    """Every vehicle that crossed a counting station, once.

    Attributes:
        ways: The W ways that occur, ordered.
        way: (V,) number of each vehicle's way.
        stamp_ns: (V,) when it crossed its first station, increasing.
        speed_mps: (V,) how fast it was there.
        limit_mps: (V,) the speed limit there.
        beside_map: How many vehicles were counted in lanes that the network lacks.
    """

    ways: tuple[Way, ...]
    way: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    speed_mps: NDArray[np.float64]
    limit_mps: NDArray[np.float64]
    beside_map: int

    def __len__(self) -> int:
        return len(self.way)


@dataclass(frozen=True, slots=True)
class Detector:
    """Where a counting station crosses a lane.

    Attributes:
        lane_id: Of the camera's lane.
        station_id: The station.
        lane: The network's lane.
        position_m: Along the network's lane.
    """

    lane_id: int
    station_id: int
    lane: int
    position_m: float


def place_detectors(
    lanes: Sequence[Lane], stations: Sequence[Station], edges: LaneEdges
) -> tuple[Detector, ...]:
    """The places at which vehicles are counted, in the network; lanes that it lacks have none."""
    found = []
    for station in stations:
        for k, arc_m in zip(station.lanes, station.arc_m, strict=True):
            lane = edges.lane_at(lanes[k].lane_id, arc_m)
            if lane != NO_LANE:
                line = lanes[k].centerline_m
                arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
                place = np.array([np.interp(arc_m, arc, line[:, axis]) for axis in (0, 1)])
                position_m = edges.network.place_on(lane, place)
                found.append(Detector(lanes[k].lane_id, station.station_id, lane, position_m))
    return tuple(found)


def find_ways(
    passages: NDArray[np.void],
    crossings: NDArray[np.void],
    detectors: Sequence[Detector],
    edges: LaneEdges,
) -> CountedVehicles:
    """The ways of all vehicles that were counted.

    A vehicle's way begins where its first lane begins and ends where its last lane ends, as its
    movement does (`traffic.movements`), and goes on in view where the road leads nowhere else.

    Args:
        passages: (P,) `records.PASSAGE_DTYPE`, ordered by vehicle and time.
        crossings: (C,) `records.CROSSING_DTYPE`, ordered by vehicle.
        detectors: See `place_detectors`.
        edges: The lanes on the network.
    """
    at = {(d.lane_id, d.station_id): d.lane for d in detectors}
    draw, rows, beside = _WayFinder(edges), list[tuple[Way, int, float, float]](), 0
    driven, edge_of = dict(_by_vehicle(passages)), edges.network.edge_id
    for vehicle, crossed in _by_vehicle(crossings):
        crossed = crossed[np.argsort(crossed["stamp_ns"], kind="stable")]
        lanes = [at.get((int(r["lane_id"]), int(r["station_id"])), NO_LANE) for r in crossed]
        known = [k for k, lane in enumerate(lanes) if lane != NO_LANE]
        if not known:
            beside += 1
            continue
        seen = driven.get(vehicle, passages[:0])
        while known:
            route, begin = draw.way(seen, tuple(lanes[k] for k in known))
            here = [k for k in known if edge_of[lanes[k]] in route]
            first = crossed[here[0]]
            kind = int(type_of_class(first["class_id"][None])[0])
            way = Way(route, begin, tuple(lanes[k] for k in here), kind)
            limit = float(edges.network.speed_mps[way.counted[0]])
            rows.append((way, int(first["stamp_ns"]), float(first["speed_mps"]), limit))
            # Where no route leads from one station to the next, the track went to another vehicle.
            known, seen = [k for k in known if k not in here], passages[:0]
    rows.sort(key=lambda row: row[1])
    ways = sorted({row[0] for row in rows})
    number = {way: k for k, way in enumerate(ways)}
    return CountedVehicles(
        tuple(ways),
        np.array([number[row[0]] for row in rows], np.int64),
        np.array([row[1] for row in rows], np.int64),
        np.array([row[2] for row in rows], np.float64),
        np.array([row[3] for row in rows], np.float64),
        beside,
    )


def _by_vehicle(table: NDArray[np.void]) -> Iterator[tuple[int, NDArray[np.void]]]:
    table = table[np.argsort(table["vehicle_id"], kind="stable")]
    begin = np.flatnonzero(np.diff(table["vehicle_id"], prepend=-1)).tolist()
    for a, b in zip(begin, [*begin[1:], len(table)], strict=True):
        yield int(table["vehicle_id"][a]), table[a:b]


class _WayFinder:
    """Joins the lanes of a vehicle to a route that the network has."""

    def __init__(self, edges: LaneEdges) -> None:
        self._edges, self._finder = edges, RouteFinder(edges.network)
        self._routes: dict[tuple[str, ...], tuple[str, ...] | None] = {}

    def way(
        self, driven: NDArray[np.void], counted: tuple[int, ...]
    ) -> tuple[tuple[str, ...], int]:
        """Edges of a vehicle's way, and the network's lane in which it begins.

        Args:
            driven: Its `PASSAGE_DTYPE` rows, in time order.
            counted: The network's lanes in which it was counted, at least one.
        """
        lanes = list[int]()
        for k, row in enumerate(driven):
            begin_m = 0.0 if k == 0 else float(row["first_arc_m"])
            end_m = np.inf if k == len(driven) - 1 else float(row["last_arc_m"])
            lanes += self._edges.lanes_between(int(row["lane_id"]), begin_m, end_m)
        edge_of = self._edges.network.edge_id
        here = [edge_of[lane] for lane in counted]
        tries = (lanes, list(counted), [counted[0]])
        for chosen in (*(self._extended(lanes) for lanes in tries), [counted[0]]):
            route = self._route(tuple(dict.fromkeys(edge_of[lane] for lane in chosen)))
            if route is not None and here[0] in route:
                begin = next(lane for lane in chosen if edge_of[lane] == route[0])
                return route, self._traced_back(route, counted[0], begin)
        raise AssertionError("a single edge is a route")

    def _traced_back(self, route: tuple[str, ...], counted: int, other: int) -> int:
        """The lane of a route's first edge that leads to the lane in which a vehicle was counted.

        Where lanes are seen best, at the stations, it is surest which one a vehicle is in; `other`
        is the one where it was first seen, for vehicles that must have changed lanes.
        """
        network, lane = self._edges.network, counted
        for edge in reversed(route[: route.index(network.edge_id[counted])]):
            before = [k for k in self._edges.before(lane) if network.edge_id[k] == edge]
            if not before:
                return other
            lane = before[0]
        return lane

    def _extended(self, lanes: list[int]) -> list[int]:
        """With the lanes before and after that are in view and can't be missed."""
        lanes = lanes[:]
        while lanes and (after := self._edges.onward(lanes[-1])) not in (NO_LANE, *lanes):
            lanes.append(after)
        while lanes and (before := self._edges.backward(lanes[0])) not in (NO_LANE, *lanes):
            lanes.insert(0, before)
        return lanes

    def _route(self, edges: tuple[str, ...]) -> tuple[str, ...] | None:
        if edges not in self._routes:
            found = self._finder.complete(list(edges)) if edges else None
            self._routes[edges] = None if found is None else tuple(found)
        return self._routes[edges]
