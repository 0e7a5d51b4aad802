"""Laws of tallies: sums over runs, pooled errors."""

from __future__ import annotations

import numpy as np
import pytest

from geoorbit_ros.metrics.lane_score import LaneScore, MatchedLane, Tally


def row(
    vehicles: float, status: str | None, error_m: float = 0.1, width: float = 0.0
) -> MatchedLane:
    if status is None:
        return MatchedLane(1, vehicles, 100.0)
    return MatchedLane(
        1,
        vehicles,
        100.0,
        lane_id=1,
        status="confirmed" if status == "confirmed" else "tentative",
        error_m=np.full(50, error_m),
        width_error_m=width,
        coverage=0.5,
    )


ONE = LaneScore(
    (row(20, "confirmed", 0.1, -0.2), row(9, "tentative"), row(5, "tentative"), row(2, None)),
    invented=(7,),
    unmatched_tentative=(8,),
    direction_wrong=(),
)
TWO = LaneScore(
    (row(8, "confirmed", 0.3, 0.4), row(3, None)), (), unmatched_tentative=(), direction_wrong=(3,)
)


def tally_of(*scores: LaneScore) -> Tally:
    tally = Tally()
    for score in scores:
        tally.add(score)
    return tally


def test_lanes_are_counted_by_their_traffic() -> None:
    tally = tally_of(ONE, TWO)
    assert (tally.busy_confirmed, tally.busy) == (2, 3)
    assert (tally.sparse_found, tally.sparse) == (1, 2)
    assert (tally.invented, tally.wrong_way) == (1, 1)
    assert tally.faults == 4, "rare lanes and unmatched tentative ones are no fault"


def test_errors_are_pooled_over_samples_not_averaged_over_runs() -> None:
    many = tally_of(ONE, ONE, ONE, TWO)
    mean, p95, width = many.errors_m()
    assert mean == pytest.approx((3 * 0.1 + 0.3) / 4)
    assert p95 == pytest.approx(0.3)
    assert width == pytest.approx((3 * 0.2 + 0.4) / 4)
    assert many.coverage == pytest.approx(0.5)


def test_joining_is_the_same_as_adding_and_changes_only_one_side() -> None:
    joined, other = tally_of(ONE), tally_of(TWO)
    joined.join(other)
    both = tally_of(ONE, TWO)
    assert joined.errors_m() == both.errors_m()
    assert (joined.busy, joined.faults, joined.covered_m) == (
        both.busy,
        both.faults,
        both.covered_m,
    )
    assert len(other.error_m) == 1
    assert other.busy == 1


def test_nothing_found_is_no_number() -> None:
    nothing = tally_of(LaneScore((row(9, None),), (), (), ()))
    assert np.isnan(nothing.errors_m()).all()
    assert np.isnan(nothing.coverage)
    assert nothing.faults == 1
