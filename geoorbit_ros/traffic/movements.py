"""Movements: from which lane to which vehicles go, and from which entry to which exit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lane_order import SAME_COS
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project
from geoorbit_ros.traffic.class_schemes import ClassScheme

BESIDE_M = 6.0
"""Lanes whose middles are this near where one of them begins have a common entry. Chosen: less than
two lane widths, so that a ramp that comes from aside is an entry of its own."""

MOVEMENT_DTYPE = np.dtype(
    [
        ("start_ns", "<i8"),
        ("end_ns", "<i8"),
        ("entry", "<i4"),
        ("exit", "<i4"),
        ("from_lane", "<i8"),
        ("to_lane", "<i8"),
        ("category", "<i4"),
        ("volume", "<i8"),
    ]
)
"""One row per interval, pair of lanes and category that occurs; `category` -1 for all classes. A
vehicle belongs to the interval in which it was last seen."""


@dataclass(frozen=True, slots=True)
class Gates:
    """Where vehicles come into view and where they leave it.

    Attributes:
        entry: Number of the entry of each lane, by its id, from 1.
        exit: Number of the exit of each lane.
    """

    entry: dict[int, int]
    exit: dict[int, int]


def find_gates(lanes: Sequence[Lane]) -> Gates:
    """Lanes that begin side by side have a common entry, lanes that end so a common exit."""
    return Gates(_clusters(lanes, 0), _clusters(lanes, -1))


def _clusters(lanes: Sequence[Lane], end: int) -> dict[int, int]:
    """Number of the group of each lane by where it begins (0) or ends (-1)."""
    group = list(range(len(lanes)))
    for i, lane in enumerate(lanes):
        point = lane.centerline_m[end : end + 1] if end == 0 else lane.centerline_m[-1:]
        way = np.diff(lane.centerline_m[:2] if end == 0 else lane.centerline_m[-2:], axis=0)[0]
        way = way / max(float(np.hypot(*way)), 1e-9)
        for j, other in enumerate(lanes):
            if i == j:
                continue
            at = project(point, other.centerline_m)
            beside = bool(at.inside[0]) and abs(float(at.offset_m[0])) < BESIDE_M
            if beside and float(at.tangent[0] @ way) > SAME_COS:
                old, new = max(group[i], group[j]), min(group[i], group[j])
                group = [new if g == old else g for g in group]
    number = {g: k + 1 for k, g in enumerate(sorted(set(group)))}
    return {lane.lane_id: number[group[k]] for k, lane in enumerate(lanes)}


def count_movements(
    passages: NDArray[np.void],
    gates: Gates,
    scheme: ClassScheme,
    edges_ns: NDArray[np.int64],
) -> NDArray[np.void]:
    """How many vehicles went from which lane to which.

    Args:
        passages: (P,) `records.PASSAGE_DTYPE`, ordered by vehicle and time.
        gates: Entries and exits of the lanes.
        scheme: Classes.
        edges_ns: (K + 1,) stamps between which the intervals lie.

    Returns:
        (M,) `MOVEMENT_DTYPE`, ordered by interval, lanes and class.
    """
    if not len(passages):
        return np.empty(0, MOVEMENT_DTYPE)
    begin = np.flatnonzero(np.diff(passages["vehicle_id"], prepend=-1))
    end = np.append(begin[1:], len(passages)) - 1
    first, last = passages[begin], passages[end]
    interval = np.searchsorted(edges_ns, last["last_ns"], side="right") - 1
    kept = (interval >= 0) & (interval < len(edges_ns) - 1)
    category = scheme.category_of(first["class_id"], first["length_m"])
    key = np.column_stack((interval, first["lane_id"], last["lane_id"], category))[kept]
    every = key.copy()
    every[:, 3] = -1
    rows, count = np.unique(np.concatenate((key, every)), axis=0, return_counts=True)
    out = np.zeros(len(rows), MOVEMENT_DTYPE)
    out["start_ns"], out["end_ns"] = edges_ns[rows[:, 0]], edges_ns[rows[:, 0] + 1]
    out["from_lane"], out["to_lane"], out["category"] = rows[:, 1:].T
    out["entry"] = [gates.entry[lane] for lane in rows[:, 1].tolist()]
    out["exit"] = [gates.exit[lane] for lane in rows[:, 2].tolist()]
    out["volume"] = count
    return out
