"""The true lanes of real traffic, counted on the road: no map and no lane detector has a say.

On a straight carriageway whose lanes somebody has counted, vehicles lie across the road in as many
heaps, and a vehicle's true lane is the number of its heap from the right. The heaps are a mixture
of as many normal distributions (Dempster, Laird and Rubin 1977, EM) over the places across the road
of a whole recording, each place the median over a second of the vehicle's way, past and future, of
which the twin knows the past alone. A line of the map gives the direction along the road,
and nothing else.

Where the place lies nearer to the line between two heaps than the median's own error, no evidence
says which lane is the true one. Such steps are counted like all others, and reported.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.polylines import project
from geoorbit_ros.roadnet.network import RoadNetwork
from geoorbit_ros.twin.placement import TwinStep
from scores.twin_truth import CROSSING_S, LaneCount

SMOOTH_S = 1.0
"""A vehicle's place across the road is a median over so long; who is seen for less has none."""
OUTER_SIGMAS = 3.0
"""A vehicle farther outside of the outermost heaps is on a ramp, a shoulder, or nowhere."""
FAR_M, SAME_WAY = 25.0, 0.7
"""Farther from the edge, or at a greater angle to it (cosine), a vehicle is on another road."""
MEDIAN_ERROR = 1.4826 * 1.2533
"""Of normal values, the median's standard error times the root of their number, per median absolute
deviation."""
ROUNDS = 200
STRETCH_M = 20.0
VEHICLES_PER_LANE = 5
"""Over a stretch that fewer have driven, nothing says where the heaps are."""


@dataclass(slots=True)
class Count(LaneCount):
    """Vehicle steps.

    Attributes:
        unsure_right, unsure_wrong: Of `right` and `wrong`, those whose true lane nobody can know.
        left_out: On no lane that was counted, seen too shortly, or where too few drove to tell.
    """

    unsure_right: int = 0
    unsure_wrong: int = 0
    left_out: int = 0


class CountedLanes:
    """Gathers a twin's steps and counts those in their lanes at the end.

    Args:
        network: The twin's.
        lanes: How many lanes were counted on each edge in view, by SUMO's id.
    """

    def __init__(self, network: RoadNetwork, lanes: Mapping[str, int]) -> None:
        self._network, self._lanes = network, lanes
        self._steps: list[tuple[NDArray[np.float64], ...]] = []

    def take(self, step: TwinStep) -> None:
        """Remember one step's vehicles that a camera sees."""
        seen = step.observed & np.isfinite(step.xy[:, 0])
        time_s = np.full(int(seen.sum()), step.stamp_ns * 1e-9)
        columns = (step.vehicle_id, step.wanted_xy, step.wanted_heading_rad, step.lane)
        self._steps.append((time_s, *(c[seen].astype(np.float64) for c in columns)))

    def total(self) -> Count:
        """All steps."""
        columns = [np.concatenate(parts) for parts in zip(*self._steps, strict=True)]
        network, count = self._network, Count(left_out=len(columns[0]))
        for edge, lanes in self._lanes.items():
            line = network.line(network.number[f"{edge}_0"])
            foot = project(columns[2], line)
            way = np.sum(foot.tangent.T * [np.cos(columns[3]), np.sin(columns[3])], axis=0)
            mine = foot.inside & (np.abs(foot.offset_m) < FAR_M) & (way > SAME_WAY)
            time_s, vehicle, _, _, found = (column[mine] for column in columns)
            order = np.lexsort((time_s, vehicle))
            way_of = _Ways(vehicle[order], time_s[order])
            place, error_m, whole = way_of.smoothed(foot.offset_m[mine][order])
            trend_m, vehicles = way_of.trend(foot.arc_m[mine][order], place)
            place -= trend_m
            known = whole & (vehicles >= VEHICLES_PER_LANE * lanes)
            mean, sigma_m = heaps(place[known], lanes)
            outer_m = OUTER_SIGMAS * sigma_m
            on = known & (place > mean[0] - outer_m) & (place < mean[-1] + outer_m)
            lines = 0.5 * (mean[1:] + mean[:-1])
            true = np.searchsorted(lines, place)
            unsure = np.abs(place[:, None] - lines).min(axis=1) < error_m
            names = [f"{edge}_{k}" for k in range(lanes)]
            right = found[order] == np.array([network.number[name] for name in names])[true]
            crossing = way_of.near_changes(true)
            count.unsure_right += int(np.count_nonzero(on & right & ~crossing & unsure))
            count.unsure_wrong += int(np.count_nonzero(on & ~right & ~crossing & unsure))
            count.left_out -= int(np.count_nonzero(on))
            count.right += int(np.count_nonzero(on & right & ~crossing))
            count.wrong += int(np.count_nonzero(on & ~right & ~crossing))
            count.crossing_right += int(np.count_nonzero(on & right & crossing))
            count.crossing_wrong += int(np.count_nonzero(on & ~right & crossing))
        return count


