"""How fast vehicles drive, from places with errors: one curve through each one's places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ACCELERATION_MPS2 = 0.7
"""1-sigma of a vehicle's mean acceleration along a lane. Chosen: less takes speeds near the camera
for the whole lane's, more gives noise of places to speeds."""
OUTLIER = 1.0
"""Places farther from the vehicle's motion than so many times the usual distance count less (Huber
1964), as boxes are cut at the image's border or merge with others."""
ITERATIONS = 5
"""Of the reweighted fit. Chosen: the weights change by less than a percent afterwards."""
FREEDOM = 1.0
"""Errors are taken to be as expected until the residuals of so many independent places say
otherwise. Chosen: more makes the errors of sharp places too large, fewer makes the error of short
passages a guess."""
SAME_ERROR_S = 0.4
"""Places of one vehicle within this time have the same error. Measured: with it, 74 % of speeds in
simulated scenes are within their 1 sigma (docs/results.md), where 68 % are expected."""
VEHICLE_SCALE = 0.002
"""1-sigma relative error of a vehicle's speed that its places don't show: the point that is taken
for its place moves along it while it comes nearer."""
NO_SPEED = 1e-6
"""Keeps the fit of a single place from failing: its speed is 0, with an error of 1000 m/s."""
GROUPS_AT_ONCE = 128
"""Passages whose medians are taken together. Chosen: fewer cost calls, more of unlike lengths cost
memory and time for values that are not there."""
MEDIAN_SQUARE = 0.455
"""Median of the chi-square distribution with one degree of freedom."""


@dataclass(frozen=True, slots=True)
class Motions:
    """One parabola for each of G passages.

    Attributes:
        middle_s: (G,) middle of its time.
        coefficient: (G, 3) place, speed and half the acceleration there.
        noise_mps: (G,) 1-sigma error of the speed by the scatter of places.
    """

    middle_s: Array
    coefficient: Array
    noise_mps: Array

    @property
    def mean_mps(self) -> Array:
        """(G,) mean speed over the passage: a parabola has it in the middle of its time."""
        return np.asarray(self.coefficient[:, 1])

    def speed_at(self, time_s: Array) -> Array:
        """(G,) speeds at one time each."""
        return np.asarray(
            self.coefficient[:, 1] + 2.0 * self.coefficient[:, 2] * (time_s - self.middle_s)
        )

    def crossing_s(self) -> Array:
        """(G,) when each place is 0, nearest to the middle; infinite where it never is."""
        place, speed, bend = self.coefficient.T
        under = speed**2 - 4.0 * bend * place
        root = np.sqrt(np.maximum(under, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            after = -2.0 * place / (speed + np.copysign(root, speed))
        return np.where((under < 0.0) | ~np.isfinite(after), np.inf, after + self.middle_s)


def fit_motions(
    group: NDArray[np.int64], groups: int, time_s: Array, arc_m: Array, sigma_m: Array
) -> Motions:
    """Fit each passage's motion.

    The acceleration is expected to be small, and weights are Huber's. Errors of places are alike
    within `SAME_ERROR_S`, which leaves fewer independent places than rows.

    Args:
        group: (M,) passage of each row, from 0, in order; each has a row.
        groups: How many.
        time_s: (M,) time of each row, of any origin per passage.
        arc_m: (M,) place along the lane.
        sigma_m: (M,) expected 1-sigma error of the place.
    """
    if not groups:
        return Motions(np.empty(0), np.empty((0, 3)), np.empty(0))
    count = np.bincount(group, minlength=groups)
    begin = np.append(0, np.cumsum(count)[:-1])
    last = begin + count - 1
    duration = np.maximum(time_s[last] - time_s[begin], 1e-3)
    middle = (time_s[last] + time_s[begin]) / 2
    x, y = time_s - middle[group], arc_m - arc_m[begin][group]
    independent = np.clip(duration / SAME_ERROR_S + 1.0, 1.0, count)
    share = (independent / count)[group] / sigma_m**2
    weight, level = share.copy(), np.ones(groups)
    medians = _GroupMedians(begin, count)
    for _ in range(ITERATIONS):
        solution, inverse = _parabola(begin, x, y, weight, level)
        left = y - solution[group, 0] - x * solution[group, 1] - x * x * solution[group, 2]
        square = (left / sigma_m) ** 2
        spread = medians.of(square) / MEDIAN_SQUARE
        level = (FREEDOM + independent * spread) / (FREEDOM + independent)
        far = np.sqrt(square) / (OUTLIER * np.sqrt(level))[group]
        weight = share / np.maximum(far, 1.0)
    solution[:, 0] += arc_m[begin]
    return Motions(middle, solution, np.sqrt(level * inverse[:, 1, 1]))


def _parabola(
    begin: NDArray[np.int64], x: Array, y: Array, weight: Array, level: Array
) -> tuple[Array, Array]:
    """Coefficients (G, 3) of 1, x, x^2, and the inverse (G, 3, 3) of their normal matrix."""
    term, powers, right_terms = weight, list[Array](), list[Array]()
    for k in range(5):
        powers.append(np.add.reduceat(term, begin))
        if k < 3:
            right_terms.append(np.add.reduceat(term * y, begin))
        term = term * x
    matrix = np.stack([np.stack(powers[k : k + 3], axis=-1) for k in range(3)], axis=-2)
    prior = np.zeros_like(matrix)
    prior[:, 2, 2] = level / (0.5 * ACCELERATION_MPS2) ** 2
    prior[:, 1, 1] = NO_SPEED
    matrix = matrix + prior
    right = np.stack(right_terms, axis=-1)
    inverse = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    return np.asarray(np.einsum("gij,gj->gi", inverse, right)), inverse


class _GroupMedians:
    """Medians of groups of consecutive values: groups of about one length are sorted together.

    Args:
        begin: (G,) where each group begins.
        count: (G,) how many values it has, at least one.
    """

    def __init__(self, begin: NDArray[np.int64], count: NDArray[np.int64]) -> None:
        order = np.argsort(count, kind="stable")
        self._parts = [order[k : k + GROUPS_AT_ONCE] for k in range(0, len(order), GROUPS_AT_ONCE)]
        self._rows, self._none = list[NDArray[np.int64]](), list[NDArray[np.bool_]]()
        for part in self._parts:
            column = np.arange(count[part].max())
            self._rows.append(begin[part, None] + np.minimum(column, count[part, None] - 1))
            self._none.append(column >= count[part, None])
        self._count = count

    def of(self, value: Array) -> Array:
        """(G,) of (M,) values."""
        out = np.empty(len(self._count))
        for part, rows, none in zip(self._parts, self._rows, self._none, strict=True):
            ordered = value.take(rows)
            ordered[none] = np.inf
            ordered.sort(axis=1)
            index, count = np.arange(len(part)), self._count[part]
            out[part] = (ordered[index, (count - 1) // 2] + ordered[index, count // 2]) / 2
        return out
