"""The paper's losses against its equations, worked out by hand or by the definition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_score import lane, moved

from geoorbit_ros.core.errors import ParameterError, TableError
from geoorbit_ros.federated.rounds.traffic import bits_per_second
from geoorbit_ros.metrics.paper_losses import (
    LaneLosses,
    LossWeights,
    center_loss,
    discrete_frechet,
    frechet_matrix,
    lane_losses,
    lane_number_loss,
    pair_lanes,
    resample,
    width_loss,
)

Array = NDArray[np.float64]
ROAD = [lane(1), lane(2, 3.5), lane(3, 7.0)]


class MiddleOffset:
    """An embedding that can be followed by hand: the lateral offset of the line's middle."""

    def embed(self, line_m: Array) -> Array:
        return line_m[:, line_m.shape[1] // 2, 1:]


def losses(detected: list, reference: list = ROAD, tolerated: int = 0) -> LaneLosses:  # type: ignore[type-arg]
    return lane_losses(detected, reference, MiddleOffset(), tolerated=tolerated)


def frechet_by_definition(p: Array, q: Array) -> float:
    """The smallest leash over all monotone walks, each written out (only for a few points)."""

    def leash(i: int, j: int) -> float:
        here = float(np.hypot(*(p[i] - q[j])))
        ways = [(i - 1, j), (i - 1, j - 1), (i, j - 1)]
        before = [leash(a, b) for a, b in ways if a >= 0 and b >= 0]
        return max(here, min(before)) if before else here

    return leash(len(p) - 1, len(q) - 1)


@given(st.integers(1, 6), st.integers(1, 6), st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_frechet_is_the_shortest_leash(n: int, m: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    p, q = random.normal(size=(n, 2)), random.normal(size=(m, 2))
    assert discrete_frechet(p, q) == pytest.approx(frechet_by_definition(p, q))
    assert discrete_frechet(q, p) == pytest.approx(discrete_frechet(p, q))


def test_frechet_of_all_pairs_at_once_is_that_of_each_pair() -> None:
    random = np.random.default_rng(4)
    p, q = [list(random.normal(size=(k, n, 2))) for k, n in ((3, 17), (4, 9))]
    each = [[discrete_frechet(a, b) for b in q] for a in p]
    np.testing.assert_allclose(frechet_matrix(p, q), each)


def test_frechet_knows_direction_and_offset() -> None:
    line = resample(lane(1).centerline_m, 64)
    assert discrete_frechet(line, line) == 0.0
    assert discrete_frechet(line, line + np.array([0.6, 0.8])) == pytest.approx(1.0)
    ends = float(np.hypot(*(line[-1] - line[0])))
    assert discrete_frechet(line, line[::-1]) == pytest.approx(ends)
    with pytest.raises(TableError, match="NaN"):
        discrete_frechet(line, line * np.nan)


def test_a_perfect_map_has_no_loss_wherever_it_is_and_however_ordered() -> None:
    assert losses(ROAD) == LaneLosses(0.0, 0.0, 0.0, 0.0, 0.0, 3)
    turned = [moved(item, 1.1, (300.0, -50.0)) for item in ROAD]
    there = losses(turned[::-1], turned)
    assert there.total == pytest.approx(0.0, abs=1e-9)


def test_geometry_is_the_sum_of_squared_width_differences() -> None:
    wide = [
        replace(item, width_m=3.5 + extra) for item, extra in zip(ROAD, (1, -2, 0.5), strict=True)
    ]
    assert width_loss(pair_lanes(wide, ROAD)) == pytest.approx(1 + 4 + 0.25)


def test_consistency_is_the_mean_frechet_distance() -> None:
    aside = [
        replace(item, centerline_m=item.centerline_m + np.array([0.3, 0.4 * k]))
        for k, item in enumerate(ROAD)
    ]
    expected = np.mean([np.hypot(0.3, 0.4 * k) for k in range(3)])
    assert losses(aside).consistency == pytest.approx(expected, abs=0.02)


def test_center_is_the_triplet_loss_with_the_nearest_other_lane_as_negative() -> None:
    def straight(lane_id: int, y: float):  # type: ignore[no-untyped-def]
        return replace(
            lane(lane_id), centerline_m=np.column_stack([np.linspace(0, 100, 50), np.full(50, y)])
        )

    truth = [straight(1, 0.0), straight(2, 3.0), straight(3, 7.0)]
    assert center_loss(pair_lanes(truth, truth), MiddleOffset()) == 0.0
    # Off by less than the nearest neighbour is far: no loss. By more: the excess of the squares.
    near = [straight(1, -2.9), straight(2, 3.0), straight(3, 7.0)]
    assert center_loss(pair_lanes(near, truth), MiddleOffset()) == pytest.approx(0.0)
    far = [straight(1, -5.0), straight(2, 3.0), straight(3, 7.0)]
    assert center_loss(pair_lanes(far, truth), MiddleOffset()) == pytest.approx(25.0 - 9.0)


@pytest.mark.parametrize(
    ("detected", "reference", "tolerated", "loss"),
    [(3, 3, 0, 0), (5, 3, 0, 2), (1, 3, 0, 2), (4, 3, 1, 0), (5, 3, 1, 1), (2, 3, 1, 1)],
)
def test_lane_number(detected: int, reference: int, tolerated: int, loss: int) -> None:
    assert lane_number_loss(detected, reference, tolerated) == loss


def test_leaving_a_bad_lane_out_gains_nothing() -> None:
    bad = replace(ROAD[2], width_m=90.0, centerline_m=ROAD[2].centerline_m + np.array([0.0, 40.0]))
    with_it, without = losses([*ROAD[:2], bad]), losses([bad])
    assert without.consistency >= with_it.consistency
    assert without.geometry >= with_it.geometry
    assert without.lane_num > with_it.lane_num


def test_an_empty_map_misses_lengths_and_widths() -> None:
    nothing = losses([])
    assert nothing.detected == 0
    assert nothing.lane_num == 3
    assert nothing.geometry == pytest.approx(sum(item.width_m**2 for item in ROAD))
    assert nothing.consistency == pytest.approx(0.5 * ROAD[0].length_m, rel=0.1)


def test_the_total_is_the_weighted_sum() -> None:
    wide = [replace(item, width_m=5.0) for item in ROAD[:2]]
    weights = LossWeights(1.0, 2.0, 3.0, 4.0)
    found = lane_losses(wide, ROAD, MiddleOffset(), weights)
    terms = found.consistency + 2 * found.geometry + 3 * found.center + 4 * found.lane_num
    assert found.total == pytest.approx(terms)
    with pytest.raises(ParameterError, match="geometry"):
        LossWeights(geometry=-1.0)


def test_no_reference_is_refused() -> None:
    with pytest.raises(TableError, match="reference"):
        losses(ROAD, [])


def test_bits_per_second() -> None:
    assert bits_per_second(1000, 4.0) == 2000.0
    with pytest.raises(ParameterError, match="time"):
        bits_per_second(1, 0.0)
