"""Ridges: lines along which many vehicles drive, in the density of traffic over (s, d)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from geoorbit_ros.lanes.profiles import Profiles

BIN_M = 0.2
ALONG_BLUR_STATIONS = 2.0
ALONG_REACH = 4
LINK_M = 1.0
"""A crest is found within this of where its slope leads from one station to the next."""
MIN_SPACING_M = 2.4
"""Closer bundles are one lane: lanes are 2.7 to 4.5 m wide (AASHTO Green Book; UK CD 127)."""
MIN_STATIONS = 4
BESIDE_M = 5.5
"""Ridges closer than this are neighbouring lanes."""
PARALLEL = 0.02
"""Typical slope between two ridges that are lanes of one road."""


@dataclass(frozen=True, slots=True)
class Density:
    """Vehicles per metre of width, (J stations, B bins).

    Attributes:
        offset_m: (B,) bin centres, metres left of the spine.
        value: (J, B).
    """

    offset_m: NDArray[np.float64]
    value: NDArray[np.float64]


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


def lateral_density(profiles: Profiles, blur_m: float, trust: NDArray[np.float64]) -> Density:
    """Density of vehicles over stations and lateral offset, smoothed by Gaussians.

    Args:
        profiles: Lateral positions.
        blur_m: 1-sigma of the lateral kernel.
        trust: (V, J) factor on each vehicle's weight at each station.
    """
    row, j = np.nonzero(profiles.seen)
    d, slope = profiles.d[row, j], profiles.slope[row, j]
    weight = profiles.weight[row] * trust[row, j]
    margin = 4.0 * blur_m + BIN_M
    # Bin edges are tied to the data, not to the spine: a shifted spine gives shifted bins.
    low = d.min() - margin
    bins = int(np.ceil((d.max() + margin - low) / BIN_M)) + 1
    stations = len(profiles.station_m)
    grid = np.zeros(stations * bins)
    # Along the road each vehicle is blurred in its own direction: ramps stay as sharp as lanes.
    shifts = np.arange(-ALONG_REACH, ALONG_REACH + 1)
    shares = np.exp(-0.5 * (shifts / ALONG_BLUR_STATIONS) ** 2)
    for shift, share in zip(shifts, shares / shares.sum(), strict=True):
        at = (d + slope * shift * profiles.step_m - low) / BIN_M
        left = np.floor(at).astype(np.int64)
        use = (j + shift >= 0) & (j + shift < stations) & (left >= 0) & (left < bins - 1)
        cell, part = (j[use] + shift) * bins + left[use], at[use] - left[use]
        grid += np.bincount(cell, share * weight[use] * (1.0 - part), len(grid))
        grid += np.bincount(cell + 1, share * weight[use] * part, len(grid))
    image = grid.reshape(stations, bins)
    image = gaussian_filter1d(image, blur_m / BIN_M, axis=1, mode="constant")
    return Density(low + BIN_M * np.arange(bins), image / BIN_M)


def find_ridges(density: Density, min_height: float, prominence: float) -> list[Ridge]:
    """Trace the crests of the density from station to station.

    Args:
        density: Vehicles per metre over (s, d).
        min_height: Crests lower than this are noise, vehicles per metre.
        prominence: A crest must rise above the saddle to a higher neighbour by this share.
    """
    open_ridges: list[tuple[int, list[float], list[float]]] = []
    closed: list[Ridge] = []
    inner = density.value[:, 1:-1]
    crest = (inner > density.value[:, :-2]) & (inner >= density.value[:, 2:])
    crest &= inner >= min_height
    for j, line in enumerate(density.value):
        k = np.flatnonzero(crest[j]) + 1
        peak_d, peak_h = _prominent(line, k, density.offset_m, prominence)
        taken = np.zeros(len(peak_d), bool)
        last = np.array([_next_offset(ridge[1]) for ridge in open_ridges])
        still: list[tuple[int, list[float], list[float]]] = []
        gap = np.abs(last[:, None] - peak_d[None, :])
        for i, ridge in enumerate(open_ridges):
            best = int(np.argmin(gap[i])) if len(peak_d) else -1
            if best >= 0 and gap[i, best] <= LINK_M and int(np.argmin(gap[:, best])) == i:
                ridge[1].append(float(peak_d[best]))
                ridge[2].append(float(peak_h[best]))
                taken[best] = True
                still.append(ridge)
            else:
                closed.append(Ridge(ridge[0], np.array(ridge[1]), np.array(ridge[2])))
        still.extend(
            (j, [float(d)], [float(h)]) for d, h in zip(peak_d[~taken], peak_h[~taken], strict=True)
        )
        open_ridges = still
    closed.extend(Ridge(r[0], np.array(r[1]), np.array(r[2])) for r in open_ridges)
    return [r for r in _bridge(closed) if len(r.d) >= MIN_STATIONS]


def hand_over(ridges: list[Ridge], stations: int) -> list[Ridge]:
    """Where two ridges run together, give what follows to the one that goes straight on.

    At a merge the crests of ramp and lane melt into one, and the tracing may leave the common
    crest to the ramp. Seen against the traffic, the same happens at a diverge.

    Args:
        ridges: Traced crests.
        stations: Number of stations of the corridor.
    """
    forward = _give_tails(ridges)
    backward = _give_tails([_mirrored(r, stations) for r in forward])
    return [_mirrored(r, stations) for r in backward]


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


def _prominent(
    line: NDArray[np.float64],
    k: NDArray[np.int64],
    offset: NDArray[np.float64],
    prominence: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions and heights of those maxima `k` of one station's density that are prominent."""
    while len(k) > 1:
        saddle = np.array([line[a : b + 1].min() for a, b in itertools.pairwise(k)])
        lower = np.minimum(line[k[:-1]], line[k[1:]])
        depth = 1.0 - saddle / lower
        worst = int(np.argmin(depth))
        if depth[worst] >= prominence:
            break
        k = np.delete(k, worst if line[k[worst]] < line[k[worst + 1]] else worst + 1)
    below, at, above = line[k - 1], line[k], line[k + 1]
    curve = below - 2.0 * at + above
    shift = np.where(curve < 0.0, 0.5 * (below - above) / np.where(curve < 0.0, curve, -1.0), 0.0)
    return offset[k] + shift * BIN_M, at


