"""Which lanes are near a point, for many points at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork

PIECE_M = 8.0
"""Lanes are searched in pieces of this length. Chosen: longer ones need a wider search, shorter
ones more `NEIGHBOURS`."""
NEIGHBOURS = 10
"""Pieces looked at per point. Chosen: with lanes of 3 m, the pieces of the lane and of two lanes on
either side; more cost time, fewer lose lanes where roads cross."""
CANDIDATES = 5
"""Lanes kept per point: the lane and two on either side. Chosen: more cost time in the lane
filter."""
RADIUS_M = 7.0
"""Farther from every lane a point is not on the road. Chosen: two lane widths; larger finds lanes
of other roads, smaller loses vehicles where the map is displaced."""
_APART = 1e3
"""More than any distance in metres, so that pieces are ordered by lane first."""
_PLACES = ("offset_m", "past_m", "arc_m", "heading_rad")


@dataclass(frozen=True, slots=True)
class Candidates:
    """The lanes near M points, at most C each, ordered by lane number; the rest is padding.

    Attributes:
        lane: (M, C) lane number, `NO_LANE` for padding.
        offset_m: (M, C) distance to the left of the centre line.
        past_m: (M, C) distance before the lane's beginning or after its end; 0 beside it.
        arc_m: (M, C) metres along the lane.
        heading_rad: (M, C) the lane's direction there.
    """

    lane: NDArray[np.int64]
    offset_m: NDArray[np.float64]
    past_m: NDArray[np.float64]
    arc_m: NDArray[np.float64]
    heading_rad: NDArray[np.float64]


class LaneIndex:
    """Finds lanes near points.

    Args:
        network: Whose lanes.
    """

    def __init__(self, network: RoadNetwork) -> None:
        pieces = [_pieces(network.line(lane)) for lane in range(len(network))]
        count = [len(arc) for _, _, arc in pieces]
        begin = np.concatenate([start for start, _, _ in pieces])
        vector = np.concatenate([step for _, step, _ in pieces])
        self._length = np.hypot(vector[:, 0], vector[:, 1])
        self._from_x, self._from_y = begin.T.copy()
        self._cos, self._sin = (vector / self._length[:, None]).T.copy()
        self._arc = np.concatenate([arc for _, _, arc in pieces])
        self._heading = np.arctan2(vector[:, 1], vector[:, 0])
        self._lane = np.repeat(np.arange(len(network)), count)
        self._tree = scipy.spatial.cKDTree(begin + 0.5 * vector)

    def near(self, xy: NDArray[np.float64], radius_m: float = RADIUS_M) -> Candidates:
        """The lanes within `radius_m` of points (M, 2)."""
        _, piece = self._tree.query(xy, k=NEIGHBOURS, distance_upper_bound=radius_m + 0.5 * PIECE_M)
        none = piece == len(self._length)
        at = np.where(none, 0, piece)
        along, across = self._project(xy, at)
        past = along - np.clip(along, 0.0, self._length[at])
        distance = np.hypot(past, across)
        distance[none | (distance > radius_m)] = np.inf
        # Of each lane only the nearest piece: the first in the order of lanes and distances.
        order = np.argsort(self._lane[at] * _APART + distance, axis=1)
        reach = np.take_along_axis(distance, order, axis=1)
        lane = np.take_along_axis(self._lane[at], order, axis=1)
        first = np.isfinite(reach)
        first[:, 1:] &= lane[:, 1:] != lane[:, :-1]
        _keep_nearest(first, reach)
        row, column = np.nonzero(first)
        place = (row, (np.cumsum(first, axis=1) - 1)[row, column])
        chosen = (row, order[row, column])
        part = at[chosen]
        found = Candidates(
            lane=np.full((len(xy), CANDIDATES), NO_LANE),
            **{name: np.zeros((len(xy), CANDIDATES)) for name in _PLACES},
        )
        found.lane[place] = self._lane[part]
        found.offset_m[place] = across[chosen]
        found.past_m[place] = np.abs(past[chosen])
        found.arc_m[place] = self._arc[part] + (along - past)[chosen]
        found.heading_rad[place] = self._heading[part]
        return found

    def _project(
        self, xy: NDArray[np.float64], piece: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Metres of points (M, 2) along pieces (M, K), and to the left of them."""
        x, y = xy[:, :1] - self._from_x[piece], xy[:, 1:] - self._from_y[piece]
        cos, sin = self._cos[piece], self._sin[piece]
        return x * cos + y * sin, y * cos - x * sin


def _keep_nearest(first: NDArray[np.bool_], reach: NDArray[np.float64]) -> None:
    """Of the marked places (M, K) in each row leave the `CANDIDATES` nearest ones."""
    many = np.flatnonzero(np.count_nonzero(first, axis=1) > CANDIDATES)
    if len(many):
        far = np.argsort(np.where(first[many], reach[many], np.inf), axis=1)[:, CANDIDATES:]
        first[many[:, None], far] = False


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
