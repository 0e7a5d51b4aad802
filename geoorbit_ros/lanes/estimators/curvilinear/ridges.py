"""Ridges: candidate lanes, maxima of the density, linked from station to station."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.estimators.curvilinear.density import Maxima
from geoorbit_ros.lanes.estimators.curvilinear.grouped import totals
from geoorbit_ros.lanes.estimators.curvilinear.profiles import Profiles

LINK_M = 1.0
"""A maximum is found within this of where its slope leads from one station to the next.
Chosen: larger links neighbouring lanes, smaller breaks ridges of noisy tracks."""
MIN_SPACING_M = 2.4
"""Closer clusters are one lane: lanes are 2.7 to 4.5 m wide (AASHTO Green Book; UK CD 127)."""
MIN_STATIONS = 4
"""Shortest ridge: one road scale. Chosen: longer misses lanes at the edge of the view, shorter
keeps noise."""


@dataclass(frozen=True)
class Ridge:
    """A candidate lane: its offset at consecutive stations, `first` the first of them."""

    first: int
    d: NDArray[np.float64]
    height: NDArray[np.float64]

    @property
    def end(self) -> int:
        """The station after its last."""
        return self.first + len(self.d)

    @property
    def stations(self) -> NDArray[np.int64]:
        """Station numbers."""
        return np.arange(self.first, self.end)

    @cached_property
    def weight(self) -> float:
        """Total density along the ridge."""
        return float(self.height.sum())


def trace_ridges(maxima: Maxima, profiles: Profiles, weight: NDArray[np.float64]) -> list[Ridge]:
    """Link maxima from station to station, in the direction of the traffic under each.

    Args:
        maxima: Those of the density.
        profiles: What the density was made of.
        weight: (S,) how much each sample counted in it.
    """
    if len(maxima.d) == 0:
        return []
    lead = _slopes(maxima, profiles, weight) * profiles.step_m[maxima.station]
    after, miss = maxima.nearest(maxima.station + 1, maxima.d + lead)
    before, _ = maxima.nearest(maxima.station - 1, maxima.d - lead)
    mine = np.arange(len(after))
    linked = (miss <= LINK_M) & (before[after] == mine) & (after != mine)
    follower = np.where(linked, after, -1)
    is_first = np.ones(len(after), bool)
    is_first[after[linked]] = False
    follows = follower.tolist()
    ridges = []
    for maximum in np.flatnonzero(is_first).tolist():
        chain = [maximum]
        while (maximum := follows[maximum]) >= 0:
            chain.append(maximum)
        ridges.append(Ridge(int(maxima.station[chain[0]]), maxima.d[chain], maxima.height[chain]))
    return [r for r in _bridge(ridges) if len(r.d) >= MIN_STATIONS]


def _slopes(maxima: Maxima, profiles: Profiles, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """(C,) mean dd/ds of the vehicles at each maximum; 0, along the reference line, without any."""
    maximum, away = maxima.nearest(profiles.station, profiles.d)
    weight = weight * (away <= 0.5 * MIN_SPACING_M)
    total = totals(maximum, weight, len(maxima.d))
    return totals(maximum, weight * profiles.slope, len(maxima.d)) / np.maximum(total, 1e-9)


def separate(ridges: list[Ridge]) -> list[Ridge]:
    """Cut the weaker of two ridges wherever they run closer than two lanes can."""
    kept: list[Ridge] = []
    for ridge in sorted(ridges, key=lambda r: -r.weight):
        free = np.ones(len(ridge.d), bool)
        for other in kept:
            low = max(ridge.first, other.first)
            high = min(ridge.end, other.end)
            if high > low:
                here = slice(low - ridge.first, high - ridge.first)
                there = slice(low - other.first, high - other.first)
                free[here] &= np.abs(ridge.d[here] - other.d[there]) >= MIN_SPACING_M
        if free.all():
            kept.append(ridge)
            continue
        # The longest free stretch remains.
        edges = np.flatnonzero(np.diff(np.concatenate([[0], free.astype(np.int8), [0]])))
        runs = edges.reshape(-1, 2)
        if len(runs):
            a, b = runs[np.argmax(runs[:, 1] - runs[:, 0])]
            if b - a >= MIN_STATIONS:
                kept.append(Ridge(ridge.first + int(a), ridge.d[a:b], ridge.height[a:b]))
    return kept


def _bridge(ridges: list[Ridge]) -> list[Ridge]:
    """Join ridges that continue each other across a stretch where the maxima were lost."""
    parts = sorted(ridges, key=lambda r: (r.first, r.d[0]))
    done: list[Ridge] = []
    while parts:
        ridge = parts.pop(0)
        while True:
            end = ridge.end
            best = None
            for k, other in enumerate(parts):
                gap = other.first - end
                if gap > 2 * MIN_STATIONS:
                    break  # They come in order.
                if gap >= 0:
                    miss = abs(other.d[0] - ridge.d[-1])
                    if miss <= LINK_M and (best is None or miss < best[0]):
                        best = (miss, k, gap)
            if best is None:
                break
            other = parts.pop(best[1])
            fill = np.linspace(0.0, 1.0, best[2] + 2)[1:-1]
            ridge = Ridge(
                ridge.first,
                np.concatenate([ridge.d, ridge.d[-1] + fill * (other.d[0] - ridge.d[-1]), other.d]),
                np.concatenate([ridge.height, np.zeros(best[2]), other.height]),
            )
        done.append(ridge)
    return done


def table(
    ridges: Sequence[Ridge], values: Sequence[NDArray[np.float64]], stations: int, empty: float
) -> NDArray[np.float64]:
    """(R, J) the ridges' values at all stations, `empty` where a ridge is not."""
    result = np.full((len(ridges), stations), empty)
    for k, (ridge, value) in enumerate(zip(ridges, values, strict=True)):
        result[k, ridge.first : ridge.first + len(value)] = value
    return result
