"""Lanes that lie side by side: what other formats call an edge or a road."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.metrics.polyline import project, sample

MAX_GAP_M = 1.0
"""Between the boundaries of neighbours."""
MAX_TURN_RAD = np.radians(20.0)
MIN_SHARE = 0.6
"""Of the longer lane's length that lies beside the shorter one."""
STEP_M = 2.0


def carriageways(lanes: Sequence[Lane]) -> list[list[Lane]]:
    """Groups of neighbouring lanes of one direction and about one length, right to left.

    Args:
        lanes: In the map frame.
    """
    pairs = [
        (i, j)
        for i, a in enumerate(lanes)
        for j, b in enumerate(lanes)
        if i != j and _neighbours(a, b)
    ]
    rows, columns = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    linked = coo_array((np.ones(len(pairs)), (rows, columns)), shape=(len(lanes), len(lanes)))
    _, label = connected_components(linked, directed=False)
    groups = [
        [lane for lane, k in zip(lanes, label, strict=True) if k == wanted]
        for wanted in np.unique(label)
    ]
    return [sorted(group, key=lambda lane: _offset_m(lane, group[0])) for group in groups]


def _neighbours(a: Lane, b: Lane) -> bool:
    """Whether `b` lies directly left or right of `a`; asked both ways round."""
    points = sample(a.centerline_m, STEP_M)
    beside = project(points.point_m, b.centerline_m)
    if not beside.inside.any() or beside.inside.mean() < MIN_SHARE:
        return False
    inside = beside.inside
    cosine = np.sum(points.tangent[inside] * beside.tangent[inside], axis=1)
    gap_m = np.abs(beside.offset_m[inside]) - 0.5 * (a.width_m + b.width_m)
    return bool(
        np.median(cosine) > np.cos(MAX_TURN_RAD) and abs(float(np.median(gap_m))) <= MAX_GAP_M
    )


def _offset_m(lane: Lane, reference: Lane) -> float:
    """How far left of the reference a lane lies, at its middle."""
    x, y, _ = lane.middle
    return float(project(np.array([[x, y]]), reference.centerline_m).offset_m[0])
