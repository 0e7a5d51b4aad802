"""Ridges: candidate lanes, traced along the crests of the density from station to station."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.density import Crests

LINK_M = 1.0
"""A crest is found within this of where its slope leads from one station to the next."""
MIN_SPACING_M = 2.4
"""Closer bundles are one lane: lanes are 2.7 to 4.5 m wide (AASHTO Green Book; UK CD 127)."""
MIN_STATIONS = 4


@dataclass(slots=True)
class Ridge:
    """A candidate lane: its offset at consecutive stations, `first` the first of them."""

    first: int
    d: NDArray[np.float64]
    height: NDArray[np.float64]

    @property
    def stations(self) -> NDArray[np.int64]:
        """Station numbers."""
        return np.arange(self.first, self.first + len(self.d))

    @property
    def weight(self) -> float:
        """Total density along the ridge."""
        return float(self.height.sum())


def trace_ridges(crests: Crests) -> list[Ridge]:
    """Link crests from station to station."""
    open_ridges: list[tuple[int, list[float], list[float]]] = []
    closed: list[Ridge] = []
    d, height, first = crests.d.tolist(), crests.height.tolist(), crests.first.tolist()
    for j in range(len(first) - 1):
        here = range(first[j], first[j + 1])
        expected = [_next_offset(ridge[1]) for ridge in open_ridges]
        still: list[tuple[int, list[float], list[float]]] = []
        taken = set()
        for i, ridge in enumerate(open_ridges):
            best = min(here, key=lambda k: abs(d[k] - expected[i]), default=-1)
            if best >= 0 and abs(d[best] - expected[i]) <= LINK_M:
                rival = min(range(len(expected)), key=lambda m: abs(d[best] - expected[m]))
                if rival == i:
                    ridge[1].append(d[best])
                    ridge[2].append(height[best])
                    taken.add(best)
                    still.append(ridge)
                    continue
            closed.append(Ridge(ridge[0], np.array(ridge[1]), np.array(ridge[2])))
        still.extend((j, [d[k]], [height[k]]) for k in here if k not in taken)
        open_ridges = still
    closed.extend(Ridge(r[0], np.array(r[1]), np.array(r[2])) for r in open_ridges)
    return [r for r in _bridge(closed) if len(r.d) >= MIN_STATIONS]


def separate(ridges: list[Ridge]) -> list[Ridge]:
    """Cut the weaker of two ridges wherever they run closer than two lanes can."""
    kept: list[Ridge] = []
    for ridge in sorted(ridges, key=lambda r: -r.weight):
        free = np.ones(len(ridge.d), bool)
        for other in kept:
            low = max(ridge.first, other.first)
            high = min(ridge.first + len(ridge.d), other.first + len(other.d))
            if high > low:
                here = slice(low - ridge.first, high - ridge.first)
                there = slice(low - other.first, high - other.first)
                free[here] &= np.abs(ridge.d[here] - other.d[there]) >= MIN_SPACING_M
        # The longest free stretch remains; crumbs do not.
        edges = np.flatnonzero(np.diff(np.concatenate([[0], free.astype(np.int8), [0]])))
        runs = edges.reshape(-1, 2)
        if len(runs):
            a, b = runs[np.argmax(runs[:, 1] - runs[:, 0])]
            if b - a >= MIN_STATIONS:
                kept.append(Ridge(ridge.first + int(a), ridge.d[a:b], ridge.height[a:b]))
    return kept


def _next_offset(offsets: list[float]) -> float:
    """Where a ridge with these offsets goes next, by its slope over the last stations."""
    recent = offsets[-MIN_STATIONS:]
    return recent[-1] + (recent[-1] - recent[0]) / max(len(recent) - 1, 1)


def _bridge(ridges: list[Ridge]) -> list[Ridge]:
    """Join ridges that continue each other across a stretch where the crest was lost."""
    parts = sorted(ridges, key=lambda r: (r.first, r.d[0]))
    done: list[Ridge] = []
    while parts:
        ridge = parts.pop(0)
        while True:
            end = ridge.first + len(ridge.d)
            best = None
            for k, other in enumerate(parts):
                gap = other.first - end
                if 0 <= gap <= 2 * MIN_STATIONS:
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
