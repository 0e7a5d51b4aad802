"""Which detections continue which tracks: possible pairs, their costs, the cheapest set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from geoorbit_ros.tracking.motion_model import MEAN, TAIL, VARIANCE

Array = NDArray[np.float64]
Index = NDArray[np.intp]

GATE = 60.0
"""Squared distance in 1-sigma errors over the four measurements beyond which no pair is considered
(chi-square with four degrees of freedom: far out, because errors of boxes have heavy tails).
Chosen: larger takes more time and changes few ids, smaller loses vehicles after wild boxes."""
SPREAD_WEIGHT = 1.6
"""Weight of a prediction's spread; 1 would be its likelihood. Chosen: larger favours tracks with
exact predictions more, smaller lets a track lost for long take others' detections."""
TENTATIVE_COST = 6.0
"""Cost of an unconfirmed track: a false box beside a vehicle must not take its detection. Chosen:
larger confirms new vehicles later in dense traffic."""
CLASS_COST = 2.0
"""Cost of another class: detectors call a van a truck now and then, but a person seldom a car.
Chosen: larger splits tracks whose class changes, smaller mixes vehicles side by side."""


@dataclass(frozen=True, slots=True)
class Pairs:
    """Candidate pairs.

    Attributes:
        track: (P,) index of the track.
        detection: (P,) index of the detection.
        cost: (P,) negative log-likelihood ratio, twice and up to a constant.
    """

    track: Index
    detection: Index
    cost: Array

    def where(self, which: NDArray[np.bool_]) -> Pairs:
        """Only some of them."""
        return Pairs(self.track[which], self.detection[which], self.cost[which])


def candidate_pairs(
    predicted: Array,
    track_cost: Array,
    confirmed: NDArray[np.bool_],
    track_class: NDArray[np.int64],
    measured: Array,
    variance: Array,
    detection_class: NDArray[np.int64],
) -> Pairs:
    """Pairs within the gate, with their costs.

    The cost is the squared distance under Student's t distribution plus the logarithm of the
    spread: of two tracks that could explain a detection, the one with the more exact prediction
    gets it. The prediction of a track lost for long covers much of the image.

    Args:
        predicted: (5, 4, N) states at the time of the detections, see `motion_model`.
        track_cost: (N,) cost of each track beside its distance.
        confirmed: (N,) whether the track is.
        track_class: (N,) its class.
        measured: (4, M) measurements.
        variance: (4, M) their variances.
        detection_class: (M,) their classes.
    """
    mean, spread = predicted[MEAN], predicted[VARIANCE]
    # A cheap test first: a pair outside this rectangle is outside the gate.
    reach = np.sqrt(GATE * spread[:2]), np.sqrt(GATE * variance[:2])
    near = np.abs(mean[0][:, None] - measured[0]) < reach[0][0][:, None] + reach[1][0]
    near &= np.abs(mean[1][:, None] - measured[1]) < reach[0][1][:, None] + reach[1][1]
    track, detection = np.nonzero(near)
    total = spread[:, track] + variance[:, detection]
    error = measured[:, detection] - mean[:, track]
    distance = (error * error / total).sum(axis=0)
    inside = np.flatnonzero(distance < GATE)
    track, detection, total = track[inside], detection[inside], total[:, inside]
    spread_share = (total / variance[:, detection]).prod(axis=0)
    cost = (TAIL + 4.0) * np.log1p(distance[inside] / TAIL) + SPREAD_WEIGHT * np.log(spread_share)
    cost += track_cost[track] + TENTATIVE_COST * ~confirmed[track]
    cost += CLASS_COST * (track_class[track] != detection_class[detection])
    return Pairs(track, detection, cost)


def assign(row: Index, column: Index, cost: Array, limit: float) -> NDArray[np.intp]:
    """The pairs of the cheapest assignment, in which staying alone costs `limit`.

    Pairs whose row and column have no other candidate are taken at once; the Hungarian method
    (Kuhn 1955) decides among the others alone. Both together are the optimum.

    Args:
        row: (P,) row of each candidate pair.
        column: (P,) its column; no pair twice.
        cost: (P,) its cost; pairs at `limit` or above are no candidates.
        limit: Cost of leaving a row or column without partner.

    Returns:
        Indices of the chosen pairs.
    """
    candidate = np.flatnonzero(cost < limit)
    if not len(candidate):
        return candidate
    rows, columns = row[candidate], column[candidate]
    rivals = np.bincount(rows)[rows] + np.bincount(columns)[columns]
    sole = rivals == 2
    if sole.all():
        return candidate
    contested = candidate[~sole]
    used_row, i = np.unique(row[contested], return_inverse=True)
    used_column, j = np.unique(column[contested], return_inverse=True)
    dense = np.full((len(used_row), len(used_column)), limit)
    dense[i, j] = cost[contested]
    pair = np.full(dense.shape, -1, dtype=np.intp)
    pair[i, j] = contested
    best = pair[linear_sum_assignment(dense)]
    return np.concatenate([candidate[sole], best[best >= 0]])
