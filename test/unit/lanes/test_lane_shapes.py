"""Laws of junctions, lane ends and widths on hand-made ridges and centrelines."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.lanes.estimators.curvilinear.candidates import (
    find_candidates,
    find_ridges,
    straighten_ends,
)
from geoorbit_ros.lanes.estimators.curvilinear.centerlines import Centerline
from geoorbit_ros.lanes.estimators.curvilinear.junctions import hand_over
from geoorbit_ros.lanes.estimators.curvilinear.profiles import Profiles
from geoorbit_ros.lanes.estimators.curvilinear.ridges import MIN_SPACING_M, Ridge, separate
from geoorbit_ros.lanes.estimators.curvilinear.widths import (
    Spacing,
    lane_widths,
    neighbour_spacings,
)
from geoorbit_ros.lanes.parameters import LaneParameters

STATIONS = 40


def ridge(first: int, d: NDArray[np.float64], height: float = 5.0) -> Ridge:
    return Ridge(first, d.astype(float), np.full(len(d), height))


def line(d: NDArray[np.float64], support: NDArray[np.float64], first: int = 0) -> Centerline:
    return Centerline(first + np.arange(len(d)), d, np.full(len(d), 0.1), support)


def test_after_a_merge_the_lane_goes_on_and_the_ramp_ends() -> None:
    # The ridge of the through lane was lost where the ramp's came close; the ramp's went on.
    through = ridge(0, np.zeros(20))
    ramp = ridge(
        0, np.concatenate([np.linspace(-6.0, -1.8, 20), np.linspace(-1.6, 0.0, 6), np.zeros(14)])
    )
    lane, rest = hand_over([through, ramp], STATIONS)
    assert lane.first + len(lane.d) == STATIONS
    assert np.all(np.abs(lane.d) < 0.8)
    assert rest.first + len(rest.d) < 30


def test_a_diverge_is_a_merge_seen_backwards() -> None:
    through = ridge(20, np.zeros(20))
    ramp = ridge(
        0, np.concatenate([np.zeros(14), np.linspace(0.0, -1.6, 6), np.linspace(-1.8, -6.0, 20)])
    )
    lane, _ = hand_over([through, ramp], STATIONS)
    assert lane.first == 0
    assert np.all(np.abs(lane.d) < 0.8)


def test_of_two_ridges_too_close_the_weaker_is_cut() -> None:
    strong, weak = ridge(0, np.zeros(30), 9.0), ridge(0, np.linspace(4.0, 1.0, 30), 3.0)
    kept = separate([weak, strong])
    assert len(kept) == 2
    assert len(kept[0].d) == 30
    assert np.all(np.abs(kept[1].d) >= MIN_SPACING_M)


def test_an_emptying_lane_stays_beside_its_neighbour() -> None:
    neighbour = line(np.zeros(30), np.full(30, 20.0))
    drifting = np.concatenate([np.full(20, -3.6), np.linspace(-3.6, -2.4, 10)])
    emptying = line(drifting, np.concatenate([np.full(20, 10.0), np.linspace(7.0, 2.0, 10)]))
    straight = straighten_ends([neighbour, emptying])[1]
    assert np.all(np.abs(straight.d + 3.6) < 0.21)


def test_a_lane_that_narrows_with_full_traffic_is_left_as_it_is() -> None:
    neighbour = line(np.zeros(30), np.full(30, 20.0))
    narrowing = line(np.linspace(-3.7, -3.1, 30), np.full(30, 15.0))
    np.testing.assert_array_equal(straighten_ends([neighbour, narrowing])[1].d, narrowing.d)


def test_width_is_the_spacing_when_it_is_well_known() -> None:
    spacings = [Spacing((0, 1), 3.2, 0.01), Spacing((1, 2), 3.2, 0.01)] * 10
    width, sigma = lane_widths(np.full(3, 30.0), spacings)
    assert width == pytest.approx(np.full(3, 3.2), abs=0.02)
    assert np.all(sigma < 0.1)


def test_without_neighbours_the_width_is_typical_and_says_so() -> None:
    fast, fast_sigma = lane_widths(np.array([30.0]), [])
    slow, _ = lane_widths(np.array([8.0]), [])
    assert 3.5 < fast[0] < 3.75
    assert 3.0 < slow[0] < 3.4
    assert fast_sigma[0] > 0.2


def test_a_shoulder_between_lanes_does_not_widen_them() -> None:
    spacings = [Spacing((k, k + 1), 3.6, 0.05) for k in range(3)] + [Spacing((3, 4), 4.7, 0.05)]
    width, _ = lane_widths(np.full(5, 30.0), spacings)
    assert np.all(width < 3.75)


def test_only_lanes_side_by_side_are_neighbours() -> None:
    lines = [line(np.full(20, d), np.ones(20)) for d in (0.0, 3.5, 7.0)]
    apart = line(np.full(20, 3.5), np.ones(20), first=100)
    found = neighbour_spacings([*lines, apart], np.full(120, 5.0))
    assert [s.lanes for s in found] == [(0, 1), (1, 2)]
    assert [s.value_m for s in found] == pytest.approx([3.5, 3.5])


@pytest.mark.filterwarnings("error")
def test_stations_at_which_no_vehicle_was_seen_have_no_lanes() -> None:
    """Detections so patchy that no vehicle has two nodes near any station of its corridor."""
    none, nothing = np.empty(0, np.int64), np.empty(0)
    along, owner = np.arange(STATIONS, dtype=np.float64) * 5, np.zeros(STATIONS, np.int64)
    step, scale = np.full(STATIONS, 5.0), np.full(STATIONS, 20.0)
    profiles = Profiles(
        owner, along, step, scale, none, nothing, nothing, none, none, nothing, nothing
    )
    traced = find_ridges(profiles, np.empty(0, bool), LaneParameters())
    assert traced.density.value.sum() == 0.0
    assert find_candidates(profiles, traced) == []
