"""Which detections continue which tracks: possible pairs, their costs, the cheapest set."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from geoorbit_ros.tracking.motion_model import (
    MEAN,
    TAIL,
    VARIANCE,
    Four,
    State,
    distance_within,
    spread_ratio,
)
from geoorbit_ros.tracking.track import CUT_FACTOR, Detection, Sides, Track

GATE = 60.0
"""Squared distance in 1-sigma errors over the four measurements beyond which no pair is considered
(chi-square with four degrees of freedom: far out, because errors of boxes have heavy tails).
Chosen: larger takes more time and changes few ids, smaller loses vehicles after wild boxes."""
SPREAD_WEIGHT = 1.6
"""Weight of a prediction's spread; 1 would be its likelihood. Chosen: larger favours tracks with
exact predictions more, smaller lets a track lost for long take others' detections."""
GAP_COST = 3.0
"""Cost of a second unobserved: the longer, the more likely the vehicle is gone and this another.
Chosen: larger loses vehicles behind trucks, smaller gives their ids to others."""
MOST_DOUBT = 10.0
"""Most that the score of a detection costs an unconfirmed track. Chosen: with more, a vehicle whose
score no other one had is a new track in each image, and never gets an id."""
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


class Pair(NamedTuple):
    """A track and a detection that may be one vehicle.

    Attributes:
        track: Index of the track.
        detection: Index of the detection.
        cost: Negative log-likelihood ratio, twice and up to a constant.
    """

    track: int
    detection: int
    cost: float


def candidate_pairs(
    tracks: Sequence[Track],
    predicted: Sequence[State],
    elapsed_s: Sequence[float],
    found: Sequence[Detection],
    doubt: Sequence[float],
) -> list[Pair]:
    """Pairs within the gate that may be one vehicle, with their costs.

    The cost is the squared distance under Student's t distribution plus the logarithm of the
    spread: of two tracks that could explain a detection, the one with the more exact prediction
    gets it. The prediction of a track lost for long covers much of the image. Whether a pair may be
    one vehicle at all is another question: there the spread counts less (`LIKELIHOOD_WEIGHT`).

    Args:
        tracks: The tracks.
        predicted: Their states at the time of the detections.
        elapsed_s: Time since each was observed.
        found: The detections.
        doubt: Cost of each detection, because it may be a false box.
    """
    pairs = []
    places = _Places(found)
    about = [
        (each.measured, each.variance, each.cut, each.class_id, doubt[j])
        for j, each in enumerate(found)
    ]
    for i, (track, state) in enumerate(zip(tracks, predicted, strict=True)):
        alone = GAP_COST * elapsed_s[i] + (0.0 if track.track_id else TENTATIVE_COST)
        # However exact the prediction: a farther pair costs `ONE_VEHICLE_LIMIT` and more.
        farthest = min(TAIL * math.expm1((ONE_VEHICLE_LIMIT - alone) / (TAIL + 4.0)), GATE)
        gate, near = places.near(state, alone, farthest)
        for j in near:
            measured, variance, cut, class_id, doubtful = about[j]
            if cut and not track.entering:
                measured, variance = complete_cut_box(state, found[j])
            distance = distance_within(farthest if cut else gate, state, measured, variance)
            if distance is None:
                continue
            if doubtful > MOST_DOUBT and not track.track_id:
                doubtful = MOST_DOUBT
            cost = (TAIL + 4.0) * math.log1p(distance / TAIL) + alone + doubtful
            if class_id != track.class_id:
                cost += CLASS_COST
            if cost >= ONE_VEHICLE_LIMIT:
                continue  # the spread costs more than nothing
            spread_cost = math.log(spread_ratio(state, variance))
            if cost + LIKELIHOOD_WEIGHT * spread_cost < ONE_VEHICLE_LIMIT:
                cost += SPREAD_WEIGHT * spread_cost
                pairs.append(Pair(i, j, min(cost, LEAVE_COST - LEAST_DIFFERENCE)))
    return pairs


