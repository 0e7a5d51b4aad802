"""When a map is derived anew, and counting new vehicles into its lanes in between.

A few vehicles more move a centreline by centimetres, but they can confirm a lane. So most updates
only count; the map is derived anew when the evidence has grown enough to sharpen it, or when
vehicles drive where no lane is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.lanes.confidence import count_vehicles, keep_confirmed
from geoorbit_ros.lanes.estimators.curvilinear.grouped import totals
from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import (
    TrajectorySegments,
    step_m,
    wrap_rad,
)
from geoorbit_ros.lanes.estimators.estimator import LaneEstimator, SegmentSource
from geoorbit_ros.lanes.parameters import LaneParameters

GROWTH = 1.0
"""Share by which the evidence grows before a derivation. A centreline's error shrinks with the root
of the traffic: twice as much sharpens it by a third, and less would hardly move it (ADR 0011)."""
LEAST_GROWTH = 0.05
"""The same where vehicles drive off the known lanes. Time per derivation grows with the evidence:
a least share of it between two keeps the time per vehicle the same however long the camera runs."""
NEAR_M = 1.5
"""From a lane's middle; a vehicle farther away is beside the lane. Chosen: half a lane of 3 m;
larger counts vehicles of the neighbour, smaller takes drivers off the middle for a new lane."""
ALONG_RAD = 0.3
"""A vehicle that drives at more than this to a lane is not in it. Chosen: larger counts crossing
vehicles, smaller misses noisy tracks."""
SAMPLE_M = 2.0
"""Distance between the points of a lane that vehicles are compared with. Chosen: shorter costs
time, longer makes lanes look farther away than they are."""
SUPPORT_M = 12.0
"""Travel in a lane that makes a vehicle one of its own; less where the lane is short. Chosen: more
misses broken tracks, less counts vehicles that cross the lane."""
OFF_LANE_M = 25.0
"""Travel off all known lanes that may be along an unknown one: broken tracks are shorter. Chosen:
longer finds new lanes later, shorter derives for lane changes."""
CELL_M = 6.0
"""Side of the squares in which off-lane vehicles are counted. Chosen: larger adds up vehicles of
different ways, smaller needs more vehicles until four meet."""
CELLS_PER_TURN = 8
"""Directions that are counted apart: 45 degrees each. Chosen: fewer add up crossing ways, more
split one way."""
CLUSTER = 4
"""Vehicles off the known lanes, all through one place, that may be a lane. Chosen: more find new
lanes later, fewer derive for single drivers."""
MORE = 4
"""Times as many as before it takes where they made no lane: that place seldom makes one now.
Chosen: more find late lanes later, fewer derive in vain."""


@dataclass(frozen=True)
class _Derived:
    """The last map derived in full, and what is needed to count on from it."""

    lane_map: LaneMap
    parameters: LaneParameters
    finished: int

    @cached_property
    def counter(self) -> LaneCounter:
        """Counts new vehicles into the map's lanes."""
        return LaneCounter(self.lane_map.lanes)


class UpdatePolicy:
    """Decides at each update whether to derive the map anew or to count new vehicles into it.

    A derivation costs time in proportion to the evidence, which is bounded; done once per so many
    vehicles, it costs the same per vehicle however long the camera has run.

    Args:
        estimator: What derives. One that is no `SegmentSource` derives at every update.
    """

    def __init__(self, estimator: LaneEstimator) -> None:
        self._source = estimator if isinstance(estimator, SegmentSource) else None
        self._last: _Derived | None = None
        self._counted = 0
        self._off_lane = OffLaneVehicles()
        self._new_stream = False

    def derived(self, lane_map: LaneMap, parameters: LaneParameters) -> None:
        """A map was derived; `lane_map` holds the lanes that are shown."""
        self._last = None
        if self._source is None or lane_map.segments == 0:
            return
        self._counted, self._new_stream = self._source.finished_segments(), False
        self._off_lane.derived()
        self._last = _Derived(lane_map, parameters, self._counted)

    def count(self, stamp_ns: int, parameters: LaneParameters) -> LaneMap | None:
        """The last map with the vehicles that came since; None when it must be derived anew.

        Args:
            stamp_ns: Capture time of the newest frame.
            parameters: Theta as it is now.
        """
        last, source = self._last, self._source
        if last is None or source is None or last.parameters != parameters:
            return None
        fresh = source.segments_after(self._counted, last.lane_map.stamp_ns)
        self._counted = source.finished_segments()
        self._new_stream |= self._off_lane.add(fresh, last.counter.add(fresh))
        growth = (self._counted - last.finished) / last.lane_map.segments
        if growth >= GROWTH or (self._new_stream and growth >= LEAST_GROWTH):
            return None
        counts = last.counter.vehicles.tolist()
        lanes = tuple(
            keep_confirmed(count_vehicles(lane, count), lane)
            for lane, count in zip(last.lane_map.lanes, counts, strict=True)
        )
        return replace(last.lane_map, stamp_ns=stamp_ns, lanes=lanes)


