"""Where the road is not the plane that the control points say: a crest, a dip, a bend in its grade.

A road that lies higher than the plane by `h` shows vehicles nearer than the plane has them: with
the camera at height `H`, all of a vehicle's sides look larger by `H / (H - h)`, and its place is
too far from the camera by the same factor. No vehicle changes its size on its way, so that what all
of them do alike is the road's. A factor common to the whole road is the size of the place's
vehicles, and one that grows evenly with the distance comes from boxes that are drawn some pixels
too large as well as from the grade: both are taken out, and what is left is a bend.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STRETCHES = 8
"""Parts of the road, by distance from the camera, of about as many boxes each. Chosen: more have
too few vehicles each, fewer blur a crest."""
LEAST_CARS = 12
"""Cars seen in a stretch and in another one as well, at least."""
LEAST_STRETCHES = 5
"""Two take the common factor and the even growth; three are left to agree or not."""
SIGNIFICANT = 4.0
"""Sigma of a bend that is told. Chosen: eight stretches are looked at every few seconds."""
LEAST_BEND = 0.06
"""Smallest factor that is told, less one. Chosen: in six simulated scenes, whose roads are flat, it
is 0.008 at most, at the two cameras on US-12 0.031, where vehicles are no boxes; larger misses a
crest of half a metre below a camera of 8 m."""
SWEEPS = 4
"""Of the median polish, which has then arrived."""
DRAWS = 20
"""Times that vehicles are drawn anew for the error (Efron and Tibshirani 1993)."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part of the road.

    Attributes:
        near_m: Distance from the camera at which it begins.
        far_m: Where it ends.
        bend: Log of the factor by which vehicles look too large, so that they are placed too far.
        sigma: Its 1-sigma error.
    """

    near_m: float
    far_m: float
    bend: float
    sigma: float

    @property
    def clear(self) -> bool:
        """Whether the road bends here for sure."""
        return abs(self.bend) > max(SIGNIFICANT * self.sigma, LEAST_BEND)

    def height_m(self, camera_height_m: float) -> float:
        """By how much the road lies higher than the plane."""
        return camera_height_m * (1.0 - float(np.exp(-self.bend)))

    def sentence(self, camera_height_m: float) -> str:
        """What shows here."""
        share, height = np.expm1(abs(self.bend)), self.height_m(camera_height_m)
        return (
            f"the road is not the plane of the control points: {self.near_m:.0f} to "
            f"{self.far_m:.0f} m from the camera cars look {share:.0%} too "
            f"{'large' if self.bend > 0 else 'small'}, as if it were {abs(height):.1f} m "
            f"{'higher' if height > 0 else 'lower'} there; positions are {share:.0%} of that "
            f"distance too {'far' if self.bend > 0 else 'near'}"
        )


def road_stretches(
    track: NDArray[np.integer[Any]], distance_m: Array, log_ratio: Array
) -> list[Stretch]:
    """How the road bends, by the sizes of vehicles along it; empty where too few are seen.

    Args:
        track: (N,) vehicles.
        distance_m: (N,) from the camera, on the road.
        log_ratio: (N,) log of a box's side over that of the usual vehicle there.
    """
    if not len(track):
        return []
    edge = np.quantile(distance_m, np.linspace(0.0, 1.0, STRETCHES + 1))
    part = np.clip(np.searchsorted(edge, distance_m, side="right") - 1, 0, STRETCHES - 1)
    vehicle = np.unique(track, return_inverse=True)[1]
    table = _means(vehicle, part, log_ratio)
    middle = np.array(
        [distance_m[part == k].mean() if (part == k).any() else 0.0 for k in range(STRETCHES)]
    )
    table = table[np.isfinite(table).sum(axis=1) >= 2]
    known = np.isfinite(table).sum(axis=0) >= LEAST_CARS
    table, middle = table[:, known], middle[known]
    table = table[np.isfinite(table).sum(axis=1) >= 2]
    if len(middle) < LEAST_STRETCHES or np.isfinite(table).sum(axis=0).min() < LEAST_CARS:
        return []
    bend = _bends(table, middle)
    rng = np.random.default_rng(0)
    drawn = [_bends(table[rng.integers(0, len(table), len(table))], middle) for _ in range(DRAWS)]
    sigma = np.nanstd(drawn, axis=0)
    ends = zip(edge[:-1][known].tolist(), edge[1:][known].tolist(), strict=True)
    return [
        Stretch(near, far, value, error)
        for (near, far), value, error in zip(ends, bend.tolist(), sigma.tolist(), strict=True)
    ]


def _means(vehicle: NDArray[np.intp], part: NDArray[np.intp], value: Array) -> Array:
    """(V, `STRETCHES`) means of values (N,) of each vehicle in each part; NaN where it wasn't."""
    at = vehicle * STRETCHES + part
    size = (int(vehicle.max()) + 1) * STRETCHES
    count, total = np.bincount(at, minlength=size), np.bincount(at, value, size)
    with np.errstate(invalid="ignore"):
        return np.asarray((total / count).reshape(-1, STRETCHES))


def _bends(table: Array, middle: Array) -> Array:
    """What columns have in common beside the rows' own level: median polish (Tukey 1977).

    Without a common level and an even growth with the distance.
    """
    column = np.zeros(table.shape[1])
    for _ in range(SWEEPS):
        row = np.nanmedian(table - column, axis=1, keepdims=True)
        column = np.nanmedian(table - row, axis=0)
    count = np.sqrt(np.isfinite(table).sum(axis=0))
    design = np.column_stack([np.ones(len(middle)), middle])
    answer = np.linalg.lstsq(design * count[:, None], column * count, rcond=None)[0]
    return np.asarray(column - design @ answer)
