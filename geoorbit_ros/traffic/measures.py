"""Measures of traffic per interval, lane and class of vehicles.

Definitions: Highway Capacity Manual, 7th edition, chapter 4; FHWA Traffic Monitoring Guide; L. C.
Edie 1963, "Discussion of traffic stream measurements and definitions". docs/traffic.md has them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.traffic.class_schemes import ClassScheme
from geoorbit_ros.traffic.interval_clock import NS, ObservedTime
from geoorbit_ros.traffic.records import NO_LANE
from geoorbit_ros.traffic.stations import MeasuredLanes

Array = NDArray[np.float64]

ALL = "all"
"""The class of a row for vehicles of any class."""
FOLLOWING_S = 2.5
"""A vehicle with a shorter headway follows the one before it (HCM, 7th edition, chapter 15)."""
COUNT_SIGMA = 0.01
"""1-sigma relative error of a count by vehicles that are missed or seen twice. Measured: mean
absolute error of lanes' five-minute counts in the shipped scenes (docs/results.md)."""
LONGEST_HEADWAY_S = 1800.0
"""Vehicles farther apart have no headway. Chosen: with less than two vehicles an hour nothing is
said about headways; that makes every interval depend on the half hour before it alone, so that a
counter which was started again says the same."""
LEAST_WATCHED, ENOUGH_S = 0.02, 60.0
"""Of an interval that was watched for a smaller share, and for less than a minute, no flow is said.
Chosen: flows from a few seconds are those of single vehicles."""
PER_TIME = (
    "flow_veh_per_h",
    "flow_sigma_veh_per_h",
    "density_veh_per_km",
    "occupancy_percent",
)
"""Measures that depend on how long was watched."""

