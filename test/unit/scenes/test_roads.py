"""Laws of road geometry: what meets, what is parallel, what continues into what."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_scenes import Array, changed

from geoorbit_ros.scenes.road_plan import Road
from geoorbit_ros.scenes.roads import LaneKey, PlacedRoad, lane_chains, place_roads
from geoorbit_ros.scenes.scene import load_scene, shipped_scenes

BASE = load_scene("straight_3x3")
HEADINGS = st.floats(0.0, 360.0)
TURNS = st.floats(1.0, 120.0) | st.floats(-120.0, -1.0)


def placed(*roads: dict[str, object]) -> dict[str, PlacedRoad]:
    """Roads in a scene whose camera and traffic know the first one only."""
    first = str(roads[0]["id"])
    point = {"road": first, "along_m": 1.0}
    camera = {"height_m": 10, "pole": point | {"right_m": 30.0}, "look_at": point}
    traffic = {"flows": [{"route": [first], "per_hour": 100}]}
    scene = changed(BASE, roads=list(roads), camera=camera, traffic=traffic)
    return place_roads(scene)


def main_road(heading_deg: float, turn_deg: float = 10.0, lanes: int = 3) -> dict[str, object]:
    return {
        "id": "main",
        "lanes": lanes,
        "start": {"x_m": 50, "y_m": -20, "heading_deg": heading_deg},
        "path": [{"straight_m": 80}, {"radius_m": 150, "turn_deg": turn_deg}, {"straight_m": 30}],
    }


def end_gap(a: PlacedRoad, lane_a: int, b: PlacedRoad, lane_b: int) -> float:
    """Distance from the end of a lane to the beginning of another."""
    return float(np.hypot(*(a.centerline(lane_a)[-1] - b.centerline(lane_b)[0])))


def turn_between(a: float, b: float) -> float:
    return float(np.abs((a - b + np.pi) % (2 * np.pi) - np.pi))


def distance(points: Array, line: Array) -> Array:
    """(N,) distance of points from a polyline's segments."""
    a, step = line[:-1], np.diff(line, axis=0)
    rel = points[:, None] - a
    t = np.clip((rel * step).sum(axis=2) / (step**2).sum(axis=1), 0.0, 1.0)
    gap = rel - t[..., None] * step
    return np.asarray(np.hypot(gap[..., 0], gap[..., 1]).min(axis=1))


@settings(max_examples=40, deadline=None)
@given(HEADINGS, TURNS)
def test_a_road_starts_where_and_as_it_says_and_has_its_length(heading: float, turn: float) -> None:
    road = placed(main_road(heading, turn))["main"]
    assert np.allclose(road.border_m[0], [50, -20])
    first = road.border_m[1] - road.border_m[0]
    east, north = np.sin(np.radians(heading)), np.cos(np.radians(heading))
    assert np.allclose(first / np.hypot(*first), [east, north])
    assert turn_between(road.heading_rad[-1], road.heading_rad[0] + np.radians(turn)) < 1e-9
    length = np.hypot(*np.diff(road.border_m, axis=0).T).sum()
    assert length == pytest.approx(110 + 150 * np.radians(abs(turn)), rel=1e-4)


