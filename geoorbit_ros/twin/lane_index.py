"""Which lanes are near a point, for many points at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geoorbit_ros.twin.network import NONE, RoadNetwork

PIECE_M = 8.0
"""Lanes are searched in pieces of this length: longer ones need a wider search."""
NEIGHBOURS = 10
"""Pieces looked at per point: with lanes of 3 m, those of the lane and of two on either side."""
CANDIDATES = 5
RADIUS_M = 7.0
"""Farther from every lane a point is not on the road."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """The lanes near M points, at most C each, ordered by lane number; the rest is padding.

    Attributes:
        lane: (M, C) lane number, `NONE` for padding.
        offset_m: (M, C) distance to the left of the centre line.
        past_m: (M, C) distance before the lane's beginning or after its end; 0 beside it.
        arc_m: (M, C) place along the lane.
        heading_rad: (M, C) the lane's direction there.
    """

    lane: NDArray[np.int64]
    offset_m: NDArray[np.float64]
    past_m: NDArray[np.float64]
    arc_m: NDArray[np.float64]
    heading_rad: NDArray[np.float64]


class LaneIndex:
    """Finds lanes by place.

    Args:
        network: Whose lanes.
    """

    def __init__(self, network: RoadNetwork) -> None:
        pieces = [_pieces(network.line(lane)) for lane in range(len(network))]
        count = [len(arc) for _, _, arc in pieces]
        self._from = np.concatenate([start for start, _, _ in pieces])
        vector = np.concatenate([step for _, step, _ in pieces])
        self._length = np.hypot(vector[:, 0], vector[:, 1])
        self._unit = vector / self._length[:, None]
        self._arc = np.concatenate([arc for _, _, arc in pieces])
        self._heading = np.arctan2(vector[:, 1], vector[:, 0])
        self._lane = np.append(np.repeat(np.arange(len(network)), count), NONE)
        self._tree = cKDTree(self._from + 0.5 * vector)

    def near(self, xy: NDArray[np.float64], radius_m: float = RADIUS_M) -> Candidates:
        """The lanes within `radius_m` of points (M, 2)."""
        rows = np.arange(len(xy))[:, None]
        _, piece = self._tree.query(xy, k=NEIGHBOURS, distance_upper_bound=radius_m + 0.5 * PIECE_M)
        none = piece == len(self._length)
        at = np.where(none, 0, piece)
        along, across = self._project(xy[:, None, :], at)
        past = along - np.clip(along, 0.0, self._length[at])
        distance = np.hypot(past, across)
        distance[none | (distance > radius_m)] = np.inf
        lane = np.where(np.isinf(distance), NONE, self._lane[piece])
        # Of each lane the nearest piece alone.
        order = np.lexsort((distance, lane), axis=1)
        lane_in_order = lane[rows, order]
        repeated = np.zeros_like(none)
        repeated[:, 1:] = lane_in_order[:, 1:] == lane_in_order[:, :-1]
        reach = np.where(repeated, np.inf, distance[rows, order])
        nearest = order[rows, np.argsort(reach, axis=1, kind="stable")[:, :CANDIDATES]]
        kept = np.sort(reach, axis=1)[:, :CANDIDATES] < np.inf
        chosen = np.where(kept, lane[rows, nearest], NONE)
        by_lane = np.argsort(np.where(kept, chosen, np.iinfo(np.int64).max), axis=1)
        pick = nearest[rows, by_lane]
        part = at[rows, pick]
        return Candidates(
            lane=chosen[rows, by_lane],
            offset_m=across[rows, pick],
            past_m=np.abs(past[rows, pick]),
            arc_m=self._arc[part] + np.clip(along[rows, pick], 0.0, self._length[part]),
            heading_rad=self._heading[part],
        )

    def _project(
        self, xy: NDArray[np.float64], piece: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Place along and to the left of pieces."""
        relative, unit = xy - self._from[piece], self._unit[piece]
        along = relative[..., 0] * unit[..., 0] + relative[..., 1] * unit[..., 1]
        across = unit[..., 0] * relative[..., 1] - unit[..., 1] * relative[..., 0]
        return along, across


def _pieces(
    line: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Start (N, 2), vector (N, 2) and arc of the start (N,) of pieces of at most `PIECE_M`."""
    step = np.diff(line, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    kept = length > 1e-9
    step, length, begin = step[kept], length[kept], line[:-1][kept]
    parts = np.maximum(np.ceil(length / PIECE_M), 1.0).astype(np.int64)
    segment = np.repeat(np.arange(len(step)), parts)
    within = np.arange(len(segment)) - np.repeat(np.cumsum(parts) - parts, parts)
    vector = step[segment] / parts[segment][:, None]
    arc = np.append(0.0, np.cumsum(length))[:-1]
    start = begin[segment] + within[:, None] * vector
    return start, vector, arc[segment] + within * length[segment] / parts[segment]
