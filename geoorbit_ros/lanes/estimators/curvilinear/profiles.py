"""Lateral profiles: where each vehicle drives, at fixed stations along its corridor.

All corridors share one table: their stations follow each other, with `GAP_STATIONS` empty ones
between, more than anything reaches along the road. So every later step runs once for all of them
and need not know where one corridor ends and the next begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.estimators.curvilinear.corridors import Corridor
from geoorbit_ros.lanes.estimators.curvilinear.grouped import changes, lengths, totals
from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import TrajectorySegments

STATIONS_PER_SCALE = 4
"""Chosen: more cost time, fewer miss where ridges part."""
GAP_STATIONS = 16
"""Empty stations between two corridors: more than any step reaches along the road. More only take
memory."""
KERNEL_SHARE = 0.6
"""Half-width of the regression kernel as a share of the corridor's scale. Chosen: wider straightens
lane changes, narrower passes on the noise of single boxes."""
KERNEL_REACH = 2
"""Stations to either side within the kernel: 0.6 of a scale of four stations, rounded down."""
SLOPE_PRIOR = 0.15
"""1-sigma of a vehicle's slope against the reference line, 9 degrees: keeps a slope from two nodes
possible. Chosen: larger allows wild slopes, smaller flattens lane changes."""
DRIVER_NOISE_M = 0.1
"""Least lateral error of a node, since nobody steers more exactly. Chosen: larger levels good and
bad nodes, smaller lets one node decide alone."""


@dataclass(frozen=True, slots=True)
class Profiles:
    """V trajectory segments in their corridors, sampled S times in all at J stations.

    A segment in two corridors has two rows. Samples are ordered by row, then by station.

    Attributes:
        corridor: (J,) number of each station's corridor; half the gap on either side is its own.
        station_m: (J,) arc length of each station along its corridor's reference line, metres.
        step_m: (J,) distance to the next station of the corridor.
        scale_m: (J,) the corridor's scale.
        segment: (V,) index of each row's segment.
        t_ref_s: (V,) time at which the vehicle is, or would be, at the corridor's middle.
        weight: (V,) weight of the segment as evidence.
        row: (S,) the vehicle of each sample.
        station: (S,) where it was seen.
        d: (S,) lateral position, metres to the left of the reference line.
        slope: (S,) dd/ds.
    """

    corridor: NDArray[np.int64]
    station_m: NDArray[np.float64]
    step_m: NDArray[np.float64]
    scale_m: NDArray[np.float64]
    segment: NDArray[np.int64]
    t_ref_s: NDArray[np.float64]
    weight: NDArray[np.float64]
    row: NDArray[np.int64]
    station: NDArray[np.int64]
    d: NDArray[np.float64]
    slope: NDArray[np.float64]


def lateral_profiles(
    corridors: Sequence[Corridor], segments: TrajectorySegments, segment_weight: NDArray[np.float64]
) -> Profiles:
    """Local linear regression of d on s, per vehicle and station.

    Args:
        corridors: Nodes with road coordinates; at least one corridor, none empty.
        segments: The segments that the nodes belong to.
        segment_weight: (P,) weight of each segment.
    """
    scale = np.array([c.scale_m for c in corridors])
    step = scale / STATIONS_PER_SCALE
    # A vehicle counts at stations up to the kernel's reach beyond its own ends.
    low = np.floor([c.s.min() / m for c, m in zip(corridors, step, strict=True)]) - KERNEL_REACH
    high = np.ceil([c.s.max() / m for c, m in zip(corridors, step, strict=True)]) + KERNEL_REACH
    count = (high - low).astype(np.int64) + 1 + GAP_STATIONS
    base = GAP_STATIONS // 2 + np.append(0, np.cumsum(count)[:-1])
    owner = np.repeat(np.arange(len(corridors)), count)
    station_m = (np.arange(len(owner)) - base[owner] + low[owner]) * step[owner]

    k = np.repeat(np.arange(len(corridors)), [len(c.node) for c in corridors])
    node = np.concatenate([c.node for c in corridors])
    s = np.concatenate([c.s for c in corridors])
    d = np.concatenate([c.d for c in corridors])
    which = segments.owner[node]
    new = changes(which) | changes(k)
    first, row = np.flatnonzero(new), np.cumsum(new) - 1
    place = s / step[k] - low[k]
    seen, row_d, row_slope = _regress(
        place,
        d,
        step[k],
        row,
        segments.sigma[node] ** 2 + DRIVER_NOISE_M**2,
        int((high - low).max()) + 1,
    )
    inside = np.arange(seen.shape[1]) >= np.minimum.reduceat(place, first)[:, None] - 0.5
    inside &= np.arange(seen.shape[1]) <= np.maximum.reduceat(place, first)[:, None] + 0.5
    sample_row, at = np.nonzero(seen & inside)
    middle_m = (0.5 * (low + high) * step)[k[first]]
    return Profiles(
        owner,
        station_m,
        step[owner],
        scale[owner],
        which[first],
        _time_at(row, first, s, segments.time_s[node], middle_m),
        segment_weight[which[first]],
        sample_row,
        base[k[first]][sample_row] + at,
        row_d[sample_row, at],
        row_slope[sample_row, at],
    )


def _regress(
    place: NDArray[np.float64],
    d: NDArray[np.float64],
    step_m: NDArray[np.float64],
    row: NDArray[np.int64],
    variance: NDArray[np.float64],
    stations: int,
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Whether there is enough to tell, d and dd/ds, (rows, stations) each.

    Args:
        place: (N,) where each node is, in stations of its corridor.
        d: (N,) its offset.
        step_m: (N,) distance between stations.
        row: (N,) its vehicle, ascending.
        variance: (N,) of its offset.
        stations: Number of stations of the longest corridor.
    """
    j = np.rint(place).astype(np.int64) + np.arange(-KERNEL_REACH, KERNEL_REACH + 1)[:, None]
    u = place - j
    share = np.abs(u) * (1.0 / (KERNEL_SHARE * STATIONS_PER_SCALE))
    kernel = np.maximum(1.0 - share * share * share, 0.0)
    weight = kernel * kernel * kernel / variance
    u *= step_m
    cell = (j + stations * row).ravel()
    shape = (int(row[-1]) + 1, stations)

    def total(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return totals(cell, values.ravel(), shape[0] * shape[1]).reshape(shape)

    moment = weight * u
    s0, s1, s2 = total(weight), total(moment), total(moment * u)
    t0, t1 = total(weight * d), total(moment * d)
    known = total((kernel > 0.0).astype(np.float64)) >= 2.0
    s0[~known] = np.inf
    mean_u, mean_d = s1 / s0, t0 / s0
    slope = (t1 - t0 * mean_u) / (s2 - s1 * mean_u + SLOPE_PRIOR**-2)
    return known, mean_d - slope * mean_u, slope


def _time_at(
    row: NDArray[np.int64],
    first: NDArray[np.int64],
    s: NDArray[np.float64],
    time_s: NDArray[np.float64],
    s_ref: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(V,) time of each vehicle at its `s_ref` (V,), extrapolated with its mean speed."""
    count = lengths(first, len(row))
    s_mean = np.add.reduceat(s, first) / count
    t_mean = np.add.reduceat(time_s, first) / count
    ds, dt = s - s_mean[row], time_s - t_mean[row]
    pace = np.add.reduceat(ds * dt, first) / np.maximum(np.add.reduceat(ds * ds, first), 1e-6)
    return np.asarray(t_mean + pace * (s_ref - s_mean))
