"""Where ridges meet: which one goes on at a merge or diverge, and which way its traffic drives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.estimators.curvilinear.grouped import quantile
from geoorbit_ros.lanes.estimators.curvilinear.ridges import MIN_SPACING_M, MIN_STATIONS, Ridge

BESIDE_M = 5.5
"""Ridges closer than this are neighbouring lanes. Chosen: wider than any lane (4.5 m) with its
drivers' offsets; larger takes lanes beyond a shoulder for neighbours."""
PARALLEL = 0.02
"""Slope between two ridges up to which they are lanes of one road: 1 m in 50 m. Chosen: larger
takes ramps for lanes beside the road, smaller misses lanes whose width changes."""
SPLIT_M = 1.5 * MIN_SPACING_M
"""Largest spacing of two ridges where they join into one. Chosen: larger joins lanes that only run
near each other, smaller misses a split of wide lanes."""
LANE_CHANGE = 5 * MIN_STATIONS
"""Stations, over three seconds of travel, within which vehicles have changed lanes. Chosen: longer
compares with the road farther on, shorter with vehicles still on their way across."""


def hand_over(ridges: list[Ridge], stations: int) -> list[Ridge]:
    """Where two ridges run together, give what follows to the one that goes straight on.

    At a merge the ridges of ramp and lane join into one, and the tracing may leave the common
    part to the ramp. Seen against the traffic, the same happens at a diverge. Where one lane
    becomes two, neither may go straight: by chance either could get the ridge of the
    one lane, so it is given to the one that keeps its offset from the road.

    Args:
        ridges: As traced.
        stations: Number of stations of the corridor.
    """
    forward = _give_tails(ridges)
    backward = _give_tails([_mirrored(r, stations) for r in forward])
    return [_mirrored(r, stations) for r in backward]


