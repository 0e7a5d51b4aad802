"""Lane ids that outlive every refinement of the map."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane, Status
from geoorbit_ros.lanes.estimators.estimator import State

MATCH_M = 1.6
"""Chosen: half the least spacing of lanes (2.4 m) and a little. Farther apart is another lane."""
MATCH_RAD = 0.6
"""Lanes whose directions differ by more are not the same. Chosen: larger confuses a ramp with the
road beside it, smaller loses ids where a new line bends otherwise at its end."""
PROBES = 12
"""Points of a lane at which its distance to others is measured. Chosen: more cost time, fewer miss
where lanes part."""

_STATUSES: tuple[Status, ...] = ("tentative", "confirmed")
_NUMBERS = ("width_m", "width_sigma_m", "confidence", "vehicles", "sigma_m")


class LaneRegistry:
    """Gives each lane the id it had before; a lane that comes back gets its old id back."""

    def __init__(self) -> None:
        self._known: dict[int, Lane] = {}
        self._next_id = 1

    def state(self) -> State:
        """All lanes ever known, and the next id."""
        return pack_lanes(self._known.values()) | {"next_id": np.array([self._next_id], np.int64)}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Know the lanes of `state`.

        Raises:
            KeyError, ValueError, IndexError: Not such a state.
        """
        self._known = {lane.lane_id: lane for lane in unpack_lanes(state)}
        self._next_id = int(state["next_id"][0])

    def match(self, lanes: Sequence[Lane]) -> list[Lane | None]:
        """For each lane the one known from earlier maps that it continues, one to one."""
        known = list(self._known.values())
        matched: list[Lane | None] = [None] * len(lanes)
        if known and lanes:
            cost = _distances_m(lanes, known)
            if np.any(np.sum(cost <= MATCH_M, axis=1) != 1):
                # A lane grown to twice its length is not near the old one, but that is near it.
                cost = np.minimum(cost, _distances_m(known, lanes).T)
            blocked = cost > MATCH_M
            for i, k in zip(
                *scipy.optimize.linear_sum_assignment(np.where(blocked, 1e3, cost)), strict=True
            ):
                if not blocked[i, k]:
                    matched[i] = known[k]
        return matched

    def identify(self, lanes: Sequence[Lane], matched: Sequence[Lane | None]) -> tuple[Lane, ...]:
        """The lanes with lasting ids, in the same order.

        Args:
            lanes: Lanes whose `lane_id` is ignored.
            matched: What `match` said about them.
        """
        named = []
        for lane, old in zip(lanes, matched, strict=True):
            lane_id = old.lane_id if old else self._next_id
            self._next_id += old is None
            named.append(lane if lane.lane_id == lane_id else replace(lane, lane_id=lane_id))
        self._known.update({lane.lane_id: lane for lane in named})
        return tuple(named)


def _distances_m(lanes: Sequence[Lane], others: Sequence[Lane]) -> NDArray[np.float64]:
    """(A, B) median distance of each lane's points to each other lane; inf if directions differ."""
    lines = [other.centerline_m for other in others]
    start = np.concatenate([line[:-1] for line in lines])
    step = np.concatenate([np.diff(line, axis=0) for line in lines])
    square = np.maximum((step**2).sum(axis=1), 1e-12)
    heading = np.arctan2(step[:, 1], step[:, 0])
    first = np.append(0, np.cumsum([len(line) - 1 for line in lines]))[:-1]
    owner = np.repeat(np.arange(len(lines)), [len(line) - 1 for line in lines])
    picks = [_probes(lane.centerline_m) for lane in lanes]
    probe = np.concatenate([lane.centerline_m[k] for lane, k in zip(lanes, picks, strict=True)])
    own = np.concatenate(
        [np.gradient(lane.centerline_m, axis=0)[k] for lane, k in zip(lanes, picks, strict=True)]
    )
    away_x = probe[:, :1] - start[:, 0]
    away_y = probe[:, 1:] - start[:, 1]
    t = np.clip((away_x * step[:, 0] + away_y * step[:, 1]) / square, 0.0, 1.0)
    distance = np.hypot(away_x - t * step[:, 0], away_y - t * step[:, 1])
    nearest = np.minimum.reduceat(distance, first, axis=1)
    turn = np.arctan2(own[:, 1], own[:, 0])[:, None] - heading
    turn = np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi)
    angle = np.maximum.reduceat(np.where(distance <= nearest[:, owner], turn, 0.0), first, axis=1)
    result = np.empty((len(lanes), len(lines)))
    rows = np.split(np.arange(len(probe)), np.cumsum([len(k) for k in picks])[:-1])
    for i, row in enumerate(rows):
        alike = np.median(angle[row], axis=0) <= MATCH_RAD
        result[i] = np.where(alike, np.median(nearest[row], axis=0), np.inf)
    return result


def _probes(line: NDArray[np.float64]) -> NDArray[np.int64]:
    """At most `PROBES` point numbers, evenly spread."""
    return np.unique(np.linspace(0, len(line) - 1, PROBES).round().astype(np.int64))


def pack_lanes(lanes: Iterable[Lane]) -> State:
    """Lanes as arrays, one after the other."""
    lanes = list(lanes)
    lines = [np.stack([k.centerline_m, k.left_m, k.right_m], axis=1) for k in lanes]
    return {
        "lanes_points_m": np.concatenate([np.empty((0, 3, 2)), *lines]),
        "lanes_count": np.array([len(line) for line in lines], np.int64),
        "lanes_id": np.array([lane.lane_id for lane in lanes], np.int64),
        "lanes_status": np.array([_STATUSES.index(lane.status) for lane in lanes], np.int64),
        "lanes_missing": np.array([lane.vehicles_missing for lane in lanes], np.int64),
        "lanes_numbers": np.array(
            [[getattr(lane, name) for name in _NUMBERS] for lane in lanes], np.float64
        ).reshape(-1, len(_NUMBERS)),
    }


def unpack_lanes(state: Mapping[str, NDArray[Any]]) -> list[Lane]:
    """The inverse of `pack_lanes`.

    Raises:
        KeyError, ValueError, IndexError: Arrays that are missing or don't fit together.
    """
    ends = np.cumsum(state["lanes_count"])
    if len(ends) and ends[-1] != len(state["lanes_points_m"]):
        raise ValueError(f"{len(state['lanes_points_m'])} points of lanes, {ends[-1]} wanted")
    lanes = []
    for k, points in enumerate(np.split(state["lanes_points_m"], ends[:-1])[: len(ends)]):
        numbers = dict(zip(_NUMBERS, state["lanes_numbers"][k].tolist(), strict=True))
        lanes.append(
            Lane(
                lane_id=int(state["lanes_id"][k]),
                centerline_m=points[:, 0],
                left_m=points[:, 1],
                right_m=points[:, 2],
                status=_STATUSES[int(state["lanes_status"][k])],
                vehicles_missing=int(state["lanes_missing"][k]),
                **numbers,
            )
        )
    return lanes