class LaneCounter:
    """Assigns segments to the lanes of one map, and counts them.

    Args:
        lanes: The map's lanes.

    Attributes:
        vehicles: (L,) segments counted into each lane so far.
    """

    def __init__(self, lanes: Sequence[Lane]) -> None:
        lines = [_dense(lane.centerline_m) for lane in lanes]
        self.vehicles = np.zeros(len(lines), np.int64)
        self._owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
        headings = [np.arctan2(*np.gradient(line, axis=0).T[::-1]) for line in lines]
        self._heading = np.concatenate(headings) if lines else np.empty(0)
        self._tree = scipy.spatial.cKDTree(np.concatenate(lines)) if lines else None
        lengths = np.array([lane.length_m for lane in lanes])
        self._wanted_m = np.minimum(SUPPORT_M, 0.5 * lengths)

    def add(self, segments: TrajectorySegments) -> NDArray[np.int64]:
        """Count new traffic; the nodes off the lanes, of segments that are off them for long."""
        if self._tree is None or len(segments) == 0:
            return np.arange(len(segments.xy))
        distance, at = self._tree.query(segments.xy, distance_upper_bound=NEAR_M)
        near = np.isfinite(distance)
        at = np.where(near, at, 0)
        near &= np.abs(wrap_rad(segments.heading - self._heading[at])) <= ALONG_RAD
        step = np.append(0.0, step_m(*segments.xy.T))
        step[segments.offset[:-1]] = 0.0
        count = len(self.vehicles)
        cell = segments.owner[near] * count + self._owner[at[near]]
        travel = totals(cell, step[near], len(segments) * count).reshape(len(segments), count)
        self.vehicles += np.sum(travel >= self._wanted_m, axis=0)
        away = totals(segments.owner, step * ~near, len(segments))
        return np.flatnonzero(~near & (away >= OFF_LANE_M)[segments.owner])


class OffLaneVehicles:
    """Where vehicles drive that no known lane explains, for as long as the camera runs."""

    def __init__(self) -> None:
        self._count: dict[tuple[int, ...], int] = {}
        self._known: dict[tuple[int, ...], int] = {}

    def add(self, segments: TrajectorySegments, node: NDArray[np.int64]) -> bool:
        """Count segments at their nodes `node` (M,), which are off the lanes.

        Returns:
            Whether there may be a lane now that the last derivation could not know of.
        """
        sector = np.rint(segments.heading[node] * (CELLS_PER_TURN / (2.0 * np.pi))) % CELLS_PER_TURN
        cell = np.column_stack([segments.owner[node], np.floor(segments.xy[node] / CELL_M), sector])
        cluster = False
        for _, *place in set(map(tuple, cell.astype(np.int64).tolist())):
            key = tuple(place)
            self._count[key] = self._count.get(key, 0) + 1
            cluster |= self._count[key] == max(CLUSTER, MORE * self._known.get(key, 0))
        return cluster

    def derived(self) -> None:
        """A map was derived from all traffic so far."""
        self._known = dict(self._count)


def _dense(line: NDArray[np.float64]) -> NDArray[np.float64]:
    arc = np.append(0.0, np.cumsum(step_m(*line.T)))
    at = np.linspace(0.0, arc[-1], max(2, int(arc[-1] / SAMPLE_M) + 1))
    return np.column_stack([np.interp(at, arc, line[:, k]) for k in range(2)])
