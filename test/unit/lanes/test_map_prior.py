"""What a map adds to sparse lanes: something where it is right, nothing where it is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from made_detections import lane

from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.lanes.mapping.map_prior import MapPrior

X = np.arange(0.0, 150.0, 2.0)


def straight(number: int, y_m: float, **changes: object) -> Lane:
    """A lane along y, going east."""
    return replace(lane(number, np.column_stack((X, np.full(len(X), y_m)))), **changes)  # type: ignore[arg-type]


TRUE = [straight(1, 0.0), straight(2, 3.5), straight(3, 7.0)]
SPARSE = straight(2, 4.2, status="tentative", sigma_m=0.5, width_m=3.2, width_sigma_m=0.3)
SEEN = LaneMap(0, (straight(1, 0.1), SPARSE, straight(3, 6.95)))


def y_of(lane_map: LaneMap, k: int = 1) -> float:
    return float(np.median(lane_map.lanes[k].centerline_m[:, 1]))


def test_a_sparse_lane_moves_towards_a_right_map_and_stays_tentative() -> None:
    found = MapPrior(TRUE).refine(SEEN)
    assert abs(y_of(found) - 3.5) < 0.15
    assert found.lanes[1].sigma_m < 0.2
    assert (found.lanes[1].status, found.lanes[1].confidence) == ("tentative", SPARSE.confidence)
    assert found.lanes[1].width_m == pytest.approx(3.5, abs=0.1)
    assert found.lanes[0] is SEEN.lanes[0]
    assert found.lanes[2] is SEEN.lanes[2]
    between = found.lanes[1].left_m - found.lanes[1].right_m
    assert np.hypot(*between.T) == pytest.approx(found.lanes[1].width_m, abs=1e-6)


def displaced(by_m: float) -> list[Lane]:
    return [straight(each.lane_id, 3.5 * k + by_m) for k, each in enumerate(TRUE)]


@pytest.mark.parametrize(
    "wrong",
    [
        displaced(1.0),
        displaced(-1.0),
        [replace(each, centerline_m=each.centerline_m[::-1]) for each in TRUE],
        [TRUE[0], straight(2, 2.4), TRUE[2]],
        [TRUE[0], TRUE[2]],
        [TRUE[1]],
        [],
    ],
    ids=["left", "right", "turned", "one lane elsewhere", "lane missing", "no neighbour", "empty"],
)
def test_a_wrong_map_changes_no_centre_line(wrong: list[Lane]) -> None:
    assert y_of(MapPrior(wrong).refine(SEEN)) == pytest.approx(4.2)


def test_widths_that_are_wrong_where_measured_are_not_used_elsewhere() -> None:
    narrow = [replace(each, width_m=2.8) for each in TRUE]
    assert MapPrior(narrow).refine(SEEN).lanes[1].width_m == 3.2
    one = LaneMap(0, (SEEN.lanes[0], SPARSE))
    assert MapPrior(TRUE).refine(one).lanes[1].width_m == 3.2  # one width proves nothing
