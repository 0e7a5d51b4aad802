"""Counts of whole intervals from what was watched of them: an unwatched road is not an empty one.

The unwatched part of an interval has the flow that was seen in the rest of it and in as many
intervals before and after it as make up one whole interval.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.traffic.interval_clock import NS, ObservedTime
from geoorbit_ros.twin.demand.counted_ways import CountedVehicles

Array = NDArray[np.float64]

WHOLE = 0.995
"""An interval watched for this share is whole. Chosen: the frames at its ends are up to some tenths
of a second inside it; less leaves seconds of traffic out."""


@dataclass(frozen=True, slots=True)
class WholeCounts:
    """Vehicles per interval and way.

    Attributes:
        edges_ns: (K + 1,) stamps between which the intervals lie.
        observed: (K,) share of each interval that was watched.
        seen: (K, W) vehicles that were seen.
        count: (K, W) vehicles of whole intervals, no fewer than were seen.
        unseen_sigma: (K,) 1-sigma of the vehicles that were not seen, relative to their square
            root: 1 by chance alone, more where few were seen.
    """

    edges_ns: NDArray[np.int64]
    observed: Array
    seen: NDArray[np.int64]
    count: NDArray[np.int64]
    unseen_sigma: Array

    @property
    def filled(self) -> NDArray[np.bool_]:
        """(K,) whether part of an interval was not watched."""
        return np.asarray(self.observed < WHOLE)


def whole_counts(
    vehicles: CountedVehicles, observed: ObservedTime, edges_ns: NDArray[np.int64]
) -> WholeCounts:
    """Count vehicles per interval and way, and fill up what was not watched.

    A vehicle belongs to the interval in which it crossed its first station.

    Args:
        vehicles: Who was counted.
        observed: When the camera watched.
        edges_ns: (K + 1,) stamps between which the intervals lie.
    """
    intervals, ways = len(edges_ns) - 1, len(vehicles.ways)
    interval = np.searchsorted(edges_ns, vehicles.stamp_ns, side="right") - 1
    inside = (interval >= 0) & (interval < intervals)
    seen = np.zeros((intervals, ways), np.int64)
    np.add.at(seen, (interval[inside], vehicles.way[inside]), 1)
    watched_s, length_s = observed.seconds(edges_ns), np.diff(edges_ns) / NS
    share = np.minimum(watched_s / length_s, 1.0)
    count, carry, sigma = seen.copy(), np.zeros(ways), np.ones(intervals)
    for k in np.flatnonzero(share < WHOLE).tolist():
        near = _around(k, watched_s, float(length_s[k]))
        pool = seen[near].sum(axis=0)
        missing_s = float(length_s[k] - watched_s[k])
        scale = missing_s / max(float(watched_s[near].sum()), 1e-9)
        expected = seen[k] + scale * pool + carry
        count[k] = _whole_numbers(expected, seen[k])
        carry = expected - count[k]
        sigma[k] = np.sqrt(1.0 + scale)
    return WholeCounts(edges_ns, share, seen, count, sigma)


def _around(k: int, watched_s: Array, needed_s: float) -> slice:
    """Interval k with as many on either side as were watched for so long together."""
    reach = 0
    while True:
        near = slice(max(k - reach, 0), k + reach + 1)
        if watched_s[near].sum() >= needed_s or reach >= len(watched_s):
            return near
        reach += 1


def _whole_numbers(expected: Array, least: NDArray[np.int64]) -> NDArray[np.int64]:
    """Whole numbers near the expected ones whose sum is right, too (largest remainders)."""
    found: NDArray[np.int64] = np.maximum(np.floor(expected), least).astype(np.int64)
    rest = expected - found
    more = round(float(expected.sum())) - int(found.sum())
    if more > 0:
        found[np.argsort(-rest, kind="stable")[:more]] += 1
    return found
