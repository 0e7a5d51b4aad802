"""Which way vehicles head on the road, and whether neighbours head the same way.

Positions are in the units of a reference scale, so that nothing here depends on how large the whole
scene is taken to be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CURVATURE = (1 / 300, 2e-4, 6e-6, 2e-7)
"""1-sigma of a path's curvature in 1/m and of its first three derivatives: bends of 150 m radius
and more that begin within 20 m, and changes of lane within 100 m. Chosen: larger follows the noise
of boxes, smaller cuts bends."""
FACTORIAL = (2.0, 6.0, 24.0, 120.0)
TERMS = 6
"""Of each path's polynomial."""
PAIR_RAD = np.radians(20.0)
"""Vehicles that head so differently are on different roads."""
PAIR_AHEAD, PAIR_ASIDE_M = (5.0, 0.05), (1.5, 60.0)
"""Vehicles are compared that are side by side: at most so far ahead (metres, and a share of the way
aside), and so far aside."""
PAIRS = 3
"""Comparisons per place. Chosen: more say the same again."""
PARALLEL_SIGMA_RAD = np.radians(0.8)
"""1-sigma of the angle between the ways of vehicles side by side. Chosen: at 0.4 degrees what is
wrong with the bends of S-curves pulls the horizon, at 3 degrees the lanes are not held parallel."""
PARALLEL_CAUCHY = 2.0
"""Sigma beyond which a comparison counts less: ramps, changes of lane."""


@dataclass(frozen=True, slots=True)
class Headings:
    """Of N places.

    Attributes:
        angle: (N,) radians from x.
        variance: (N,) in radians squared.
        curvature: (N,) to the left, per unit.
    """

    angle: Array
    variance: Array
    curvature: Array


def path_headings(xy: Array, noise: Array, vehicle: NDArray[np.intp]) -> Headings:
    """The way's direction at every place, of polynomials with a prior on how sharply roads bend.

    Args:
        xy: (2, N) positions, ordered by vehicle.
        noise: (N,) 1-sigma of a position across the way.
        vehicle: (N,) whose they are.
    """
    first = np.flatnonzero(np.diff(vehicle, prepend=-1))
    last = np.append(first[1:], len(vehicle)) - 1

    def sums(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, first, axis=-1))

    xy = np.nan_to_num(xy, nan=0.0, posinf=1e4, neginf=-1e4)
    weight = 1.0 / noise**2
    off = xy - (sums(weight * xy) / sums(weight))[:, vehicle]
    xx, xy_, yy = (
        sums(weight * off[0] ** 2),
        sums(weight * off[0] * off[1]),
        sums(weight * off[1] ** 2),
    )
    axis = 0.5 * np.arctan2(2.0 * xy_, xx - yy)
    ahead = off[:, last] - off[:, first]
    axis += np.pi * (ahead[0] * np.cos(axis) + ahead[1] * np.sin(axis) < 0.0)
    cos, sin = np.cos(axis)[vehicle], np.sin(axis)[vehicle]
    along, aside = off[0] * cos + off[1] * sin, off[1] * cos - off[0] * sin
    half = np.maximum(np.maximum.reduceat(np.abs(along), first), 1.0)
    u, length = along / half[vehicle], half[vehicle]

    powers = np.stack([u**k for k in range(TERMS)])
    normal = sums(powers[:, None] * powers * weight)
    normal[1, 1] += 1.0 / (0.5 * half) ** 2
    for k, (sigma, factorial) in enumerate(zip(CURVATURE, FACTORIAL, strict=True)):
        normal[k + 2, k + 2] += 1.0 / (sigma * half ** (k + 2) / factorial) ** 2
    normal[range(TERMS), range(TERMS)] += 1e-7 * (1e-3 + normal[0, 0])
    covariance = np.linalg.inv(normal.transpose(2, 0, 1))
    terms = np.einsum("kij,jk->ik", covariance, sums(powers * weight * aside))[:, vehicle]
    slopes = np.stack([k * u ** max(k - 1, 0) for k in range(TERMS)]) / length
    slope = (slopes * terms).sum(axis=0)
    turn = sum(k * (k - 1) * terms[k] * u ** (k - 2) for k in range(2, TERMS)) / length**2
    variance = np.einsum("in,nij,jn->n", slopes, covariance[vehicle], slopes)
    square = 1.0 + slope**2
    return Headings(axis[vehicle] + np.arctan(slope), variance / square**2, turn / square**1.5)


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Places next to others, by other vehicles: rows of `here` and `there`."""

    here: NDArray[np.intp]
    there: NDArray[np.intp]

    def difference(self, xy: Array, headings: Headings) -> tuple[Array, Array]:
        """(P,) angle between them modulo pi, without what the bend makes; (P,) how far ahead."""
        angle, bend = headings.angle, headings.curvature
        off = xy[:, self.there] - xy[:, self.here]
        ahead = off[0] * np.cos(angle[self.here]) + off[1] * np.sin(angle[self.here])
        turn = angle[self.there] - angle[self.here]
        same = np.where(np.cos(turn) < 0.0, -1.0, 1.0)
        turn -= ahead * 0.5 * (bend[self.here] + same * bend[self.there])
        return (turn + np.pi / 2) % np.pi - np.pi / 2, ahead


def find_neighbours(
    xy: Array, headings: Headings, vehicle: NDArray[np.intp], good: NDArray[np.bool_]
) -> Neighbours:
    """Whom each place is compared with across the road."""
    random, pairs = np.random.default_rng(0), []
    cos, sin = np.cos(headings.angle), np.sin(headings.angle)
    for k in np.flatnonzero(good):
        off = xy - xy[:, k : k + 1]
        ahead = np.abs(off[0] * cos[k] + off[1] * sin[k])
        across = np.abs(off[1] * cos[k] - off[0] * sin[k])
        turn = np.abs((headings.angle - headings.angle[k] + np.pi / 2) % np.pi - np.pi / 2)
        beside = good & (vehicle != vehicle[k]) & (turn < PAIR_RAD)
        beside &= ahead < PAIR_AHEAD[0] + PAIR_AHEAD[1] * across
        beside &= (across > PAIR_ASIDE_M[0]) & (across < PAIR_ASIDE_M[1])
        some = np.flatnonzero(beside)
        if len(some):
            chosen = random.choice(some, min(PAIRS, len(some)), replace=False)
            pairs += [(k, n) for n in chosen]
    return Neighbours(*np.array(pairs, dtype=np.intp).reshape(-1, 2).T)
