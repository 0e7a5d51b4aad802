"""Laws of the curvilinear estimator on exact roads."""

from __future__ import annotations

import numpy as np
import pytest
from made_lane_traffic import Stream, arc, rotated, straight, traffic
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.core.polylines import project
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames, frames_from_rows
from geoorbit_ros.lanes.estimators.curvilinear.estimator import CurvilinearEstimator
from geoorbit_ros.lanes.parameters import LaneParameters

LANE_M = 3.6


def lanes_of(frames: Frames) -> LaneMap:
    estimator = CurvilinearEstimator()
    for k, stamp_ns in enumerate(frames.stamp_ns):
        estimator.add(int(stamp_ns), frames.frame(k))
    return estimator.lanes(LaneParameters())


def distance_m(points: NDArray[np.float64], line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of points to a densely sampled line."""
    dx, dy = np.moveaxis(points[:, None] - line[None], 2, 0)
    return np.asarray(np.hypot(dx, dy).min(axis=1))


def joined(*parts: Frames) -> Frames:
    """Traffic of several sources at once; track ids are made distinct."""
    rows, stamps = [], []
    for k, part in enumerate(parts):
        table = part.rows.copy()
        table["track_id"] += 10_000 * k
        rows.append(table)
        stamps.append(part.row_stamp_ns())
    return frames_from_rows(np.concatenate(stamps), np.concatenate(rows))


@pytest.mark.parametrize("heading_deg", [0, 37, 90, 200, 301])
def test_straight_road_at_any_heading(heading_deg: float) -> None:
    heading = np.radians(heading_deg)
    frames = traffic([Stream(straight(heading, k * LANE_M), 12) for k in range(3)])
    found = lanes_of(frames).confirmed
    assert len(found) == 3
    truth = [straight(heading, k * LANE_M)(np.linspace(-5, 130, 2000)) for k in range(3)]
    for lane in found:
        error = min(distance_m(lane.centerline_m, line).mean() for line in truth)
        assert error < 0.2
        assert abs(lane.width_m - LANE_M) < 0.15
        assert abs((lane.heading_deg - (90 - heading_deg) + 180) % 360 - 180) < 2.0


def test_the_histogram_shows_lanes_that_spread_apart_at_one_place() -> None:
    ramp = straight(0.08, -LANE_M)  # 11 m further away after 135 m
    found = lanes_of(traffic([Stream(straight(0.0, 0.0), 16), Stream(ramp, 16)]))
    (section,) = found.cross_sections
    assert len(section.peak_m) == 2
    for peak_m in section.peak_m:
        beside = np.abs(section.offset_m - peak_m) < LANE_M / 2
        here = np.interp(peak_m, section.offset_m, section.density)
        assert here > 0.9 * section.density[beside].max()


@pytest.mark.parametrize("radius_m", [250.0, -250.0, 80.0])
def test_bends(radius_m: float) -> None:
    curves = [arc(radius_m, 0.4, k * LANE_M) for k in range(3)]
    found = lanes_of(traffic([Stream(c, 14) for c in curves])).confirmed
    assert len(found) == 3
    for lane in found:
        error = min(
            distance_m(lane.centerline_m, c(np.linspace(-5, 130, 4000))).mean() for c in curves
        )
        assert error < 0.2


def test_turning_and_shifting_the_world_changes_nothing() -> None:
    frames = joined(
        traffic([Stream(arc(200.0, 0.0, k * LANE_M), 12) for k in range(3)]),
        traffic([Stream(straight(np.pi, 15.0 + k * LANE_M), 5 + 5 * k) for k in range(2)], seed=1),
    )
    angle, shift = 2.1, (120.0, -45.0)
    here, there = lanes_of(frames), lanes_of(rotated(frames, angle, shift))
    assert [lane.status for lane in here.lanes] == [lane.status for lane in there.lanes]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for a, b in zip(here.lanes, there.lanes, strict=True):
        assert a.vehicles == pytest.approx(b.vehicles)
        assert a.width_m == pytest.approx(b.width_m, abs=2e-3)
        np.testing.assert_allclose(a.centerline_m @ turn.T + shift, b.centerline_m, atol=0.02)


def test_both_directions_of_a_two_lane_road() -> None:
    east = Stream(straight(0.0, 0.0), 10)
    west = Stream(lambda s: np.column_stack([120.0 - s, 0.0 * s + LANE_M]), 10)
    found = lanes_of(traffic([east, west])).confirmed
    assert sorted(round(lane.heading_deg) % 360 for lane in found) == [90, 270]


def test_sparse_lane_is_tentative_and_says_what_is_missing() -> None:
    frames = traffic([Stream(straight(0.3, 0.0), 14), Stream(straight(0.3, LANE_M), 3)])
    found = lanes_of(frames).lanes
    assert [lane.status for lane in sorted(found, key=lambda k: k.vehicles)] == [
        "tentative",
        "confirmed",
    ]
    sparse = min(found, key=lambda k: k.vehicles)
    assert sparse.vehicles == pytest.approx(3.0, abs=0.01)
    assert sparse.vehicles_missing >= 1


def test_lane_changers_make_no_lane() -> None:
    def change(s: NDArray[np.float64]) -> NDArray[np.float64]:
        d = LANE_M * 0.5 * (1.0 - np.cos(np.pi * np.clip((s - 20.0) / 80.0, 0.0, 1.0)))
        return np.column_stack([s, d])

    streams = [Stream(straight(0.0, 0.0), 10), Stream(straight(0.0, LANE_M), 10), Stream(change, 8)]
    found = lanes_of(traffic(streams)).confirmed
    assert sorted(round(lane.middle[1] / LANE_M) for lane in found) == [0, 1]


def test_second_bundle_inside_a_lane_is_no_lane() -> None:
    trucks = traffic([Stream(straight(0.0, 1.4), 10, wander_m=0.05)], seed=3)
    trucks.rows["class_id"] = 7
    cars = traffic([Stream(straight(0.0, k * LANE_M), 12, wander_m=0.05) for k in range(2)])
    found = lanes_of(joined(cars, trucks)).lanes
    assert len(found) == 2


def test_parked_and_jittering_boxes_are_no_traffic() -> None:
    random = np.random.default_rng(0)
    stamps = np.arange(600) * 100_000_000
    parked = np.zeros(600, TRACK_DTYPE)
    parked["x"], parked["y"] = random.normal(30.0, 0.4, 600), random.normal(9.0, 0.4, 600)
    parked["sigma"], parked["class_id"], parked["track_id"] = 0.3, 2, 1
    road = traffic([Stream(straight(0.0, 0.0), 10)])
    found = lanes_of(joined(road, frames_from_rows(stamps, parked))).lanes
    assert len(found) == 1


def test_people_on_a_pavement_make_no_lane() -> None:
    road = traffic([Stream(straight(0.0, 0.0), 10)])
    people = traffic([Stream(straight(0.0, -5.0), 12, speed_mps=1.5, end_m=30.0)], seed=2)
    mistaken = np.random.default_rng(0).uniform(size=len(people.rows)) < 0.2
    people.rows["class_id"] = np.where(mistaken, 2, 0)
    assert len(lanes_of(joined(road, people)).lanes) == 1


def test_id_that_jumps_to_an_oncoming_vehicle_is_cut() -> None:
    times = np.arange(0, 40)
    rows = np.zeros(80, TRACK_DTYPE)
    rows["x"] = np.concatenate([times * 2.0, 80.0 - times * 2.0])
    rows["y"] = np.repeat([0.0, 5.0], 40)
    rows["sigma"], rows["track_id"], rows["class_id"] = 0.05, 1, 2
    stamps = 60_000_000_000 + np.arange(80) * 100_000_000
    swapped = frames_from_rows(stamps, rows)
    road = joined(
        traffic([Stream(straight(0.0, 0.0), 8, end_m=80.0)]),
        traffic(
            [Stream(lambda s: np.column_stack([80.0 - s, 0 * s + 5.0]), 8, end_m=80.0)], seed=5
        ),
        swapped,
    )
    found = lanes_of(road).lanes
    assert sorted(round(lane.vehicles) for lane in found) == [9, 9]


def test_ramp_that_merges_is_a_lane_of_its_own_until_it_ends() -> None:
    def ramp(s: NDArray[np.float64]) -> NDArray[np.float64]:
        away = 9.0 * np.clip((70.0 - s) / 70.0, 0.0, None) ** 1.5
        into = LANE_M * 0.5 * (1.0 - np.cos(np.pi * np.clip((s - 100.0) / 45.0, 0.0, 1.0)))
        return np.column_stack([s, -LANE_M - away + into])

    main = [Stream(straight(0.0, k * LANE_M), 12, end_m=160.0) for k in range(3)]
    found = lanes_of(traffic([*main, Stream(ramp, 10, end_m=160.0)])).confirmed
    assert len(found) == 4
    ramps = [lane for lane in found if lane.centerline_m[0, 1] < -LANE_M - 1.0]
    assert len(ramps) == 1
    assert distance_m(ramps[0].centerline_m, ramp(np.linspace(0, 130, 4000))).mean() < 0.3


@pytest.mark.parametrize("across", [7, 9, 11])
def test_lane_that_becomes_two_goes_on_straight(across: int) -> None:
    """About half of its vehicles change into the new lane at once; oncoming ones show the road."""

    def leaving(s: NDArray[np.float64]) -> NDArray[np.float64]:
        share = np.clip(s / 80.0, 0.0, 1.0)
        return np.column_stack([s, -LANE_M * share * share * (3.0 - 2.0 * share)])

    straight_on = straight()(np.linspace(0.0, 120.0, 2000))
    for seed in range(5):
        frames = joined(
            traffic([Stream(straight(), 9)], seed=seed),
            traffic([Stream(leaving, across)], seed=50 + seed),
            traffic([Stream(lambda s: straight(0.0, LANE_M)(120.0 - s), 12)], seed=90 + seed),
        )
        found = lanes_of(frames).confirmed
        assert len(found) == 3
        ahead = [lane for lane in found if distance_m(lane.centerline_m, straight_on).mean() < 0.5]
        assert len(ahead) == 1
        assert project(straight_on, ahead[0].centerline_m).inside.mean() > 0.85


def test_cutting_frames_into_other_calls_changes_nothing() -> None:
    frames = traffic([Stream(straight(0.5, k * LANE_M), 9) for k in range(2)])
    whole = lanes_of(frames)
    estimator = CurvilinearEstimator()
    for k, stamp_ns in enumerate(frames.stamp_ns):
        estimator.add(int(stamp_ns), frames.frame(k)[:0])
        for row in frames.frame(k):
            estimator.add(int(stamp_ns), np.array([row]))
    again = estimator.lanes(LaneParameters())
    assert [_bits(a) for a in whole.lanes] == [_bits(b) for b in again.lanes]


def test_a_road_elsewhere_changes_nothing() -> None:
    here = traffic([Stream(arc(200.0, 0.0, k * LANE_M), 12) for k in range(3)])
    there = traffic(
        [Stream(straight(2.0, 300.0 + k * LANE_M), 9, speed_mps=12.0) for k in range(2)], seed=3
    )
    alone = [*lanes_of(here).lanes, *lanes_of(there).lanes]
    together = lanes_of(joined(here, there)).lanes
    assert len(together) == len(alone)
    for lane in alone:
        away = [project(lane.centerline_m, t.centerline_m).offset_m for t in together]
        twin = int(np.argmin([np.median(np.abs(a)) for a in away]))
        assert np.median(np.abs(away[twin])) < 0.02
        assert lane.vehicles == pytest.approx(together[twin].vehicles, abs=0.01)


def test_frames_between_those_of_fifteen_per_second_change_nothing() -> None:
    frames = traffic([Stream(straight(0.5, k * LANE_M), 9) for k in range(2)], fps=30.0)
    number = np.round(frames.stamp_ns * 30e-9).astype(int).tolist()
    every, half = CurvilinearEstimator(), CurvilinearEstimator()
    for n in range(number[-1] + 1):
        rows = frames.frame(number.index(n)) if n in number else frames.rows[:0]
        every.add(round(n / 30.0 * 1e9), rows)
        if n % 2 == 0:
            half.add(round(n / 30.0 * 1e9), rows)
    found = every.lanes(LaneParameters()).lanes, half.lanes(LaneParameters()).lanes
    assert [_bits(a) for a in found[0]] == [_bits(b) for b in found[1]]


def _bits(lane: Lane) -> tuple[int, bytes, float, float]:
    return lane.lane_id, lane.centerline_m.tobytes(), lane.width_m, lane.confidence
