"""Which detections continue which tracks: possible pairs, their costs, the cheapest set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from geoorbit_ros.tracking.motion_model import MEAN, TAIL, VARIANCE
from geoorbit_ros.tracking.track_table import BORDER_RATIO, CUT_FACTOR, FrameDetections

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
LIKELIHOOD_WEIGHT = 0.8
"""Weight of the spread where a pair is compared with a new vehicle; 1 would be its likelihood.
Chosen with the limit below."""
ONE_VEHICLE_LIMIT = 23.0
"""Cost from which a detection rather is a new vehicle. Chosen on KITTI tracking and seed 5 of four
scenes (docs/tracking.md): larger gives ids of vehicles that leave to those that come, smaller gives
one vehicle several ids at low frame rates."""
WEAK_COST = 2.0
"""Cost of a weak detection: it continues a track only where it was predicted. Chosen on KITTI
tracking: larger loses far vehicles, smaller lets false boxes take over lost tracks."""
LEAVE_COST = 36.0
"""Cost of leaving a track or a detection without partner. Chosen: with `SPREAD_WEIGHT` it settles
who gets a detection that several could explain."""
LEAST_DIFFERENCE = 1e-6
"""Pairs that may be one vehicle always cost less than leaving both alone."""
NOT_MEASURED = 1e3
"""Variance of what a cut box does not show: far above any that counts."""
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
    whole: NDArray[np.bool_],
    found: FrameDetections,
    doubt: Array,
    image_size: tuple[int, int],
) -> Pairs:
    """Pairs within the gate that may be one vehicle, with their costs.

    The cost is the squared distance under Student's t distribution plus the logarithm of the
    spread: of two tracks that could explain a detection, the one with the more exact prediction
    gets it. The prediction of a track lost for long covers much of the image. Whether a pair may be
    one vehicle at all is another question: there the spread counts less (`LIKELIHOOD_WEIGHT`).

    Args:
        predicted: (5, 4, N) states at the time of the detections, see `motion_model`.
        track_cost: (N,) cost of each track beside its distance.
        confirmed: (N,) whether the track is.
        track_class: (N,) its class.
        whole: (N,) whether its vehicle has been seen as a whole.
        found: The detections.
        doubt: (M,) cost of each detection, because it may be a false box.
        image_size: (width, height) in pixels, 0 where it is not known.
    """
    mean, spread = predicted[MEAN], predicted[VARIANCE]
    measured, variance = found.measured, found.variance
    # A cheap test first: a pair outside this rectangle is outside the gate.
    reach = np.sqrt(GATE * spread[:2]), np.sqrt(GATE * variance[:2])
    near = np.abs(mean[0][:, None] - measured[0]) < reach[0][0][:, None] + reach[1][0]
    near &= np.abs(mean[1][:, None] - measured[1]) < reach[0][1][:, None] + reach[1][1]
    # The middle of a cut box can be half a vehicle away from the vehicle's.
    size = np.exp(mean[2:])
    beside = np.abs(mean[0][:, None] - measured[0]) < size[0][:, None]
    beside &= np.abs(mean[1][:, None] - measured[1]) < size[1][:, None]
    near |= beside & found.cut
    track, detection = np.nonzero(near)
    values, spreads = measured[:, detection], variance[:, detection]
    completed = found.cut[detection] & whole[track]
    if completed.any():
        values[:, completed], spreads[:, completed] = complete_cut_boxes(
            mean[:, track[completed]], values[:, completed], spreads[:, completed], image_size
        )
    total = spread[:, track] + spreads
    error = values - mean[:, track]
    distance = (error * error / total).sum(axis=0)
    cost = (TAIL + 4.0) * np.log1p(distance / TAIL)
    cost += track_cost[track] + TENTATIVE_COST * ~confirmed[track] + doubt[detection]
    cost += CLASS_COST * (track_class[track] != found.class_id[detection])
    spread_cost = np.log((total / spreads).prod(axis=0))
    may_be = (distance < GATE) & (cost + LIKELIHOOD_WEIGHT * spread_cost < ONE_VEHICLE_LIMIT)
    cost = np.minimum(cost + SPREAD_WEIGHT * spread_cost, LEAVE_COST - LEAST_DIFFERENCE)
    return Pairs(track[may_be], detection[may_be], cost[may_be])


def complete_cut_boxes(
    mean: Array, measured: Array, variance: Array, image_size: tuple[int, int]
) -> tuple[Array, Array]:
    """What boxes that the image border cuts say about vehicles that have been seen as a whole.

    Of such a box only the edges inside the image are the vehicle's. So its middle follows from the
    inner edge and the predicted size; the size itself is not measured.

    Args:
        mean: (4, K) predictions: x, y, logarithms of width and height.
        measured: (4, K) the same of the cut boxes.
        variance: (4, K) variances of `measured`, `CUT_FACTOR` times those of whole boxes.
        image_size: (width, height) in pixels.

    Returns:
        (4, K) measurements of the whole vehicle, and their variances.
    """
    values, spreads = measured.copy(), variance / CUT_FACTOR
    for axis, extent in enumerate(image_size):
        size, whole = np.exp(measured[axis + 2]), np.exp(mean[axis + 2])
        low = measured[axis] - 0.5 * size < BORDER_RATIO * extent
        high = measured[axis] + 0.5 * size > (1.0 - BORDER_RATIO) * extent
        cut = low | high
        inner = np.where(low, 0.5 * (size - whole), 0.5 * (whole - size))
        values[axis] = np.where(low ^ high, measured[axis] + inner, measured[axis])
        grown = spreads[axis] * np.square(whole / size)
        spreads[axis] = np.where(low & high, NOT_MEASURED, np.where(cut, grown, spreads[axis]))
        larger = np.maximum(mean[axis + 2], measured[axis + 2])
        values[axis + 2] = np.where(cut, larger, measured[axis + 2])
        spreads[axis + 2] = np.where(cut, NOT_MEASURED, spreads[axis + 2])
    return values, spreads


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