MEASURE_DTYPE = np.dtype(
    [
        ("start_ns", "<i8"),
        ("end_ns", "<i8"),
        ("observed", "<f8"),
        ("station_id", "<i4"),
        ("lane_id", "<i8"),
        ("lane_number", "<i4"),
        ("category", "<i4"),
        ("volume", "<i8"),
        ("volume_sigma", "<f8"),
        ("flow_veh_per_h", "<f8"),
        ("flow_sigma_veh_per_h", "<f8"),
        ("time_mean_speed_kmh", "<f8"),
        ("time_mean_speed_sigma_kmh", "<f8"),
        ("space_mean_speed_kmh", "<f8"),
        ("speed_p85_kmh", "<f8"),
        ("density_veh_per_km", "<f8"),
        ("occupancy_percent", "<f8"),
        ("headway_mean_s", "<f8"),
        ("gap_mean_s", "<f8"),
        ("platoon_share", "<f8"),
        ("lane_share", "<f8"),
        ("lane_changes_in", "<i8"),
        ("lane_changes_out", "<i8"),
        ("heavy_share", "<f8"),
    ]
)
"""One row per interval, lane and category. `lane_id` 0 stands for all lanes of the station, and
`category` -1 for all classes. What is not known is NaN: a speed without a vehicle, everything but
the count of an interval that was not watched."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """What all measures are made of.

    Attributes:
        passages: (P,) `records.PASSAGE_DTYPE`.
        crossings: (C,) `records.CROSSING_DTYPE`.
        pieces: (Q,) `records.PIECE_DTYPE`.
        observed: When the camera watched.
        lanes: The lanes.
        scheme: Classes.
    """

    passages: NDArray[np.void]
    crossings: NDArray[np.void]
    pieces: NDArray[np.void]
    observed: ObservedTime
    lanes: MeasuredLanes
    scheme: ClassScheme


def measure(traffic: Traffic, edges_ns: NDArray[np.int64]) -> NDArray[np.void]:
    """All measures of the K intervals between edges (K + 1,).

    Returns:
        (M,) `MEASURE_DTYPE`: for each interval each lane and then all lanes of its station, first
        for all classes and then for each of which a vehicle was there.
    """
    groups = _Groups(traffic, edges_ns)
    out = np.zeros(groups.shape, MEASURE_DTYPE)
    groups.describe(out, edges_ns)
    groups.volumes(out)
    groups.speeds(out)
    groups.headways(out)
    groups.uses(out)
    unwatched = out["observed"] < LEAST_WATCHED
    unwatched &= groups.watched_s[:, None, None] < ENOUGH_S
    for name in PER_TIME:
        out[name][unwatched] = np.nan
    there = (out["volume"] > 0) | (out["density_veh_per_km"] > 0.0)
    there[:, :, 0] = True
    return out[there]


class _Groups:
    """Sums over intervals (K), lanes and totals (R), classes (1 + C), as arrays of that shape."""

    def __init__(self, traffic: Traffic, edges: NDArray[np.int64]) -> None:
        self.traffic, self.edges = traffic, edges
        lanes, scheme = traffic.lanes, traffic.scheme
        crossings = traffic.crossings
        category = scheme.category_of(crossings["class_id"], crossings["length_m"])
        self.stations = np.unique(lanes.station)
        self.row_lane, self.row_station, self.row_number = self._table_rows()
        self.shape = (len(edges) - 1, len(self.row_lane), 1 + len(scheme.categories))
        self.watched_s = traffic.observed.seconds(edges)
        self.length_s = np.diff(edges) / NS
        self.crossing = self._index(crossings["stamp_ns"], crossings["lane_id"], category)

    def _table_rows(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Lane id, station id and lane number of each row of an interval's table."""
        lanes, rows = self.traffic.lanes, list[tuple[int, int, int]]()
        for station in self.stations.tolist():
            here = np.flatnonzero(lanes.station == station).tolist()
            rows.extend((int(lanes.lane_id[k]), station, int(lanes.number[k])) for k in here)
            rows.append((NO_LANE, station, 0))
        table: NDArray[np.int64] = np.array(rows, np.int64)
        return table[:, 0], table[:, 1], table[:, 2]

    def _index(
        self, stamp_ns: NDArray[np.int64], lane_id: NDArray[np.int64], category: NDArray[np.int64]
    ) -> _Index:
        """Where each vehicle belongs."""
        interval = np.searchsorted(self.edges, stamp_ns, side="right") - 1
        row_of = {int(lane): k for k, lane in enumerate(self.row_lane) if lane != NO_LANE}
        total_of = {int(self.row_station[k]): k for k in np.flatnonzero(self.row_lane == NO_LANE)}
        row = np.array([row_of.get(int(lane), -1) for lane in lane_id.tolist()], np.int64)
        total = np.array([total_of[int(s)] for s in self.row_station[row].tolist()], np.int64)
        slot = category + 1
        kept = (interval >= 0) & (interval < self.shape[0]) & (row >= 0)
        return _Index(kept, interval[kept], row[kept], total[kept], slot[kept])

    def sums(self, index: _Index, value: Array | None = None) -> Array:
        """Sum of values (or count) in each cell: lane and station, class and all classes."""
        out = np.zeros(self.shape)
        flat = out.reshape(-1)
        weight = None if value is None else value[index.kept]
        for row in (index.row, index.total):
            for slot in (index.slot, np.zeros_like(index.slot)):
                cell = np.ravel_multi_index((index.interval, row, slot), self.shape)
                flat += np.bincount(cell, weight, flat.size)
        return out

    def describe(self, out: NDArray[np.void], edges: NDArray[np.int64]) -> None:
        """Which interval, lane and class a row is of."""
        out["start_ns"], out["end_ns"] = edges[:-1, None, None], edges[1:, None, None]
        out["observed"] = np.minimum(self.watched_s / self.length_s, 1.0)[:, None, None]
        out["station_id"] = self.row_station[None, :, None]
        out["lane_id"], out["lane_number"] = (
            self.row_lane[None, :, None],
            self.row_number[None, :, None],
        )
        out["category"] = np.arange(-1, self.shape[2] - 1)

    def volumes(self, out: NDArray[np.void]) -> None:
        """Counts, flows, shares."""
        crossings, scheme = self.traffic.crossings, self.traffic.scheme
        count = self.sums(self.crossing)
        out["volume"] = count
        unsure = self.sums(self._unsure())
        out["volume_sigma"] = np.hypot(0.5 * np.sqrt(unsure), COUNT_SIGMA * count)
        with np.errstate(divide="ignore", invalid="ignore"):
            per_hour = 3600.0 / self.watched_s[:, None, None]
            out["flow_veh_per_h"] = count * per_hour
            out["flow_sigma_veh_per_h"] = out["volume_sigma"] * per_hour
            total = self._of_station(count)
            out["lane_share"] = count / total
            category = scheme.category_of(crossings["class_id"], crossings["length_m"])
            heavy = scheme.is_heavy[category].astype(np.float64)
            is_known = (category < len(scheme.categories) - 1).astype(np.float64)
            known = self.sums(self.crossing, is_known)
            out["heavy_share"] = self.sums(self.crossing, heavy) / known

    def _unsure(self) -> _Index:
        """Vehicles that were seen in a lane but didn't cross its station: some were lost."""
        passages, crossings = self.traffic.passages, self.traffic.crossings
        missing = ~np.isin(passages["vehicle_id"], crossings["vehicle_id"])
        rows = passages[missing]
        category = self.traffic.scheme.category_of(rows["class_id"], rows["length_m"])
        middle = (rows["first_ns"] + rows["last_ns"]) // 2
        return self._index(middle, rows["lane_id"], category)

    def _of_station(self, count: Array) -> Array:
        """The count of all lanes of each row's station, of the same class."""
        totals = np.flatnonzero(self.row_lane == NO_LANE)
        where = np.array([totals[self.row_station[totals] == s][0] for s in self.row_station])
        return count[:, where, :]

    def speeds(self, out: NDArray[np.void]) -> None:
        """Time mean speed with its error, 85th percentile, occupancy."""
        rows = self.traffic.crossings
        count = self.sums(self.crossing)
        speed = rows["speed_mps"]
        scale = rows["speed_scale_sigma"] * speed
        noise = np.maximum(rows["speed_sigma_mps"] ** 2 - scale**2, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            out["time_mean_speed_kmh"] = 3.6 * self.sums(self.crossing, speed) / count
            single = np.sqrt(self.sums(self.crossing, noise)) / count
            common = self.sums(self.crossing, scale) / count
            out["time_mean_speed_sigma_kmh"] = 3.6 * np.hypot(single, common)
        out["speed_p85_kmh"] = 3.6 * self._quantile(speed, 0.85)
        out["occupancy_percent"] = self._occupancy(count)

    def _occupancy(self, count: Array) -> Array:
        """Share of the time in which a vehicle is on the line, in percent."""
        rows = self.traffic.crossings
        category = self.traffic.scheme.category_of(rows["class_id"], rows["length_m"])
        has_length = np.isfinite(rows["length_m"])
        known = self.sums(self.crossing, has_length.astype(np.float64))
        of, begin, over_s = self._spread(rows["front_ns"], rows["rear_ns"])
        index = self._index(begin, rows["lane_id"][of], category[of])
        over = self.sums(index, np.where(has_length[of], over_s, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            # Vehicles of unknown length count like the others.
            over = over * np.where(count > 0.0, count / known, 1.0)
            share = 100.0 * over / self.watched_s[:, None, None]
            return np.minimum(share / self._lanes_of_row()[None, :, None], 100.0)

    def _spread(
        self, first_ns: NDArray[np.int64], last_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Times of N vehicles in the intervals that they touch.

        A row per vehicle and interval; in each interval in the order of the vehicles, so that sums
        have the same bits however many intervals are measured at once.

        Returns:
            (M,) number of the vehicle, (M,) begin of its time in the interval, (M,) seconds.
        """
        first = np.searchsorted(self.edges, first_ns, side="right") - 1
        last = np.searchsorted(self.edges, last_ns, side="right") - 1
        first, last = np.maximum(first, 0), np.minimum(last, len(self.edges) - 2)
        times = np.maximum(last - first + 1, 0)
        of = np.repeat(np.arange(len(first_ns)), times)
        interval = first[of] + np.arange(len(of)) - np.repeat(np.cumsum(times) - times, times)
        begin = np.maximum(first_ns[of], self.edges[interval])
        end = np.minimum(last_ns[of], self.edges[interval + 1])
        return of, begin, np.maximum(end - begin, 0) / NS

    def _lanes_of_row(self) -> NDArray[np.int64]:
        """(R,) how many lanes each row stands for."""
        of_station = {int(s): int((self.traffic.lanes.station == s).sum()) for s in self.stations}
        return np.array(
            [
                of_station[int(s)] if lane == NO_LANE else 1
                for lane, s in zip(self.row_lane, self.row_station, strict=True)
            ]
        )

    def _quantile(self, value: Array, share: float) -> Array:
        """Quantile of the values in each cell, between the nearest two; NaN in empty ones."""
        index, flat = self.crossing, np.full(int(np.prod(self.shape)), np.nan)
        value = value[index.kept]
        for row in (index.row, index.total):
            for slot in (index.slot, np.zeros_like(index.slot)):
                cell = np.ravel_multi_index((index.interval, row, slot), self.shape)
                order = np.lexsort((value, cell))
                cells, begin, count = np.unique(cell[order], return_index=True, return_counts=True)
                rank = share * (count - 1)
                low = np.floor(rank).astype(np.int64)
                high = np.minimum(low + 1, count - 1)
                ordered = value[order]
                below, above = ordered[begin + low], ordered[begin + high]
                flat[cells] = below + (rank - low) * (above - below)
        return flat.reshape(self.shape)

    def headways(self, out: NDArray[np.void]) -> None:
        """Headways and gaps to the vehicle before in the same lane, of the follower's class."""
        rows = self.traffic.crossings
        headway, gap = headways_s(rows, self.traffic.observed)
        known = np.isfinite(headway)
        count = self.sums(self.crossing, known.astype(np.float64))
        gap_count = self.sums(self.crossing, np.isfinite(gap).astype(np.float64))
        with np.errstate(divide="ignore", invalid="ignore"):
            out["headway_mean_s"] = self.sums(self.crossing, np.where(known, headway, 0.0)) / count
            out["gap_mean_s"] = self.sums(self.crossing, np.nan_to_num(gap)) / gap_count
            follows = (headway < FOLLOWING_S).astype(np.float64)
            out["platoon_share"] = self.sums(self.crossing, follows) / count

    def uses(self, out: NDArray[np.void]) -> None:
        """Density and space mean speed by the time and distance driven, and lane changes."""
        rows = self.traffic.pieces
        category = self.traffic.scheme.category_of(rows["class_id"], rows["length_m"])
        pace = rows["way_m"] / ((rows["last_ns"] - rows["first_ns"]) / NS)
        of, begin, time_s = self._spread(rows["first_ns"], rows["last_ns"])
        index = self._index(begin, rows["lane_id"][of], category[of])
        spent, driven = self.sums(index, time_s), self.sums(index, time_s * pace[of])
        length_km = self._length_m()[None, :, None] / 1000.0
        with np.errstate(divide="ignore", invalid="ignore"):
            out["density_veh_per_km"] = spent / length_km / self.watched_s[:, None, None]
            out["space_mean_speed_kmh"] = 3.6 * driven / spent
        rows = self.traffic.passages
        category = self.traffic.scheme.category_of(rows["class_id"], rows["length_m"])
        for name, at, other in (
            ("lane_changes_in", "first_ns", "from_lane"),
            ("lane_changes_out", "last_ns", "to_lane"),
        ):
            changed = (rows[other] != NO_LANE).astype(np.float64)
            out[name] = self.sums(self._index(rows[at], rows["lane_id"], category), changed)

    def _length_m(self) -> Array:
        """(R,) length of each row's lane; for all lanes of a station their mean.

        The density of a station is that of all its lanes together.
        """
        lanes = self.traffic.lanes
        length = dict(zip(lanes.lane_id.tolist(), lanes.length_m.tolist(), strict=True))
        mean = {int(s): float(lanes.length_m[lanes.station == s].mean()) for s in self.stations}
        return np.array(
            [
                mean[int(s)] if lane == NO_LANE else length[int(lane)]
                for lane, s in zip(self.row_lane, self.row_station, strict=True)
            ]
        )


@dataclass(frozen=True, slots=True)
class _Index:
    """Which vehicles count (N,), and for those that do their interval, row, total row and class."""

    kept: NDArray[np.bool_]
    interval: NDArray[np.int64]
    row: NDArray[np.int64]
    total: NDArray[np.int64]
    slot: NDArray[np.int64]


def headways_s(crossings: NDArray[np.void], observed: ObservedTime) -> tuple[Array, Array]:
    """(C,) time headway and (C,) time gap to the vehicle before in the same lane.

    The headway is from front to front, the gap from the leader's rear to the follower's front.
    Where no length is known, the middles of vehicles give the headway, and the gap is NaN. NaN for
    the first vehicle, after `LONGEST_HEADWAY_S`, and where the camera didn't watch all the time
    between.
    """
    headway, gap = np.full(len(crossings), np.nan), np.full(len(crossings), np.nan)
    order = np.lexsort((crossings["stamp_ns"], crossings["lane_id"]))
    rows = crossings[order]
    speed = np.maximum(rows["speed_mps"], 0.1)
    half_s = rows["length_m"] / 2 / speed
    middle_s = np.diff(rows["stamp_ns"]) / NS
    same = (rows["lane_id"][1:] == rows["lane_id"][:-1]) & (middle_s <= LONGEST_HEADWAY_S)
    same &= observed.watched(rows["stamp_ns"][:-1], rows["stamp_ns"][1:])
    fronts = np.nan_to_num(np.diff(half_s))  # 0 where one of the two lengths isn't known
    between = np.where(same, middle_s - fronts, np.nan)
    headway[order[1:]] = between
    gap[order[1:]] = between - rows["length_m"][:-1] / speed[:-1] + 0.0 * half_s[1:]
    return headway, gap