def lane_directions(ridges: list[Ridge], step_m: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Slope dd/ds of driving along each ridge.

    Where vehicles leave or enter a lane side by side with another, the ridge follows them; there
    the lane's direction is that of its strongest parallel neighbour.

    Args:
        ridges: Candidate lanes.
        step_m: (J,) distance between stations.
    """
    slopes = [_gradient(r.d) / step_m[r.first] for r in ridges]
    result = []
    for own, slope in zip(ridges, slopes, strict=True):
        direction = slope.copy()
        best = np.where(own.height > 0.0, own.weight, 0.0)
        for other, other_slope in zip(ridges, slopes, strict=True):
            if other.weight <= own.weight:
                continue
            low = max(own.first, other.first)
            high = min(own.end, other.end)
            if high - low < 2 * MIN_STATIONS:
                continue
            here = slice(low - own.first, high - own.first)
            there = slice(low - other.first, high - other.first)
            beside = np.abs(own.d[here] - other.d[there]) <= BESIDE_M
            if not beside.any():
                continue
            if quantile(np.abs(slope[here] - other_slope[there]), 0.5) > PARALLEL:
                continue
            better = beside & (other.weight > best[here])
            direction[here] = np.where(better, other_slope[there], direction[here])
            best[here] = np.where(better, other.weight, best[here])
        result.append(direction)
    return result


def _gradient(value: NDArray[np.float64]) -> NDArray[np.float64]:
    """Per station, as np.gradient, at a fifth of its time."""
    step = np.diff(value)
    return np.concatenate([step[:1], 0.5 * (step[1:] + step[:-1]), step[-1:]])


def is_alone(ridge: Ridge, ridges: list[Ridge]) -> bool:
    """Whether no other ridge runs beside this one anywhere."""
    for other in ridges:
        low = max(ridge.first, other.first)
        high = min(ridge.end, other.end)
        if other is ridge or high <= low:
            continue
        gap = ridge.d[low - ridge.first : high - ridge.first]
        gap = np.abs(gap - other.d[low - other.first : high - other.first])
        if gap.min() <= BESIDE_M:
            return False
    return True


def _mirrored(ridge: Ridge, stations: int) -> Ridge:
    first = stations - ridge.first - len(ridge.d)
    return Ridge(first, ridge.d[::-1], ridge.height[::-1])


def _give_tails(ridges: list[Ridge]) -> list[Ridge]:
    result = list(ridges)
    for i, ending in enumerate(result):
        for k, going in enumerate(result):
            if i == k or not _goes_on(ending, going):
                continue
            end, split = ending.end, _split(ending, going)
            found = _junction(ending, going) if split is None else split
            if found is None:
                continue
            left = found if split is None else _apart(ending, going)
            cut = found - going.first
            share = np.linspace(0.0, 1.0, found - end + 2)[1:-1]
            between = ending.d[-1] + share * (going.d[cut] - ending.d[-1])
            result[i] = Ridge(
                ending.first,
                np.concatenate([ending.d, between, going.d[cut:]]),
                np.concatenate([ending.height, np.zeros(len(between)), going.height[cut:]]),
            )
            left -= going.first
            result[k] = Ridge(going.first, going.d[:left], going.height[:left])
            break
    return result


def _goes_on(ending: Ridge, going: Ridge) -> bool:
    """Whether one ridge runs long enough beside another before that ends, and after."""
    begin = max(ending.first, going.first)
    return begin + 2 * MIN_STATIONS <= ending.end <= going.end - MIN_STATIONS


def _junction(ending: Ridge, going: Ridge) -> int | None:
    """Station at which `going` has come onto the straight continuation of `ending`, if it has."""
    end = ending.end
    if abs(going.d[end - 1 - going.first] - ending.d[-1]) > MIN_SPACING_M:
        return None
    # The last stations before the ridges join are already drawn to each other.
    later = np.arange(end, min(going.end, end + LANE_CHANGE))
    after = going.d[later - going.first]
    own = np.abs(after - _continued(going, going.first, end - MIN_STATIONS, later))
    other = np.abs(after - _continued(ending, ending.first, end - MIN_STATIONS, later))
    near = np.flatnonzero(other < 0.3 * MIN_SPACING_M)
    if len(near) == 0 or other[near[0] :].mean() >= own[near[0] :].mean():
        return None
    return int(later[near[0]])


def _split(ending: Ridge, going: Ridge) -> int | None:
    """Station from which on the common ridge is the lane of `ending`, if it keeps nearer to it.

    Vehicles on their way across draw out the ridge's bend, so that neither ridge leads straight to
    it. Offsets are compared before the ridges bend and after.
    """
    end = ending.end
    if abs(going.d[end - 1 - going.first] - ending.d[-1]) > SPLIT_M:
        return None
    if _apart(ending, going) < going.first + MIN_STATIONS:  # nothing would be left of `going`
        return None
    found = min(going.end, end + LANE_CHANGE) - MIN_STATIONS
    after = float(going.d[found - going.first :][:MIN_STATIONS].mean())
    shift = [abs(after - _settled(r, max(ending.first, going.first), end)) for r in (ending, going)]
    return found if shift[0] < min(shift[1], MIN_SPACING_M) else None


def _apart(ending: Ridge, going: Ridge) -> int:
    """Station until which `going` is at least a lane away from `ending`."""
    first = max(ending.first, going.first)
    gap = going.d[first - going.first : ending.end - going.first] - ending.d[first - ending.first :]
    lanes = np.flatnonzero(np.abs(gap) >= MIN_SPACING_M)
    return first + int(lanes[-1]) + 1 if len(lanes) else first


def _settled(ridge: Ridge, first: int, end: int) -> float:
    """A ridge's offset before its last stations until `end`, which bend."""
    base = np.arange(max(first, end - LANE_CHANGE), max(first, end - 2 * MIN_STATIONS) + 1)
    return quantile(ridge.d[base - ridge.first], 0.5)


def _continued(ridge: Ridge, first: int, last: int, at: NDArray[np.int64]) -> NDArray[np.float64]:
    """A ridge's straight continuation, from its stations before `last`."""
    base = np.arange(max(first, last - 3 * MIN_STATIONS), last)
    d = ridge.d[base - ridge.first]
    away = base - base.mean()
    slope = float(away @ d) / float(away @ away)
    return np.asarray(d.mean() + slope * (at - base.mean()))
