"""A detected lane map against the truth: matched one to one, counted, measured in metres.

Definitions, used by `geoorbit score`, the report and the benchmarks alike:

* **Common length** of a detected and a true lane: the part of the detected centreline that lies
  beside the true one, sampled every metre. What reaches beyond the truth's ends is no lateral
  error and is left out.
* **A pair can match** when, over the common length, the mean lateral distance is at most half a
  lane (1.75 m) and the directions differ by at most 45 degrees, and when the common length is at
  least half of the shorter lane.
* **Matching** is one to one (Hungarian method): as many pairs as possible, then the smallest sum
  of mean distances. A tentative lane wins over a confirmed one only if it lies 0.5 m nearer.
* **Missed**: a true lane without a match. **Invented**: a confirmed detected lane without a match;
  tentative lanes without a match are counted apart.
* **Direction wrong**: a detected lane that would match a true lane, both left over, but for its
  direction. It counts as missed and invented too.
* **Centreline error**: distance of each sample on the common length from the true centreline; mean
  and 95 % quantile per lane, and over all samples of matched confirmed lanes.
* **Width error**: |detected - true| width; the total is the mean over matched confirmed lanes.
* **Coverage**: share of the true centreline that lies beside the matched one; the total is over
  the whole length of the matched true lanes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import Samples, project, sample
from geoorbit_ros.metrics.lane_score import LaneScore, MatchedLane, TrafficClass, traffic_class

__all__ = ["LaneScore", "MatchedLane", "TrafficClass", "score_lanes", "traffic_class"]

_NO_MATCH = 1e6
"""Cost of a pair that is no match: more than any distance."""
_TENTATIVE_HANDICAP_M = 0.5
"""Added to a tentative lane's distance, so that a confirmed lane beside it is matched first.
Chosen: larger matches worse confirmed lanes, smaller counts confirmed ones as invented."""


@dataclass(frozen=True, slots=True)
class _Pair:
    """How a detected lane lies beside a true one, over their common length."""

    offset_m: NDArray[np.float64]
    heading_error_rad: float
    overlap: float

    @property
    def distance_m(self) -> float:
        return float(np.abs(self.offset_m).mean()) if len(self.offset_m) else float("inf")


def score_lanes(
    detected: Sequence[Lane],
    truth: Sequence[Lane],
    *,
    gate_m: float = 1.75,
    gate_rad: float = np.pi / 4,
    min_overlap: float = 0.5,
    step_m: float = 1.0,
) -> LaneScore:
    """Compare detected lanes with true ones; both in the same map frame.

    Args:
        detected: Confirmed and tentative lanes.
        truth: True lanes; their `vehicles` may be NaN when unknown.
        gate_m: Largest mean lateral distance of a match; half a lane width of 3.5 m.
        gate_rad: Largest difference in direction of a match.
        min_overlap: Common length as a share of the shorter lane that a match needs.
        step_m: Distance between samples.

    Returns:
        Counts and errors as this module's text defines them.
    """
    seen = [sample(lane.centerline_m, step_m) for lane in detected]
    true = [sample(lane.centerline_m, step_m) for lane in truth]
    pairs = [
        [_compare(s, t, q) for t, q in zip(truth, true, strict=True)]
        for d, s in zip(detected, seen, strict=True)
    ]
    aligned = np.zeros((len(detected), len(truth)), dtype=bool)
    cost = np.full(aligned.shape, _NO_MATCH)
    for i, lane in enumerate(detected):
        handicap = _TENTATIVE_HANDICAP_M * (lane.status == "tentative")
        for j, pair in enumerate(pairs[i]):
            aligned[i, j] = abs(pair.heading_error_rad) <= gate_rad
            if pair.distance_m <= gate_m and pair.overlap >= min_overlap:
                cost[i, j] = pair.distance_m + handicap
    matches = _assign(np.where(aligned, cost, _NO_MATCH))
    left_over = cost.copy()
    left_over[aligned] = _NO_MATCH
    for i, j in matches:
        left_over[i, :] = _NO_MATCH
        left_over[:, j] = _NO_MATCH

    partner = {j: i for i, j in matches}
    rows = []
    for j, lane in enumerate(truth):
        if j in partner:
            i = partner[j]
            coverage = _coverage(true[j], detected[i], gate_m)
            rows.append(_row(lane, detected[i], pairs[i][j], coverage))
        else:
            rows.append(MatchedLane(lane.lane_id, lane.vehicles, lane.length_m))
    unmatched = [lane for i, lane in enumerate(detected) if i not in partner.values()]
    return LaneScore(
        lanes=tuple(rows),
        invented=tuple(x.lane_id for x in unmatched if x.status == "confirmed"),
        unmatched_tentative=tuple(x.lane_id for x in unmatched if x.status == "tentative"),
        direction_wrong=tuple(detected[i].lane_id for i, _ in _assign(left_over)),
    )


def _compare(s: Samples, truth: Lane, true: Samples) -> _Pair:
    on_truth = project(s.point_m, truth.centerline_m)
    common = on_truth.inside
    a, b = s.tangent[common], on_truth.tangent[common]
    turn = np.arctan2(
        np.sum(b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0]), np.sum(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1])
    )
    shorter = min(len(s.point_m) * s.piece_m, len(true.point_m) * true.piece_m)
    return _Pair(on_truth.offset_m[common], float(turn), float(common.sum()) * s.piece_m / shorter)


def _assign(cost: NDArray[np.float64]) -> list[tuple[int, int]]:
    i, j = scipy.optimize.linear_sum_assignment(cost)
    return [(int(a), int(b)) for a, b in zip(i, j, strict=True) if cost[a, b] < _NO_MATCH]


def _coverage(true: Samples, detected: Lane, gate_m: float) -> float:
    # 2 * gate_m: near its ends a lane may bend away; it still covers the truth beside it.
    beside = project(true.point_m, detected.centerline_m)
    return float(np.mean(beside.inside & (np.abs(beside.offset_m) <= 2 * gate_m)))


def _row(truth: Lane, detected: Lane, pair: _Pair, coverage: float) -> MatchedLane:
    return MatchedLane(
        truth_id=truth.lane_id,
        vehicles=truth.vehicles,
        truth_length_m=truth.length_m,
        lane_id=detected.lane_id,
        status=detected.status,
        error_m=np.abs(pair.offset_m),
        bias_m=float(pair.offset_m.mean()),
        heading_error_deg=float(np.degrees(pair.heading_error_rad)),
        width_error_m=detected.width_m - truth.width_m,
        coverage=coverage,
    )