class _Places:
    """Detections by their place: a track looks at its neighbours alone."""

    def __init__(self, found: Sequence[Detection]) -> None:
        whole = sorted((each.box[0], j) for j, each in enumerate(found) if not each.cut)
        self._x = [x for x, _ in whole]
        self._order = [(j, found[j].box[1]) for _, j in whole]
        self._of_whole = _largest([found[j].variance for _, j in whole])
        self._cut = [j for j, each in enumerate(found) if each.cut]
        self._of_cut = _largest([found[j].variance for j in self._cut])
        self._found = found

    def near(self, state: State, alone: float, farthest: float) -> tuple[float, list[int]]:
        """Detections that may be the vehicle of a track.

        Args:
            state: The prediction.
            alone: What pairs cost with this track beside distance and spread.
            farthest: Squared distance from which on a pair is none.

        Returns:
            The squared distance from which on any pair with a whole box costs
            `ONE_VEHICLE_LIMIT`, and the detections within it, for cut boxes within `farthest`.
        """
        gate, near = 0.0, []
        x, y, _, _ = state
        if self._of_whole is not None:
            spread_cost = math.log(spread_ratio(state, self._of_whole))
            left = ONE_VEHICLE_LIMIT - alone - LIKELIHOOD_WEIGHT * spread_cost
            if left > 0.0:
                gate = min(TAIL * math.expm1(left / (TAIL + 4.0)), farthest)
                across = math.sqrt(gate * (x[VARIANCE] + self._of_whole[0]))
                along = math.sqrt(gate * (y[VARIANCE] + self._of_whole[1]))
                first = bisect_left(self._x, x[MEAN] - across)
                last = bisect_right(self._x, x[MEAN] + across)
                low, high = y[MEAN] - along, y[MEAN] + along
                near = [j for j, at in self._order[first:last] if low <= at <= high]
        if self._of_cut is not None and farthest > 0.0:
            near += self._cut_near(state, self._of_cut, farthest)
        return gate, near

    def _cut_near(self, state: State, variance: Four, farthest: float) -> list[int]:
        """Cut boxes near enough, or beside: their middle can be half a vehicle away from its."""
        x, y, width, height = state
        across = max(math.sqrt(farthest * (x[VARIANCE] + variance[0])), math.exp(width[MEAN]))
        along = max(math.sqrt(farthest * (y[VARIANCE] + variance[1])), math.exp(height[MEAN]))
        return [
            j
            for j in self._cut
            if abs(self._found[j].box[0] - x[MEAN]) <= across
            and abs(self._found[j].box[1] - y[MEAN]) <= along
        ]


def _largest(variances: Sequence[Four]) -> Four | None:
    if not variances:
        return None
    x, y, width, height = zip(*variances, strict=True)
    return max(x), max(y), max(width), max(height)


def complete_cut_box(state: State, found: Detection) -> tuple[Four, Four]:
    """What a box that the image border cuts says about a vehicle that has been seen as a whole.

    Of such a box only the edges inside the image are the vehicle's. So its middle follows from the
    inner edge and the predicted size; the size itself is not measured.

    Args:
        state: The prediction.
        found: The cut box.

    Returns:
        Measurements of the whole vehicle, and their variances.
    """
    (x, y, width, height), (of_x, of_y, of_width, of_height) = found.measured, found.variance
    x, width, of_x, of_width = _complete(
        state[2][MEAN], found.box[2], found.cut_across, (x, width, of_x, of_width)
    )
    y, height, of_y, of_height = _complete(
        state[3][MEAN], found.box[3], found.cut_along, (y, height, of_y, of_height)
    )
    return (x, y, width, height), (of_x, of_y, of_width, of_height)


def _complete(expected: float, size_px: float, cut: Sides, seen: Four) -> Four:
    """`complete_cut_box` along one axis.

    Args:
        expected: Logarithm of the predicted size.
        size_px: Size of the cut box.
        cut: Where it is cut.
        seen: Middle and logarithm of the size of the cut box, and their variances.

    Returns:
        `seen` of the whole vehicle.
    """
    middle, log_size, of_middle, of_size = seen
    low, high = cut
    if not (low or high):
        return middle, log_size, of_middle / CUT_FACTOR, of_size / CUT_FACTOR
    larger = max(expected, log_size)
    if low and high:
        return middle, larger, NOT_MEASURED, NOT_MEASURED
    whole_px = math.exp(expected)
    hidden_px = whole_px - size_px
    middle += 0.5 * (hidden_px if high else -hidden_px)
    ratio = whole_px / size_px
    return middle, larger, of_middle / CUT_FACTOR * (ratio * ratio), NOT_MEASURED


def assign(pairs: Sequence[Pair], limit: float) -> list[Pair]:
    """The cheapest assignment, in which staying alone costs `limit`.

    Pairs whose track and detection have no other candidate are taken at once; the Hungarian method
    (Kuhn 1955) decides among the others alone. Both together are the optimum.

    Args:
        pairs: Candidates, none twice; those at `limit` or above are none.
        limit: Cost of leaving a track or a detection without partner.
    """
    if not pairs:
        return []
    of_track: dict[int, int] = {}
    of_detection: dict[int, int] = {}
    for track, detection, cost in pairs:
        if cost < limit:
            of_track[track] = of_track.get(track, 0) + 1
            of_detection[detection] = of_detection.get(detection, 0) + 1
    sole: list[Pair] = []
    contested: list[Pair] = []
    for pair in pairs:
        if pair.cost < limit:
            alone = of_track[pair.track] == of_detection[pair.detection] == 1
            (sole if alone else contested).append(pair)
    if not contested:
        return sole
    row = {track: i for i, track in enumerate(sorted({pair.track for pair in contested}))}
    column = {found: j for j, found in enumerate(sorted({pair.detection for pair in contested}))}
    costs = np.full((len(row), len(column)), limit)
    at = {(row[pair.track], column[pair.detection]): pair for pair in contested}
    for place, pair in at.items():
        costs[place] = pair.cost
    best = zip(
        *(index.tolist() for index in scipy.optimize.linear_sum_assignment(costs)), strict=True
    )
    return sole + [at[place] for place in best if place in at]
