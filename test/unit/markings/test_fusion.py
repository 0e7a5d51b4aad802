"""Boundaries follow the paint where there is some, and the traffic elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from made_markings import (
    IMAGE_SIZE,
    ROAD_M,
    YELLOW,
    Stripe,
    lane_map,
    offset_m,
    road_image,
    road_plane,
)

from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.lanes.confidence import MIN_VEHICLES
from geoorbit_ros.markings.fusion import RoadPaint, find_roads, with_painted_edges

MOTORWAY = (
    Stripe(0.0, 0.25),
    Stripe(3.75, 0.15, 6.0, 18.0),
    Stripe(7.5, 0.15, 6.0, 18.0),
    Stripe(11.25, 0.30),
)
DRIVEN_M = (2.15, 5.55, 9.1)
"""Drivers in the edge lanes keep to the middle of the road."""


def painted(lanes: LaneMap, stripes: Sequence[Stripe]) -> LaneMap:
    return with_painted_edges(lanes, find_roads(lanes, road_image(stripes), road_plane()))


@pytest.fixture(scope="module")
def motorway() -> LaneMap:
    return painted(lane_map(DRIVEN_M), MOTORWAY)


def test_boundaries_lie_on_the_lines(motorway: LaneMap) -> None:
    for k, lane in enumerate(motorway.lanes):
        low, high = 3.75 * k, 3.75 * (k + 1)
        for line, true_m in ((lane.left_m, low), (lane.right_m, high)):
            assert np.abs(offset_m(line) - true_m).max() < 0.1
            assert abs(float(offset_m(line).mean()) - true_m) < 0.03
        middle = 0.5 * (low + high)
        assert np.abs(offset_m(lane.centerline_m) - middle).max() < 0.08
        assert lane.width_m == pytest.approx(3.75, abs=0.05)
        assert lane.driven_offset_m == pytest.approx(middle - DRIVEN_M[k], abs=0.05)


def test_edges_say_what_they_are(motorway: LaneMap) -> None:
    kinds = [(lane.left_edge, lane.right_edge) for lane in motorway.lanes]
    assert [(a and a.marking, b and b.marking) for a, b in kinds] == [
        ("solid", "dashed"), ("dashed", "dashed"), ("dashed", "solid"),
    ]  # fmt: skip
    for pair in kinds:
        for edge in pair:
            assert edge is not None
            assert (edge.source, edge.colour) == ("paint", "white")
            assert edge.painted_share > 0.95
            assert 0.0 < edge.sigma_m < 0.15


def test_everything_else_about_the_lanes_stays(motorway: LaneMap) -> None:
    before = lane_map(DRIVEN_M)
    for lane, old in zip(motorway.lanes, before.lanes, strict=True):
        same = ("lane_id", "confidence", "status", "vehicles", "vehicles_missing", "evidence")
        assert [getattr(lane, n) for n in same] == [getattr(old, n) for n in same]
        assert len(lane.centerline_m) == len(old.centerline_m)
    assert (motorway.stamp_ns, motorway.doubtful) == (before.stamp_ns, before.doubtful)


def test_a_road_without_paint_keeps_the_lanes_of_its_traffic() -> None:
    before = lane_map(DRIVEN_M)
    for lane, old in zip(painted(before, ()).lanes, before.lanes, strict=True):
        for name in ("centerline_m", "left_m", "right_m"):
            assert np.array_equal(getattr(lane, name), getattr(old, name))
        assert lane.width_m == old.width_m
        assert lane.left_edge is not None
        assert (lane.left_edge.source, lane.left_edge.marking) == ("traffic", "")
        assert np.isnan(lane.driven_offset_m)


def test_each_direction_has_its_own_left() -> None:
    yellow = Stripe(3.75, 0.15, colour=YELLOW)
    lanes = painted(
        lane_map((1.7, 5.9), opposite=(True, False)), (MOTORWAY[0], yellow, Stripe(7.5))
    ).lanes
    for lane in lanes:
        assert lane.left_edge is not None
        assert lane.right_edge is not None
        assert (lane.left_edge.colour, lane.right_edge.colour) == ("yellow", "white")
        assert abs(float(offset_m(lane.left_m).mean()) - 3.75) < 0.03
        assert lane.width_m == pytest.approx(3.75, abs=0.04)
    # Drivers going south are 0.175 m west of their lane's middle: to their right.
    assert lanes[0].driven_offset_m == pytest.approx(-0.175, abs=0.05)
    assert lanes[1].driven_offset_m == pytest.approx(-0.275, abs=0.05)


def test_a_guard_rail_beyond_the_edge_line_bounds_nothing() -> None:
    rail = Stripe(12.4, 0.3)
    lane = painted(lane_map(DRIVEN_M), (*MOTORWAY, rail)).lanes[2]
    assert abs(float(offset_m(lane.right_m).mean()) - 11.25) < 0.03


def test_a_shoulder_is_not_part_of_the_lane() -> None:
    # The hard shoulder ends where the pavement does, at 14 m, beside another line.
    lane = painted(lane_map(DRIVEN_M), (*MOTORWAY, Stripe(13.5, 0.12))).lanes[2]
    assert abs(float(offset_m(lane.right_m).mean()) - 11.25) < 0.03


def test_two_lines_between_two_lanes() -> None:
    stripes = (Stripe(0.0), Stripe(3.5), Stripe(4.4), Stripe(7.9))
    left, right = painted(lane_map((1.75, 6.15)), stripes).lanes
    assert abs(float(offset_m(left.right_m).mean()) - 3.5) < 0.03
    assert abs(float(offset_m(right.left_m).mean()) - 4.4) < 0.03


def test_two_bundles_of_traffic_in_one_painted_lane_are_that_lane() -> None:
    """Vans keep left and cars right in the middle lane: the traffic has four lanes, the paint 3."""
    before = lane_map((1.875, 4.8, 6.6, 9.375), width_m=1.8)
    after = painted(before, MOTORWAY)
    assert len(after.lanes) == 3
    middle = after.lanes[1]
    assert middle.lane_id == before.lanes[1].lane_id
    assert middle.vehicles == before.lanes[1].vehicles + before.lanes[2].vehicles
    assert middle.width_m == pytest.approx(3.75, abs=0.05)


@pytest.mark.parametrize(
    ("driven_m", "stripes"),
    [
        # Narrow lanes with worn paint between them.
        ((1.4, 4.2), (Stripe(0.0), Stripe(5.6))),
        # A line between the two bundles.
        ((4.8, 6.6), (Stripe(3.75), Stripe(5.7), Stripe(7.5))),
        # Unpainted.
        ((1.4, 3.4), ()),
        # Joints of the concrete, 3.9 m apart, in two lanes.
        ((1.4, 4.9), (Stripe(-0.35), Stripe(1.2, 0.1), Stripe(5.1, 0.1), Stripe(6.65))),
        # The narrowest lanes, the line between them worn away but for a short way.
        ((1.25, 3.75), (Stripe(0.0), Stripe(2.5, y_m=(25.0, 42.0)), Stripe(5.0))),
    ],
)
def test_bundles_of_traffic_stay_lanes_where_paint_allows_two(
    driven_m: tuple[float, ...], stripes: tuple[Stripe, ...]
) -> None:
    assert len(painted(lane_map(driven_m, width_m=2.0), stripes).lanes) == 2


def test_a_lane_that_begins_where_another_ends_is_no_bundle_of_it() -> None:
    before = lane_map((1.875, 4.8, 6.6, 9.375), width_m=1.8)
    first, near, far, last = before.lanes
    cut = [
        replace(
            lane,
            centerline_m=lane.centerline_m[part],
            left_m=lane.left_m[part],
            right_m=lane.right_m[part],
        )
        for lane, part in ((near, slice(0, 18)), (far, slice(14, None)))
    ]
    after = painted(replace(before, lanes=(first, *cut, last)), MOTORWAY)
    assert len(after.lanes) == 4


def test_the_error_is_told_at_each_point_of_a_boundary() -> None:
    worn = replace(MOTORWAY[0], y_m=(0.0, 65.0))
    lane = painted(lane_map(DRIVEN_M), (worn, *MOTORWAY[1:])).lanes[0]
    assert lane.left_edge is not None
    assert lane.right_edge is not None
    for edge in (lane.left_edge, lane.right_edge):
        assert len(edge.sigma_along_m) == len(lane.left_m)
    sigma, y = np.array(lane.left_edge.sigma_along_m), lane.left_m[:, 1]
    assert sigma[y < 60.0].max() < 0.5 * lane.width_sigma_m + lane.left_edge.sigma_m
    assert sigma[y > 70.0].min() >= before_sigma_m(), "without its line it is no surer than traffic"
    # A pixel covers more of the road where it is far away.
    right = np.array(lane.right_edge.sigma_along_m)
    assert right[np.argmax(y)] > right[np.argmin(y)]


@pytest.mark.parametrize("shift_m", [0.0, 0.2])
def test_an_error_that_both_lines_share_is_one_of_the_middle_not_of_the_width(
    shift_m: float,
) -> None:
    """The calibration may be off to the east, by the same distance everywhere."""
    plane = road_plane()
    spread = np.zeros_like(plane.spread)
    spread[0] = shift_m * np.outer([1.0, 0.0, 0.0], plane.matrix[2])
    lanes = lane_map(DRIVEN_M)
    roads = find_roads(lanes, road_image(MOTORWAY), replace(plane, spread=spread))
    for lane in with_painted_edges(lanes, roads).lanes:
        assert 0.01 < lane.width_sigma_m < 0.12
        assert lane.sigma_m == pytest.approx(max(shift_m, 0.04), abs=0.04)
        assert lane.left_edge is not None
        assert lane.left_edge.sigma_m == pytest.approx(max(shift_m, 0.06), abs=0.05)


def before_sigma_m() -> float:
    """Of boundaries by the traffic alone."""
    return lane_map(DRIVEN_M).lanes[0].width_sigma_m


def test_one_line_alone_moves_its_boundary_only() -> None:
    lane = painted(lane_map((2.0,)), (Stripe(0.0, 0.25),)).lanes[0]
    assert abs(float(offset_m(lane.left_m).mean())) < 0.03
    assert 3.2 < lane.width_m < 4.0
    assert lane.right_edge is not None
    assert lane.right_edge.source == "traffic"
    assert np.isnan(lane.driven_offset_m)


def test_a_line_that_ends_goes_on_beside_the_lane() -> None:
    worn = replace(MOTORWAY[0], y_m=(0.0, 65.0))
    lane = painted(lane_map(DRIVEN_M), (worn, *MOTORWAY[1:])).lanes[0]
    assert lane.left_edge is not None
    share = (65.0 - ROAD_M[0]) / (ROAD_M[1] - ROAD_M[0])
    assert lane.left_edge.painted_share == pytest.approx(share, abs=0.05)
    assert np.abs(offset_m(lane.left_m)).max() < 0.1


def test_lines_far_beside_the_traffic_are_of_another_view() -> None:
    """The pole was bumped: all lines lie 1.4 m beside where vehicles drive."""
    before = lane_map([x + 1.4 for x in (1.875, 5.625, 9.375)], width_m=3.7)
    paint = RoadPaint(road_image(MOTORWAY), road_plane(), IMAGE_SIZE)
    after = paint.follow(before)
    for lane, old in zip(after.lanes, before.lanes, strict=True):
        assert np.array_equal(lane.left_m, old.left_m)
    assert "has the camera moved" in paint.sentence


def test_a_later_map_takes_the_lines_of_an_earlier_one() -> None:
    paint = RoadPaint(road_image(MOTORWAY), road_plane(), IMAGE_SIZE)
    paint.follow(lane_map(DRIVEN_M))
    later = lane_map([x + 0.1 for x in DRIVEN_M])
    quick, thorough = paint.follow(later, anew=False), paint.follow(later)
    for a, b in zip(quick.lanes, thorough.lanes, strict=True):
        assert np.abs(a.left_m[:, 0] - b.left_m[:, 0]).max() < 0.06
        assert a.driven_offset_m == pytest.approx(b.driven_offset_m, abs=0.02)
    # Another lane: the image is looked at again.
    fewer = replace(later, lanes=later.lanes[:2])
    found = paint.follow(fewer, anew=False)
    assert [lane.right_edge and lane.right_edge.source for lane in found.lanes] == ["paint"] * 2


DASHES = (3.0, 9.0)
WIDE = (
    Stripe(0.0, 0.25),
    Stripe(3.75, 0.15, *DASHES),
    Stripe(7.5, 0.15, *DASHES),
    Stripe(11.25, 0.15, *DASHES),
    Stripe(15.0, 0.30),
)
"""Four lanes that lead north."""


def unused_in(lanes: LaneMap) -> list[Lane]:
    return [lane for lane in lanes.lanes if lane.vehicles == 0.0]


@pytest.mark.parametrize("south", [False, True])
def test_a_painted_lane_that_nobody_used_is_tentative(south: bool) -> None:
    before = lane_map((1.9, 5.6, 9.4), opposite=(south,) * 3)
    after = painted(before, WIDE)
    (lane,) = unused_in(after)
    assert (lane.status, lane.vehicles, lane.confidence) == ("tentative", 0.0, 0.0)
    assert lane.vehicles_missing == MIN_VEHICLES
    assert lane.lane_id not in {other.lane_id for other in before.lanes}
    assert float(offset_m(lane.centerline_m).mean()) == pytest.approx(13.125, abs=0.05)
    assert lane.width_m == pytest.approx(3.75, abs=0.05)
    assert abs((lane.heading_deg - before.lanes[0].heading_deg + 180.0) % 360.0 - 180.0) < 3.0
    edges = (lane.left_edge, lane.right_edge)
    kinds = ["solid", "dashed"] if south else ["dashed", "solid"]
    assert [edge and edge.marking for edge in edges] == kinds
    assert np.isnan(lane.driven_offset_m)
    # The others stand, in their order.
    assert [lane.lane_id for lane in after.lanes[:-1]] == [lane.lane_id for lane in before.lanes]


def test_there_may_be_one_on_either_side() -> None:
    right, left = unused_in(painted(lane_map((5.6, 9.4)), WIDE))
    for lane, middle_m in ((right, 13.125), (left, 1.875)):
        ends = [float(offset_m(line).mean()) for line in (lane.left_m, lane.right_m)]
        assert ends == pytest.approx([middle_m - 1.875, middle_m + 1.875], abs=0.05)
    assert right.lane_id != left.lane_id


def test_it_keeps_its_number_when_the_map_is_renewed() -> None:
    before = lane_map((1.9, 5.6, 9.4))
    later = (replace(lane, vehicles=lane.vehicles + 9.0) for lane in before.lanes)
    paint = RoadPaint(road_image(WIDE), road_plane(), IMAGE_SIZE)
    first = paint.follow(before)
    again = paint.follow(replace(before, stamp_ns=2, lanes=tuple(later)), anew=False)
    assert [lane.lane_id for lane in again.lanes] == [lane.lane_id for lane in first.lanes]
    assert len(unused_in(again)) == 1


@pytest.mark.parametrize(
    ("driven", "opposite", "stripes"),
    [
        # A hard shoulder with a line at its end; a gore; a lane of its own behind a solid line.
        (DRIVEN_M, (), (*MOTORWAY, Stripe(14.5, 0.2))),
        ((1.9, 5.6), (), (*WIDE[:2], Stripe(7.5, 0.15), *WIDE[3:])),
        # Traffic both ways, or one lane: paint does not say which way the next one leads.
        ((1.9, 5.6, 9.4), (True, False, False), WIDE),
        ((9.4,), (), WIDE),
        # Dashes of another kind, an edge line that is dashed, nothing beyond.
        ((1.9, 5.6, 9.4), (), (*WIDE[:3], Stripe(11.25, 0.15, 1.0, 2.0), WIDE[4])),
        ((1.9, 5.6, 9.4), (), (*WIDE[:3], Stripe(11.25, 0.15, 9.5, 13.0), WIDE[4])),
        ((1.9, 5.6, 9.4), (), WIDE[:4]),
        # A lane for bicycles, and a line far away.
        ((1.9, 5.6, 9.4), (), (*WIDE[:4], Stripe(13.0, 0.25))),
        ((1.9, 5.6, 9.4), (), (*WIDE[:4], Stripe(16.2, 0.25))),
    ],
)
def test_no_lane_is_invented_beside_the_traffic(
    driven: tuple[float, ...], opposite: tuple[bool, ...], stripes: tuple[Stripe, ...]
) -> None:
    assert unused_in(painted(lane_map(driven, opposite=opposite), stripes)) == []
