"""Where positions lie along and across each lane, for many positions at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from geoorbit_ros.core.errors import TableError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project

Array = NDArray[np.float64]

STEP_M = 0.5
"""Distance between the points of a lane that positions are held against, and side of the cells in
which the nearest one is looked up. Chosen: smaller costs memory; larger is wrong by more than a
centimetre where a lane bends by 50 m."""
REACH_M = 8.0
"""Positions farther from a lane than this have no place along it. Chosen: two lanes' width; larger
costs memory, smaller loses vehicles at the edge of wide lanes."""


@dataclass(frozen=True, slots=True)
class LanePlaces:
    """N positions beside L lanes.

    Attributes:
        arc_m: (N, L) distance along the centreline; beyond the lane's ends it goes on straight.
        offset_m: (N, L) distance to the left of the centreline; infinite out of reach.
        heading_rad: (N, L) direction of the lane there, CCW from east.
        half_width_m: (N, L) half the lane's width there.
    """

    arc_m: Array
    offset_m: Array
    heading_rad: Array
    half_width_m: Array


class RoadCoordinates:
    """The lanes of a map as coordinates along and across.

    Args:
        lanes: Lanes in the map frame; at least one.
    """

    def __init__(self, lanes: Sequence[Lane]) -> None:
        if not lanes:
            raise TableError("lane map", "no lane", "at least one")
        self.lanes = tuple(lanes)
        self.length_m = np.array([lane.length_m for lane in lanes])
        self._lanes = [_SampledLane(lane) for lane in lanes]

    def __reduce__(self) -> tuple[type[RoadCoordinates], tuple[tuple[Lane, ...]]]:
        """Copies and stored states (`watch_state`) have the lanes alone."""
        return RoadCoordinates, (self.lanes,)

    def __len__(self) -> int:
        return len(self.lanes)

    def at(self, position_m: Array) -> LanePlaces:
        """Where (N, 2) positions in metres are."""
        shape = (len(position_m), len(self.lanes))
        places = LanePlaces(*(np.empty(shape) for _ in range(4)))
        for k, lane in enumerate(self._lanes):
            lane.write(position_m, places, k)
        return places


class _SampledLane:
    """One lane as points every `STEP_M`, and a grid that says which of them is nearest."""

    def __init__(self, lane: Lane) -> None:
        line = np.asarray(lane.centerline_m, np.float64)
        step = np.hypot(*np.diff(line, axis=0).T)
        line = line[np.append(True, step > 1e-9)]
        arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
        self.arc = np.linspace(0.0, arc[-1], max(int(np.ceil(arc[-1] / STEP_M)), 1) + 1)
        self.point = np.column_stack([np.interp(self.arc, arc, line[:, k]) for k in (0, 1)])
        slope = np.gradient(self.point, self.arc, axis=0)
        self.heading = np.arctan2(slope[:, 1], slope[:, 0])
        self._cos, self._sin = np.cos(self.heading), np.sin(self.heading)
        self.half_width = self._half_width(lane)
        self._origin = self.point.min(axis=0) - REACH_M
        cells = np.ceil((self.point.max(axis=0) + REACH_M - self._origin) / STEP_M).astype(int) + 1
        centre = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in cells), indexing="ij"), axis=-1)
        tree = KDTree(self.point)
        far, near = tree.query(
            self._origin + STEP_M * centre.reshape(-1, 2), distance_upper_bound=REACH_M + STEP_M
        )
        near = np.where(np.isfinite(far), near, -1)
        self._nearest, self._cells = near.astype(np.int32), cells.tolist()

    def _half_width(self, lane: Lane) -> Array:
        """(K,) half the distance between the boundaries, at each point."""
        if len(lane.left_m) != len(lane.right_m) or len(lane.left_m) < 2:
            return np.full(len(self.arc), 0.5 * lane.width_m)
        middle = (lane.left_m + lane.right_m) / 2
        along = project(middle, lane.centerline_m).arc_m
        order = np.argsort(along, kind="stable")
        width = np.hypot(*(lane.left_m - lane.right_m).T)
        return np.asarray(0.5 * np.interp(self.arc, along[order], width[order]))

    def write(self, position_m: Array, places: LanePlaces, column: int) -> None:
        """Fill one column of `places`."""
        cell_x, cell_y = (
            np.floor((position_m[:, axis] - self._origin[axis]) / STEP_M) for axis in (0, 1)
        )
        inside = (cell_x >= 0) & (cell_x < self._cells[0])  # False for NaN
        inside &= (cell_y >= 0) & (cell_y < self._cells[1])
        cell = np.where(inside, cell_x * self._cells[1] + cell_y, 0.0).astype(np.int64)
        near = np.where(inside, self._nearest.take(cell), -1)
        found, near = near >= 0, np.maximum(near, 0)
        gap_x, gap_y = (position_m[:, axis] - self.point[:, axis].take(near) for axis in (0, 1))
        cos, sin = self._cos.take(near), self._sin.take(near)
        places.arc_m[:, column] = self.arc.take(near) + gap_x * cos + gap_y * sin
        places.offset_m[:, column] = np.where(found, gap_y * cos - gap_x * sin, np.inf)
        places.heading_rad[:, column] = self.heading.take(near)
        places.half_width_m[:, column] = self.half_width.take(near)