@settings(max_examples=20, deadline=None)
@given(HEADINGS, st.floats(10.0, 170.0), st.sampled_from([-1.0, 1.0]))
def test_a_bend_is_an_arc_about_its_centre(heading: float, turn: float, side: float) -> None:
    start = {"x_m": 0, "y_m": 0, "heading_deg": heading}
    path = [{"radius_m": 60, "turn_deg": side * turn}]
    road = placed({"id": "main", "lanes": 2, "start": start, "path": path})["main"]
    direction = np.radians(90.0 - heading)
    centre = side * 60.0 * np.array([-np.sin(direction), np.cos(direction)])
    assert np.allclose(np.hypot(*(road.border_m - centre).T), 60.0, atol=1e-9)
    # Lanes are to the right: outside of a left bend, inside of a right one.
    for lane in (0, 1):
        radius = 60.0 + side * (2 - lane - 0.5) * 3.6
        assert np.allclose(np.hypot(*(road.centerline(lane) - centre).T), radius, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(HEADINGS, TURNS, TURNS, st.integers(1, 3), st.data())
def test_ramps_end_and_begin_exactly_at_their_lane(
    heading: float, turn: float, ramp_turn: float, ramp_lanes: int, data: st.DataObject
) -> None:
    lane = data.draw(st.integers(0, 3 - ramp_lanes))
    ramp = {"lanes": ramp_lanes, "path": [{"radius_m": 90, "turn_deg": ramp_turn}]}
    ref = {"road": "main", "lane": lane}
    on, off = ramp | {"id": "on", "joins": ref}, ramp | {"id": "off", "leaves": ref}
    roads = placed(main_road(heading, turn), on, off)
    main = roads["main"]
    for k in range(ramp_lanes):
        assert end_gap(roads["on"], k, main, lane + k) < 1e-9
        assert end_gap(main, lane + k, roads["off"], k) < 1e-9
    assert turn_between(roads["on"].heading_rad[-1], main.heading_rad[0]) < 1e-9
    assert turn_between(roads["off"].heading_rad[0], main.heading_rad[-1]) < 1e-9


@settings(max_examples=20, deadline=None)
@given(HEADINGS, TURNS, st.floats(0.0, 20.0))
def test_the_other_carriageway_is_parallel_at_the_medians_distance(
    heading: float, turn: float, median_m: float
) -> None:
    opposite = {"id": "other", "lanes": 2, "opposite": {"road": "main", "median_m": median_m}}
    roads = placed(main_road(heading, turn), opposite)
    main, other = roads["main"], roads["other"]
    gap = distance(other.border_m, main.border_m)
    assert np.all(np.abs(gap - median_m) < 0.02)  # chords of 2 m: a few millimetres
    fast_lanes = distance(other.centerline(1), main.centerline(2))
    assert np.all(np.abs(fast_lanes - median_m - 3.6) < 0.02)
    assert turn_between(other.heading_rad[0], main.heading_rad[-1] + np.pi) < 1e-9
    # Both keep right: the other carriageway is to the left of this one's travel.
    across = other.border_m[-1] - main.border_m[0] + [1e-9, 0.0]
    left = np.array([-np.sin(main.heading_rad[0]), np.cos(main.heading_rad[0])])
    assert across @ left > -1e-6


def chain_of(name: str, key: LaneKey) -> list[LaneKey]:
    chains = lane_chains(place_roads(load_scene(name)))
    return next(chain for chain in chains if key in chain)


def test_the_acceleration_lane_continues_the_ramp_and_ends() -> None:
    ramp = chain_of("on_ramp_merge", ("ramp", 0))
    assert ramp == [("ramp", 0), ("merge", 0)]
    middle = [("main_in", 1), ("merge", 2), ("main_out", 1)]
    assert chain_of("on_ramp_merge", ("merge", 2)) == middle


def test_the_exit_continues_the_deceleration_lane() -> None:
    assert chain_of("off_ramp_diverge", ("exit", 0)) == [("diverge", 0), ("exit", 0)]
    right = [("main_in", 0), ("diverge", 1), ("main_out", 0)]
    assert chain_of("off_ramp_diverge", ("main_in", 0)) == right


def test_the_right_lane_drops_and_the_others_go_on() -> None:
    assert chain_of("lane_drop", ("wide", 0)) == [("wide", 0)]
    assert chain_of("lane_drop", ("wide", 1)) == [("wide", 1), ("narrow", 0)]
    assert chain_of("lane_drop", ("wide", 2)) == [("wide", 2), ("narrow", 1)]


def test_a_new_lane_begins_on_the_right() -> None:
    assert chain_of("lane_begins", ("climb", 0)) == [("climb", 0)]
    assert chain_of("lane_begins", ("climb", 1)) == [("single", 0), ("climb", 1)]


def test_a_side_street_begins_where_it_leaves() -> None:
    assert chain_of("urban_turn", ("side_street", 0)) == [("side_street", 0)]
    assert chain_of("urban_turn", ("street_in", 0)) == [("street_in", 0), ("street_out", 0)]


@pytest.mark.parametrize("ramp_first", [True, False])
def test_where_two_lanes_become_one_the_road_goes_on_and_the_ramp_ends(ramp_first: bool) -> None:
    path = [{"straight_m": 50}]
    ahead: dict[str, object] = {"id": "ahead", "lanes": 3, "follows": "main", "path": path}
    into = {"road": "ahead", "lane": 0}
    ramp: dict[str, object] = {"id": "ramp", "lanes": 1, "joins": into, "path": path}
    others = [ramp, ahead] if ramp_first else [ahead, ramp]
    chains = lane_chains(placed(main_road(70.0), *others))
    assert [("main", 0), ("ahead", 0)] in chains
    assert [("ramp", 0)] in chains


@pytest.mark.parametrize("name", shipped_scenes())
def test_chains_hold_every_lane_once_and_have_no_gap(name: str) -> None:
    roads = place_roads(load_scene(name))
    chains = lane_chains(roads)
    lanes = sorted((road, lane) for road, p in roads.items() for lane in range(p.road.lanes))
    assert sorted(key for chain in chains for key in chain) == lanes
    for chain in chains:
        for (a, lane_a), (b, lane_b) in pairwise(chain):
            assert end_gap(roads[a], lane_a, roads[b], lane_b) < 1e-9


def test_a_point_is_given_along_and_to_the_right() -> None:
    road = placed(main_road(90.0))["main"]  # eastwards: right is south
    assert np.allclose(road.point(30.0, 5.0), [80.0, -25.0])


def test_a_roads_own_lane_width_holds_for_it_alone() -> None:
    wide = main_road(10.0) | {"lane_width_m": 4.5}
    ramp = {"id": "ramp", "lanes": 1, "follows": "main", "path": [{"straight_m": 50}]}
    roads = placed(wide, ramp)
    assert (roads["main"].width_m, roads["ramp"].width_m) == (4.5, BASE.lane_width_m)
    assert isinstance(roads["main"].road, Road)