def lane_directions(ridges: list[Ridge], step_m: float) -> list[NDArray[np.float64]]:
    """Slope dd/ds of driving along each ridge.

    Where vehicles leave or enter a lane side by side with another, the crest follows them; there
    the lane's direction is that of its strongest parallel neighbour.

    Args:
        ridges: Candidate lanes.
        step_m: Distance between stations.
    """
    slopes = [np.gradient(r.d, step_m) for r in ridges]
    result = []
    for own, slope in zip(ridges, slopes, strict=True):
        direction = slope.copy()
        best = np.where(own.height > 0.0, own.weight, 0.0)
        for other, other_slope in zip(ridges, slopes, strict=True):
            low = max(own.first, other.first)
            high = min(own.first + len(own.d), other.first + len(other.d))
            if other is own or high - low < 2 * MIN_STATIONS:
                continue
            here = slice(low - own.first, high - own.first)
            there = slice(low - other.first, high - other.first)
            beside = np.abs(own.d[here] - other.d[there]) <= BESIDE_M
            if np.median(np.abs(slope[here] - other_slope[there])) > PARALLEL or not beside.any():
                continue
            better = beside & (other.weight > best[here])
            direction[here] = np.where(better, other_slope[there], direction[here])
            best[here] = np.where(better, other.weight, best[here])
        result.append(direction)
    return result


def _mirrored(ridge: Ridge, stations: int) -> Ridge:
    first = stations - ridge.first - len(ridge.d)
    return Ridge(first, ridge.d[::-1], ridge.height[::-1])


def _give_tails(ridges: list[Ridge]) -> list[Ridge]:
    result = list(ridges)
    for i, ending in enumerate(result):
        for k, going in enumerate(result):
            if i == k or (found := _junction(ending, going)) is None:
                continue
            cut = found - going.first
            end = ending.first + len(ending.d)
            share = np.linspace(0.0, 1.0, found - end + 2)[1:-1]
            between = ending.d[-1] + share * (going.d[cut] - ending.d[-1])
            result[i] = Ridge(
                ending.first,
                np.concatenate([ending.d, between, going.d[cut:]]),
                np.concatenate([ending.height, np.zeros(len(between)), going.height[cut:]]),
            )
            result[k] = Ridge(going.first, going.d[:cut], going.height[:cut])
            break
    return result


def _junction(ending: Ridge, going: Ridge) -> int | None:
    """Station at which `going` has come onto the straight continuation of `ending`, if it has."""
    end = ending.first + len(ending.d)
    if min(len(ending.d), end - going.first) < 2 * MIN_STATIONS:
        return None
    if going.first + len(going.d) < end + MIN_STATIONS:
        return None
    if abs(going.d[end - 1 - going.first] - ending.d[-1]) > MIN_SPACING_M:
        return None
    # The last stations before the crests melt are already drawn to each other.
    later = np.arange(end, min(going.first + len(going.d), end + 5 * MIN_STATIONS))
    after = going.d[later - going.first]
    own = np.abs(after - _continued(going, going.first, end - MIN_STATIONS, later))
    other = np.abs(after - _continued(ending, ending.first, end - MIN_STATIONS, later))
    near = np.flatnonzero(other < 0.3 * MIN_SPACING_M)
    if len(near) == 0 or other[near[0] :].mean() >= own[near[0] :].mean():
        return None
    return int(later[near[0]])


def _continued(ridge: Ridge, first: int, last: int, at: NDArray[np.int64]) -> NDArray[np.float64]:
    """A ridge's straight continuation, from its stations before `last`."""
    base = np.arange(max(first, last - 3 * MIN_STATIONS), last)
    slope, offset = np.polyfit(base, ridge.d[base - ridge.first], 1)
    return np.asarray(slope * at + offset)


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
