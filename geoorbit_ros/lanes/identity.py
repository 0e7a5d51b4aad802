"""Lane ids that outlive every refinement of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from geoorbit_ros.core.lanes import Lane

MATCH_M = 1.6
"""Half the narrowest spacing of lanes, and a little: further apart is another lane."""
MATCH_RAD = 0.6


PROBES = 12
"""Points of a lane at which its distance to others is measured."""


class LaneRegistry:
    """Gives each lane the id it had before; a lane that comes back gets its old id back."""

    def __init__(self) -> None:
        self._known: dict[int, Lane] = {}
        self._next_id = 1

    def match(self, lanes: Sequence[Lane]) -> list[Lane | None]:
        """For each lane the one known from earlier maps that it continues, one to one."""
        known = list(self._known.values())
        matched: list[Lane | None] = [None] * len(lanes)
        if known and lanes:
            cost = np.minimum(_distances_m(lanes, known), _distances_m(known, lanes).T)
            blocked = cost > MATCH_M
            for i, k in zip(*linear_sum_assignment(np.where(blocked, 1e3, cost)), strict=True):
                if not blocked[i, k]:
                    matched[i] = known[k]
        return matched

    def identify(
        self, lanes: Sequence[Lane], matched: Sequence[Lane | None]
    ) -> tuple[Lane, ...]:
        """The lanes with lasting ids, ordered by id.

        Args:
            lanes: Lanes whose `lane_id` is ignored.
            matched: What `match` said about them.
        """
        named = []
        for lane, old in zip(lanes, matched, strict=True):
            lane_id = old.lane_id if old else self._next_id
            self._next_id += old is None
            named.append(replace(lane, lane_id=lane_id))
        self._known.update({lane.lane_id: lane for lane in named})
        return tuple(sorted(named, key=lambda lane: lane.lane_id))


def _distances_m(lanes: Sequence[Lane], others: Sequence[Lane]) -> NDArray[np.float64]:
    """(A, B) median distance of points of each lane to each other lane; inf where directions differ."""
    lines = [other.centerline_m for other in others]
    start = np.concatenate([line[:-1] for line in lines])
    step = np.concatenate([np.diff(line, axis=0) for line in lines])
    square = np.maximum((step**2).sum(axis=1), 1e-12)
    heading = np.arctan2(step[:, 1], step[:, 0])
    first = np.append(0, np.cumsum([len(line) - 1 for line in lines]))[:-1]
    owner = np.repeat(np.arange(len(lines)), [len(line) - 1 for line in lines])
    result = np.empty((len(lanes), len(lines)))
    for i, lane in enumerate(lanes):
        line = lane.centerline_m
        pick = np.unique(np.linspace(0, len(line) - 1, PROBES).round().astype(np.int64))
        own = np.gradient(line, axis=0)[pick]
        away = line[pick, None] - start
        t = np.clip((away * step).sum(axis=2) / square, 0.0, 1.0)
        rest = away - t[..., None] * step
        distance = np.hypot(rest[..., 0], rest[..., 1])
        nearest = np.minimum.reduceat(distance, first, axis=1)
        result[i] = np.median(nearest, axis=0)
        turn = np.arctan2(own[:, 1], own[:, 0])[:, None] - heading
        turn = np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi)
        at_foot = np.where(distance <= nearest[:, owner], turn, 0.0)
        angle = np.maximum.reduceat(at_foot, first, axis=1)
        result[i, np.median(angle, axis=0) > MATCH_RAD] = np.inf
    return result
