"""Lateral profiles: where each vehicle drives, at fixed stations along its corridor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.corridors import Corridor
from geoorbit_ros.lanes.passes import Passes

STATIONS_PER_SCALE = 4
KERNEL_SHARE = 0.6
"""Half-width of the regression kernel as a share of the corridor's scale."""
SLOPE_PRIOR = 0.15
"""1-sigma of a vehicle's slope against the spine; keeps the regression of two nodes sane."""
DRIVER_NOISE_M = 0.1
"""Floor on a node's lateral error: steering is not a ruler."""


@dataclass(frozen=True, slots=True)
class Profiles:
    """V vehicle passes sampled at J stations of one corridor.

    Attributes:
        station_m: (J,) arc length of the stations, evenly spaced.
        passes: (V,) index of each row's pass.
        seen: (V, J) bool, the vehicle was observed here.
        d: (V, J) lateral position, metres to the left of the spine; 0 where not seen.
        slope: (V, J) dd/ds.
        t_ref_s: (V,) time at which the vehicle is, or would be, at the corridor's middle.
        weight: (V,) worth of the pass as evidence.
    """

    station_m: NDArray[np.float64]
    passes: NDArray[np.int64]
    seen: NDArray[np.bool_]
    d: NDArray[np.float64]
    slope: NDArray[np.float64]
    t_ref_s: NDArray[np.float64]
    weight: NDArray[np.float64]

    @property
    def step_m(self) -> float:
        """Distance between stations."""
        return float(self.station_m[1] - self.station_m[0])


def lateral_profiles(
    corridor: Corridor, passes: Passes, pass_weight: NDArray[np.float64]
) -> Profiles:
    """Local linear regression of d on s, per vehicle and station.

    Args:
        corridor: Nodes with road coordinates.
        passes: The passes that the nodes belong to.
        pass_weight: (P,) worth of each pass.
    """
    ids, row = np.unique(passes.pass_of_node()[corridor.node], return_inverse=True)
    step = corridor.scale_m / STATIONS_PER_SCALE
    first = np.floor(corridor.s.min() / step)
    station = np.arange(first, np.ceil(corridor.s.max() / step) + 2) * step
    n, j_max = len(ids), len(station)

    half = KERNEL_SHARE * corridor.scale_m
    reach = int(np.ceil(half / step))
    nearest = np.rint(corridor.s / step - first).astype(np.int64)
    precision = 1.0 / (passes.sigma[corridor.node] ** 2 + DRIVER_NOISE_M**2)
    sums = np.zeros((6, n * j_max))
    for shift in range(-reach, reach + 1):
        j = nearest + shift
        u = corridor.s - (first + j) * step
        kernel = np.clip(1.0 - np.abs(u / half) ** 3, 0.0, None) ** 3
        use = (kernel > 0.0) & (j >= 0) & (j < j_max)
        cell = (row * j_max + j)[use]
        w, uu, dd = (kernel * precision)[use], u[use], corridor.d[use]
        for k, value in enumerate((w, w * uu, w * uu * uu, w * dd, w * uu * dd, np.ones(len(w)))):
            sums[k] += np.bincount(cell, value, n * j_max)
    s0, s1, s2, t0, t1, count = sums.reshape(6, n, j_max)
    s0 = np.where(s0 > 0.0, s0, np.inf)
    mean_u, mean_d = s1 / s0, t0 / s0
    spread = np.where(np.isinf(s0), 0.0, s2 - s1 * mean_u)
    slope = (t1 - t0 * mean_u) / (spread + SLOPE_PRIOR**-2)
    d = mean_d - slope * mean_u

    order = np.lexsort((corridor.s, row))
    begin = np.searchsorted(row[order], np.arange(n))
    end = np.append(begin[1:], len(order)) - 1
    s_low, s_high = corridor.s[order][begin], corridor.s[order][end]
    inside = station[None, :] >= (s_low - 0.5 * step)[:, None]
    inside &= station[None, :] <= (s_high + 0.5 * step)[:, None]
    seen = inside & (count >= 2)

    time_s = passes.time_s[corridor.node]
    return Profiles(
        station,
        ids,
        seen,
        np.where(seen, d, 0.0),
        np.where(seen, slope, 0.0),
        _time_at(row, n, corridor.s, time_s, 0.5 * (station[0] + station[-1])),
        pass_weight[ids],
    )


def _time_at(
    row: NDArray[np.int64],
    n: int,
    s: NDArray[np.float64],
    time_s: NDArray[np.float64],
    s_ref: float,
) -> NDArray[np.float64]:
    """(n,) time at `s_ref`, extrapolated with each vehicle's mean speed."""
    count = np.bincount(row, minlength=n)
    s_mean = np.bincount(row, s, n) / count
    t_mean = np.bincount(row, time_s, n) / count
    ds, dt = s - s_mean[row], time_s - t_mean[row]
    pace = np.bincount(row, ds * dt, n) / np.maximum(np.bincount(row, ds * ds, n), 1e-6)
    return np.asarray(t_mean + pace * (s_ref - s_mean))
