"""Density of traffic over a corridor's (s, d), and the crests in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from geoorbit_ros.lanes.profiles import Profiles

BIN_M = 0.2
ALONG_BLUR_STATIONS = 2.0
ALONG_REACH = 4


@dataclass(frozen=True, slots=True)
class Density:
    """Vehicles per metre of width, (J stations, B bins).

    Attributes:
        offset_m: (B,) bin centres, metres left of the spine.
        value: (J, B).
    """

    offset_m: NDArray[np.float64]
    value: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Crests:
    """Prominent maxima across the road, ordered by station, then by offset.

    Attributes:
        first: (J + 1,) the crests of station j are `slice(first[j], first[j + 1])`.
        d: (C,) offset, metres left of the spine.
        height: (C,) vehicles per metre.
    """

    first: NDArray[np.int64]
    d: NDArray[np.float64]
    height: NDArray[np.float64]


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
    # Along the road each vehicle is blurred in its own direction: ramps stay as sharp as lanes.
    shift = np.arange(-ALONG_REACH, ALONG_REACH + 1)
    share = np.exp(-0.5 * (shift / ALONG_BLUR_STATIONS) ** 2)
    share /= share.sum()
    at = (d - low + np.multiply.outer(shift * profiles.step_m, slope)) / BIN_M
    left = at.astype(np.int64)
    station = j + shift[:, None]
    use = (station >= 0) & (station < stations) & (at >= 0.0) & (left < bins - 1)
    cell, part = (station * bins + left)[use], (at - left)[use]
    mass = np.multiply.outer(share, weight)[use]
    grid = np.bincount(cell, mass * (1.0 - part), stations * bins)
    grid += np.bincount(cell + 1, mass * part, stations * bins)
    image = grid.reshape(stations, bins)
    image = gaussian_filter1d(image, blur_m / BIN_M, axis=1, mode="constant", truncate=3.0)
    return Density(low + BIN_M * np.arange(bins), image / BIN_M)


def find_crests(density: Density, min_height: float, prominence: float) -> Crests:
    """Maxima across the road that stand out from their neighbours.

    Args:
        density: Vehicles per metre over (s, d).
        min_height: Crests lower than this are noise, vehicles per metre.
        prominence: Of two neighbours the lower one must rise above the saddle by this share.
    """
    value = density.value
    inner = value[:, 1:-1]
    crest = (inner > value[:, :-2]) & (inner >= value[:, 2:]) & (inner >= min_height)
    station, column = np.nonzero(crest)
    column += 1
    flat, bins = value.ravel(), value.shape[1]
    k = station * bins + column
    while len(k) > 1:
        height = flat[k]
        saddle = np.minimum.reduceat(flat, k)[:-1]
        depth = 1.0 - saddle / np.minimum(height[:-1], height[1:])
        depth[np.diff(k // bins) != 0] = np.inf
        # The shallowest saddle among its neighbours goes first, and with it the lower crest.
        before, after = np.append(np.inf, depth[:-1]), np.append(depth[1:], np.inf)
        shallow = np.flatnonzero((depth < prominence) & (depth <= before) & (depth < after))
        if len(shallow) == 0:
            break
        k = np.delete(k, shallow + (height[shallow] >= height[shallow + 1]))
    below, at, above = flat[k - 1], flat[k], flat[k + 1]
    curve = np.minimum(below - 2.0 * at + above, -1e-12)
    shift = np.clip(0.5 * (below - above) / curve, -0.5, 0.5)
    first = np.searchsorted(k // bins, np.arange(len(value) + 1))
    return Crests(first, density.offset_m[k % bins] + BIN_M * shift, at)
