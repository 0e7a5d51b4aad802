"""Counting new vehicles into a known map, between two derivations of its geometry.

A few vehicles more move a centreline by centimetres, but they can confirm a lane. So most updates
only count; the map is derived anew when the evidence has grown enough to sharpen it, or when
vehicles drive where no lane is known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.lanes.passes import Passes, wrap_rad

NEAR_M = 1.5
"""From a lane's middle; a vehicle farther away is beside the lane."""
ALONG_RAD = 0.3
SAMPLE_M = 2.0
SUPPORT_M = 12.0
"""Travel in a lane that makes a vehicle one of its own; less where the lane is short."""


class LaneCounter:
    """Assigns passes to the lanes of one map.

    Args:
        lanes: The map's lanes.
    """

    def __init__(self, lanes: Sequence[Lane]) -> None:
        lines = [_dense(lane.centerline_m) for lane in lanes]
        self._count = len(lines)
        self._owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
        headings = [np.arctan2(*np.gradient(line, axis=0).T[::-1]) for line in lines]
        self._heading = np.concatenate(headings) if lines else np.empty(0)
        self._tree = cKDTree(np.concatenate(lines)) if lines else None
        lengths = np.array([lane.length_m for lane in lanes])
        self._wanted_m = np.minimum(SUPPORT_M, 0.5 * lengths)

    def count(self, passes: Passes) -> tuple[NDArray[np.int64], int]:
        """Vehicles per lane (L,), and how many passes drive along no lane.

        Args:
            passes: New traffic.
        """
        if self._tree is None or len(passes) == 0:
            return np.zeros(self._count, np.int64), len(passes)
        distance, at = self._tree.query(passes.xy, distance_upper_bound=NEAR_M)
        near = np.isfinite(distance)
        at = np.where(near, at, 0)
        near &= np.abs(wrap_rad(passes.heading - self._heading[at])) <= ALONG_RAD
        owner = passes.pass_of_node()
        step = np.append(0.0, np.hypot(*np.diff(passes.xy, axis=0).T))
        step[passes.offset[:-1]] = 0.0
        cell = owner[near] * self._count + self._owner[at[near]]
        travel = np.bincount(cell, step[near], len(passes) * self._count)
        inside = travel.reshape(len(passes), self._count) >= self._wanted_m
        return inside.sum(axis=0), int((~inside.any(axis=1)).sum())


def _dense(line: NDArray[np.float64]) -> NDArray[np.float64]:
    arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    at = np.linspace(0.0, arc[-1], max(2, int(arc[-1] / SAMPLE_M) + 1))
    return np.column_stack([np.interp(at, arc, line[:, k]) for k in range(2)])