def heaps(place_m: NDArray[np.float64], count: int) -> tuple[NDArray[np.float64], float]:
    """Means (count,), ascending, and common sigma of a mixture of places (N,) across a road.

    The heaps are about as far apart as lanes are; so the best of evenly spaced beginnings is taken.
    """
    best = (-np.inf, np.zeros(count), 0.0)
    for spacing_m in np.arange(3.0, 4.01, 0.25):
        for first_m in np.arange(place_m.min(), place_m.max() - (count - 1) * spacing_m, 0.5):
            best = max(
                best, _mixture(place_m, first_m + spacing_m * np.arange(count)), key=lambda b: b[0]
            )
    return best[1], best[2]


def _mixture(
    place_m: NDArray[np.float64], mean: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], float]:
    """Log likelihood, means and sigma after EM with a flat share for those on no lane."""
    sigma, share = 0.6, np.full(len(mean), 0.98 / len(mean))
    flat = 0.02 / max(float(np.ptp(place_m)), 1.0)
    likelihood = -np.inf
    for _ in range(ROUNDS):
        gap = (place_m[:, None] - mean) / sigma
        density = share * np.exp(-0.5 * gap**2) / (sigma * np.sqrt(2 * np.pi))
        total = density.sum(axis=1) + flat
        member = density / total[:, None]
        weight = np.maximum(member.sum(axis=0), 1e-9)
        mean = (member * place_m[:, None]).sum(axis=0) / weight
        spread = (member * (place_m[:, None] - mean) ** 2).sum() / weight.sum()
        sigma, share = max(float(np.sqrt(spread)), 0.1), 0.98 * weight / weight.sum()
        now = float(np.log(total).sum())
        if now - likelihood < 1e-3 * len(place_m) * 1e-3:
            break
        likelihood = now
    return likelihood, mean, sigma


class _Ways:
    """Rows ordered by vehicle and time."""

    def __init__(self, vehicle: NDArray[np.float64], time_s: NDArray[np.float64]) -> None:
        self._time_s = time_s
        bounds = np.flatnonzero(np.diff(vehicle)) + 1
        self._parts = np.split(np.arange(len(vehicle)), bounds)

    def smoothed(
        self, values: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Medians (N,) over the `SMOOTH_S` around each row of its vehicle, and whether it has one.

        At the ends of a way over its first or last `SMOOTH_S`. Second their 1-sigma errors (N,), as
        if the values had independent ones: the least they can be.
        """
        out, error = np.empty_like(values), np.empty_like(values)
        whole = np.zeros(len(values), dtype=np.bool_)
        for part in self._parts:
            time_s = self._time_s[part]
            whole[part] = time_s[-1] - time_s[0] >= SMOOTH_S - 1e-6
            last_s = max(time_s[-1] - SMOOTH_S, time_s[0])
            begin_s = np.clip(time_s - 0.5 * SMOOTH_S, time_s[0], last_s)[:, None] - 1e-6
            near = (time_s >= begin_s) & (time_s <= begin_s + SMOOTH_S + 2e-6)
            among = np.where(near, values[part], np.nan)
            out[part] = np.nanmedian(among, axis=1)
            spread = np.nanmedian(np.abs(among - out[part][:, None]), axis=1)
            error[part] = MEDIAN_ERROR * spread / np.sqrt(near.sum(axis=1))
        return out, error, whole

    def trend(
        self, arc_m: NDArray[np.float64], place_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """How far the whole traffic has moved sideways against the line, at every row (N,).

        The median slope of all ways, stretch by stretch; and how many drove there (N,).
        """
        at, slope = [], []
        edges = np.arange(arc_m.min(), arc_m.max() + STRETCH_M, STRETCH_M)
        stretch = np.clip(np.digitize(arc_m, edges) - 1, 0, len(edges) - 2)
        vehicles = np.zeros(len(edges) - 1, dtype=np.int64)
        for part in self._parts:
            vehicles[np.unique(stretch[part])] += 1
            run = np.diff(arc_m[part])
            moved = run > 0.1
            at.append((arc_m[part][1:] - 0.5 * run)[moved])
            slope.append((np.diff(place_m[part])[moved]) / run[moved])
        where, steep = np.concatenate(at), np.concatenate(slope)
        bins = np.digitize(where, edges[1:-1])
        median = [
            float(np.median(steep[bins == k])) if (bins == k).any() else 0.0
            for k in range(len(edges) - 1)
        ]
        height = np.append(0.0, np.cumsum(median) * STRETCH_M)
        return np.interp(arc_m, edges, height), vehicles[stretch]

    def near_changes(self, lane: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether rows are within `CROSSING_S` of a change of the same vehicle's lane."""
        flag = np.zeros(len(lane), dtype=np.bool_)
        for part in self._parts:
            changes = self._time_s[part][1:][np.diff(lane[part]) != 0]
            gap = np.abs(self._time_s[part][:, None] - changes).min(axis=1, initial=np.inf)
            flag[part] = gap <= CROSSING_S
        return flag
