"""Density of traffic over a corridor's (s, d), and its maxima across the road."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.lanes.estimators.curvilinear.grouped import totals
from geoorbit_ros.lanes.estimators.curvilinear.profiles import Profiles

BIN_M = 0.2
"""Width of a bin across the road. Chosen: less than half the lateral blur, so that the bins' edges
hardly show; smaller costs time."""
ALONG_BLUR_STATIONS = 2.0
"""1-sigma blur along the road, half a road scale. Chosen: larger hides where lanes begin, smaller
leaves ridges with gaps where few vehicles drive."""
ALONG_REACH = 4
"""Stations to either side that the blur reaches: two sigma. Chosen: more cost time, fewer cut the
Gaussian off."""
SPAN_M = 1000.0
"""Wider than any corridor: orders maxima by station, then by offset, in one number."""


@dataclass(frozen=True, slots=True)
class Density:
    """Vehicles per metre of width, (J stations, B bins).

    Attributes:
        offset_m: (B,) bin centres, metres left of the reference line.
        value: (J, B).
    """

    offset_m: NDArray[np.float64]
    value: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Maxima:
    """Prominent maxima across the road, ordered by station, then by offset.

    Attributes:
        station: (C,) where each maximum is.
        d: (C,) offset, metres left of the reference line.
        height: (C,) vehicles per metre.
    """

    station: NDArray[np.int64]
    d: NDArray[np.float64]
    height: NDArray[np.float64]

    def nearest(
        self, station: NDArray[np.int64], d: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The maximum nearest to each place (N,) and its distance, huge when there is none."""
        key, wanted = self.station * SPAN_M + self.d, station * SPAN_M + d
        above = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        below = np.maximum(above - 1, 0)
        up, down = np.abs(key[above] - wanted), np.abs(key[below] - wanted)
        return np.where(up < down, above, below), np.minimum(up, down)


class Raster:
    """Spreads samples over (s, d), smoothed by Gaussians.

    Args:
        profiles: Lateral positions.
        blur_m: 1-sigma of the lateral kernel.
    """

    def __init__(self, profiles: Profiles, blur_m: float) -> None:
        # Along the road each vehicle is blurred in its own direction: ramps stay as sharp as lanes.
        # Every other station will do: a vehicle's neighbouring samples tell nearly the same.
        shift = np.arange(-ALONG_REACH, ALONG_REACH + 1, 2)
        share = np.exp(-0.5 * (shift / ALONG_BLUR_STATIONS) ** 2)
        drift_m = profiles.slope * profiles.step_m[profiles.station]
        at = profiles.d + np.multiply.outer(shift, drift_m)
        # Bins begin at the data, so that a shifted reference line shifts them and nothing else.
        margin = 3.0 * blur_m + 2.0 * BIN_M
        # Detections may be so patchy that no vehicle counts at any station.
        low, high = (float(at.min()), float(at.max())) if at.size else (0.0, 0.0)
        low -= margin
        self._offset_m = np.arange(low, high + margin, BIN_M)
        bins = len(self._offset_m)
        at = (at - low) / BIN_M
        left = at.astype(np.int64)
        self._part = at - left
        self._cell = left + (profiles.station + shift[:, None]) * bins
        self._share = share / share.sum()
        self._shape = (len(profiles.station_m), bins)
        self._blur = blur_m / BIN_M

    def density(self, weight: NDArray[np.float64]) -> Density:
        """Density of samples that count `weight` (S,) vehicles each."""
        mass = np.multiply.outer(self._share, weight)
        right = mass * self._part
        size = self._shape[0] * self._shape[1]
        cell = self._cell.ravel()
        grid = totals(cell, (mass - right).ravel(), size)
        # The neighbouring bin's share: the same cells, one further.
        grid[1:] += totals(cell, right.ravel(), size)[:-1]
        image = grid.reshape(self._shape)
        image = scipy.ndimage.gaussian_filter1d(
            image, self._blur, axis=1, mode="constant", truncate=3.0
        )
        return Density(self._offset_m, image / BIN_M)


def find_maxima(density: Density, min_height: float, prominence: float) -> Maxima:
    """Maxima across the road that stand out from their neighbours.

    Args:
        density: Vehicles per metre over (s, d).
        min_height: Maxima lower than this are noise, vehicles per metre.
        prominence: Of two neighbours the lower one must rise above the saddle by this share.
    """
    value = density.value
    inner = value[:, 1:-1]
    maximum = (inner > value[:, :-2]) & (inner >= value[:, 2:]) & (inner >= min_height)
    station, column = np.nonzero(maximum)
    column += 1
    flat, bins = value.ravel(), value.shape[1]
    k = station * bins + column
    while len(k) > 1:
        height = flat[k]
        saddle = np.minimum.reduceat(flat, k)[:-1]
        depth = 1.0 - saddle / np.minimum(height[:-1], height[1:])
        depth[np.diff(k // bins) != 0] = np.inf
        # The shallowest saddle among its neighbours goes first, and with it the lower maximum.
        least = depth < prominence
        least[1:] &= depth[1:] <= depth[:-1]
        least[:-1] &= depth[:-1] < depth[1:]
        shallow = np.flatnonzero(least)
        if len(shallow) == 0:
            break
        keep = np.ones(len(k), bool)
        keep[shallow + (height[shallow] >= height[shallow + 1])] = False
        k = k[keep]
    below, at, above = flat[k - 1], flat[k], flat[k + 1]
    curve = np.minimum(below - 2.0 * at + above, -1e-12)
    shift = np.clip(0.5 * (below - above) / curve, -0.5, 0.5)
    return Maxima(k // bins, density.offset_m[k % bins] + BIN_M * shift, at)
