"""Ends of lanes: where a lane empties into its neighbour, its vehicles no longer show its middle.

At a merge, a lane drop or the start of an exit lane, the vehicles of the ending lane are on their
way across. Their mean drifts towards the neighbour; the lane itself stays beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.centerlines import Centerline
from geoorbit_ros.lanes.grouped import quantile
from geoorbit_ros.lanes.widths import SPACING_RANGE_M

DRIFT_M = 0.2
"""A spacing smaller than usual by more than this is drift, not a lane."""
USUAL_QUANTILE = 0.7
EMPTYING = 0.75
"""Share of a lane's usual traffic below which it is emptying."""
EMPTY = 0.15
"""Share below which it has ended."""
MIN_STATIONS = 6


def straighten_ends(lines: Sequence[Centerline]) -> list[Centerline]:
    """Keep each emptying lane beside its busier neighbour, and end it where it is empty."""
    result = list(lines)
    traffic = np.array([line.support.sum() for line in lines])
    busiest = np.argsort(-traffic, kind="stable").tolist()
    for k in np.argsort(traffic, kind="stable").tolist():
        for other in busiest:
            if other != k:
                result[k] = _beside(result[k], result[other])
    return result


def _beside(line: Centerline, neighbour: Centerline) -> Centerline:
    low = max(line.station[0], neighbour.station[0])
    high = min(line.station[-1], neighbour.station[-1]) + 1
    if high - low < MIN_STATIONS:
        return line
    own = slice(low - line.station[0], high - line.station[0])
    there = slice(low - neighbour.station[0], high - neighbour.station[0])
    gap = line.d[own] - neighbour.d[there]
    spacing = np.abs(gap)
    if spacing.min() > SPACING_RANGE_M[1]:
        return line
    usual = spacing[(spacing >= SPACING_RANGE_M[0]) & (spacing <= SPACING_RANGE_M[1])]
    if len(usual) < max(MIN_STATIONS, 0.5 * len(spacing)):
        return line
    wanted = quantile(usual, USUAL_QUANTILE)
    drifts = spacing < wanted - DRIFT_M
    traffic = line.support[own] / max(quantile(line.support[own][~drifts], 0.5), 1e-9)
    emptying = (traffic < EMPTYING) & (neighbour.support[there] > line.support[own])
    moved = np.zeros(len(line.d), bool)
    flag = drifts & emptying
    # Only runs that reach an end of the lane: a dip in the middle is real.
    begins, ends = low == line.station[0], high == line.station[-1] + 1
    moved[own] = (_run_at_start(flag) & begins) | (_run_at_start(flag[::-1])[::-1] & ends)
    if not moved.any():
        return line
    d = line.d.copy()
    side = np.sign(np.median(gap))
    common = np.zeros(len(line.d), bool)
    common[own] = True
    d[moved] = (neighbour.d[there] + side * wanted)[moved[common]]
    keep = np.ones(len(d), bool)
    keep[own] = ~(moved[own] & (traffic < EMPTY))
    k = np.flatnonzero(keep)
    cut = slice(int(k[0]), int(k[-1]) + 1)
    return replace(
        line,
        station=line.station[cut],
        d=d[cut],
        sigma_m=line.sigma_m[cut],
        support=line.support[cut],
    )


def _run_at_start(flag: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(np.logical_and.accumulate(flag))
