"""Laws of the score: what is right scores perfectly, each kind of error is counted once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import offset_line, project, sample
from geoorbit_ros.metrics.score import score_lanes


def lane(
    lane_id: int,
    offset_m: float = 0.0,
    *,
    start_m: float = 0.0,
    end_m: float = 200.0,
    radius_m: float = 400.0,
    vehicles: float = 20.0,
    width_m: float = 3.5,
    back: bool = False,
) -> Lane:
    """A lane on an arc, `offset_m` to the left of the arc through the origin heading east."""
    angle = np.linspace(start_m, end_m, 60) / radius_m
    r = radius_m - offset_m
    center = np.column_stack((r * np.sin(angle), radius_m - r * np.cos(angle)))
    if back:
        center = center[::-1].copy()
    half = width_m / 2
    sides = offset_line(center, half), offset_line(center, -half)
    return Lane(lane_id, center, *sides, width_m, 0.1, 0.95, "confirmed", vehicles)


def moved(item: Lane, turn_rad: float, shift: tuple[float, float]) -> Lane:
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    turn = np.array([[c, s], [-s, c]])
    names = ("centerline_m", "left_m", "right_m")
    return replace(item, **{n: getattr(item, n) @ turn + np.array(shift) for n in names})


TRUTH = [lane(1), lane(2, 3.5), lane(3, 7.0), lane(4, 12.0, back=True), lane(5, 15.5, back=True)]


def test_the_truth_scores_perfectly_against_itself() -> None:
    score = score_lanes(TRUTH, TRUTH)
    assert score.passed
    assert score.missed() == score.invented == score.direction_wrong == ()
    assert [row.lane_id for row in score.lanes] == [1, 2, 3, 4, 5]
    assert score.centerline_p95_m == pytest.approx(0.0, abs=1e-9)
    assert score.width_error_m == 0.0
    assert score.coverage == 1.0


@settings(max_examples=30, deadline=None)
@given(
    offset=st.floats(-1.2, 1.2),
    turn=st.floats(-np.pi, np.pi),
    shift=st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)),
    order=st.permutations(range(5)),
)
def test_a_sideways_shift_is_the_error_wherever_the_road_points(
    offset: float, turn: float, shift: tuple[float, float], order: list[int]
) -> None:
    found = [lane(k + 10, 3.5 * k + offset) for k in range(3)]
    found += [lane(k + 10, 12.0 + 3.5 * (k - 3) + offset, back=True) for k in (3, 4)]
    score = score_lanes(
        [moved(found[k], turn, shift) for k in order], [moved(x, turn, shift) for x in TRUTH]
    )
    assert [row.lane_id for row in score.lanes] == [10, 11, 12, 13, 14]
    assert score.centerline_mean_m == pytest.approx(abs(offset), abs=5e-3)  # arcs of 60 points
    assert score.lanes[0].bias_m == pytest.approx(offset, abs=5e-3)
    assert score.lanes[4].bias_m == pytest.approx(-offset, abs=5e-3)
    assert score.passed


def test_what_reaches_beyond_the_truth_is_no_error_and_what_is_short_is_coverage() -> None:
    long = score_lanes([lane(1, 0.1, start_m=-80.0, end_m=300.0)], [lane(9)])
    assert long.centerline_p95_m == pytest.approx(0.1, abs=0.02)
    assert long.coverage == 1.0
    short = score_lanes([lane(1, 0.1, start_m=50.0, end_m=170.0)], [lane(9)])
    assert short.centerline_p95_m == pytest.approx(0.1, abs=0.02)
    assert short.coverage == pytest.approx(0.6, abs=0.01)


def test_missed_lanes_are_counted_by_their_traffic() -> None:
    traffic = [20.0, 8.0, 7.0, 3.0, 2.0, float("nan")]
    truth = [lane(k, 3.5 * k, vehicles=v) for k, v in enumerate(traffic)]
    score = score_lanes([], truth)
    assert score.missed("busy") == (0, 1)
    assert score.missed("sparse") == (2, 3)
    assert score.missed("rare") == (4,)
    assert score.missed("unknown") == (5,)
    assert len(score.missed()) == 6
    assert np.isnan(score.centerline_mean_m)
    assert not score.passed


def test_a_rare_lane_need_not_be_found_and_a_sparse_one_need_not_be_confirmed() -> None:
    truth = [lane(1), lane(2, 3.5, vehicles=4.0), lane(3, 7.0, vehicles=2.0)]
    tentative = replace(lane(2, 3.6), status="tentative")
    assert score_lanes([lane(1), tentative], truth).passed
    assert not score_lanes([lane(1)], truth).passed


def test_a_busy_lane_that_is_only_tentative_is_named() -> None:
    score = score_lanes([replace(lane(1), status="tentative")], [lane(1)])
    assert score.unconfirmed == (1,)
    assert score.missed() == ()
    assert not score.passed


def test_a_second_lane_on_the_same_truth_is_invented() -> None:
    score = score_lanes([lane(1, 0.1), lane(2, 1.0)], [lane(9)])
    assert score.lanes[0].lane_id == 1
    assert score.invented == (2,)
    assert not score.passed


def test_tentative_lanes_without_a_truth_are_counted_apart() -> None:
    tentative = replace(lane(2, 30.0), status="tentative")
    score = score_lanes([lane(1), tentative], [lane(9)])
    assert score.unmatched_tentative == (2,)
    assert score.invented == ()
    assert score.passed


def test_a_confirmed_lane_is_preferred_to_its_tentative_double() -> None:
    double = replace(lane(2, 0.0), status="tentative")
    score = score_lanes([double, lane(1, 0.1)], [lane(9)])
    assert score.lanes[0].lane_id == 1
    assert score.invented == ()


def test_the_wrong_way_is_missed_invented_and_named() -> None:
    score = score_lanes([lane(1), lane(2, 3.5, back=True)], [lane(1), lane(2, 3.5)])
    assert score.direction_wrong == (2,)
    assert score.missed() == (2,)
    assert score.invented == (2,)
    assert not score.passed


def test_opposite_lanes_side_by_side_are_told_apart_by_direction() -> None:
    truth = [lane(1), lane(2, 1.5, back=True)]
    score = score_lanes([lane(7, 1.4), lane(8, 0.1, back=True)], truth)
    assert [row.lane_id for row in score.lanes] == [7, 8]


@pytest.mark.parametrize(("offset", "found"), [(1.7, True), (1.8, False)])
def test_the_gate_is_half_a_lane(offset: float, found: bool) -> None:
    score = score_lanes([lane(1, offset)], [lane(9)])
    assert (score.missed() == ()) is found


def test_a_lane_beside_the_truth_for_a_few_metres_is_no_match() -> None:
    score = score_lanes([lane(1, start_m=170.0, end_m=370.0)], [lane(9)])
    assert score.missed() == (9,)
    assert score.invented == (1,)


def test_as_many_pairs_as_possible_then_the_nearest() -> None:
    truth = [lane(1), lane(2, 3.0)]
    score = score_lanes([lane(7, 1.4), lane(8, -0.2)], truth)
    assert [row.lane_id for row in score.lanes] == [8, 7]


def test_width_error_ignores_truths_without_width() -> None:
    truth = [lane(1, width_m=3.5), lane(2, 3.5, width_m=float("nan"))]
    score = score_lanes([lane(1, width_m=3.2), lane(2, 3.5)], truth)
    assert score.width_error_m == pytest.approx(0.3)
    assert score.lanes[0].width_error_m == pytest.approx(-0.3)
    assert score.as_dict()["lanes"][1]["width_error_m"] is None  # type: ignore[index]


def test_nothing_against_nothing() -> None:
    score = score_lanes([], [])
    assert score.passed
    assert score.as_dict()["truth"] == 0


def test_projection_agrees_with_brute_force() -> None:
    rng = np.random.default_rng(0)
    line = np.cumsum(rng.normal(size=(30, 2)), axis=0)
    points = rng.normal(scale=5.0, size=(200, 2))
    dense = sample(line, 1e-3).point_m
    nearest = np.min(np.hypot(*(points[:, None] - dense[None]).transpose(2, 0, 1)), axis=1)
    np.testing.assert_allclose(np.abs(project(points, line).offset_m), nearest, atol=1e-3)


def test_left_is_positive() -> None:
    line = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 0.0], [20.0, 0.0]])  # a repeated vertex
    foot = project(np.array([[5.0, 2.0], [15.0, -1.0], [-1.0, 0.0], [21.0, 1.0]]), line)
    np.testing.assert_allclose(foot.offset_m[:2], [2.0, -1.0])
    np.testing.assert_allclose(foot.arc_m, [5.0, 15.0, 0.0, 20.0])
    assert foot.inside.tolist() == [True, True, False, False]
    assert offset_line(line[[0, 1, 3]], 1.0)[:, 1].tolist() == [1.0, 1.0, 1.0]
