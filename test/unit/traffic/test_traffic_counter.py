"""Vehicles in lanes: each one once, in its lane, however the data come in."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from made_lane_traffic import Stream, arc, rotated, straight, traffic
from numpy.typing import NDArray

from geoorbit_ros.core.errors import TableError
from geoorbit_ros.core.lanes import Lane, lane_of_map
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, TRACK_DTYPE, Frames, frames_from_rows
from geoorbit_ros.traffic.class_schemes import SCHEMES
from geoorbit_ros.traffic.count import record
from geoorbit_ros.traffic.counter import Counted, TrafficCounter
from geoorbit_ros.traffic.measures import measure
from geoorbit_ros.traffic.stations import StationPlace, place_stations

WIDTH_M = 3.5
LENGTH_M = 120.0
Path = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def lane(lane_id: int, curve: Path, begin_m: float = 0.0, end_m: float = LENGTH_M) -> Lane:
    line = curve(np.arange(begin_m, end_m + 1.0, 2.0))
    return lane_of_map(lane_id, line, offset_line(line, 1.75), offset_line(line, -1.75))


def backwards(curve: Path) -> Path:
    return lambda s: curve(LENGTH_M - s)


def drive(
    path: Path,
    speed_mps: float = 25.0,
    start_s: float = 0.0,
    track_id: int = 1,
    seen_m: tuple[float, float] = (0.0, LENGTH_M),
    seed: int = 0,
    noise_m: float = 0.1,
) -> tuple[NDArray[np.int64], NDArray[np.void]]:
    """Stamps and rows of one vehicle, ten a second."""
    s = np.arange(seen_m[0], seen_m[1], speed_mps / 10)
    rows = np.zeros(len(s), TRACK_DTYPE)
    noise = np.random.default_rng(seed).normal(0.0, noise_m, (len(s), 2))
    rows["x"], rows["y"] = (path(s) + noise).T
    rows["sigma"], rows["class_id"], rows["track_id"], rows["score"] = 0.1, 2, track_id, 0.9
    rows["length"] = 4.5
    time_s = np.round(start_s + s / speed_mps, 1)
    return np.round(time_s * 1e9).astype(np.int64), rows


def frames_of(*vehicles: tuple[NDArray[np.int64], NDArray[np.void]]) -> Frames:
    stamps, rows = zip(*vehicles, strict=True)
    return frames_from_rows(np.concatenate(stamps), np.concatenate(rows))


def count(frames: Frames, lanes: list[Lane]) -> Counted:
    counter = TrafficCounter(lanes)
    counter.add(frames)
    return counter.finish()


def changing(at_m: float, over_m: float = 40.0) -> Path:
    """From the lane on the x axis to the one on its left."""

    def path(s: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.column_stack((s, WIDTH_M * np.clip((s - at_m) / over_m + 0.5, 0.0, 1.0)))

    return path


TWO_LANES = [lane(3, straight()), lane(5, straight(offset_m=WIDTH_M))]


@pytest.mark.parametrize("curve", [straight, lambda **k: arc(150.0, **k)])
def test_every_vehicle_is_counted_once_in_the_lane_that_it_drives_in(
    curve: Callable[..., Path],
) -> None:
    paths = [curve(offset_m=WIDTH_M * k) for k in range(3)]
    frames = traffic([Stream(path, 10 + k) for k, path in enumerate(paths)], seed=4)
    counted = count(frames, [lane(k + 1, path) for k, path in enumerate(paths)])
    for table in (counted.passages, counted.crossings):
        assert np.bincount(table["lane_id"]).tolist() == [0, 10, 11, 12]
        assert len(np.unique(table["vehicle_id"])) == 33
    assert counted.in_no_lane == 0


def test_counts_and_speeds_are_those_of_the_turned_and_shifted_world() -> None:
    paths = [arc(200.0, offset_m=WIDTH_M * k) for k in range(2)]
    frames = traffic([Stream(path, 8) for path in paths], seed=2)
    lanes = [lane(k + 1, path) for k, path in enumerate(paths)]
    angle, shift = 0.7, (-40.0, 25.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = [
        lane_of_map(
            k.lane_id, *(line @ turn.T + shift for line in (k.centerline_m, k.left_m, k.right_m))
        )
        for k in lanes
    ]
    here = count(frames, lanes)
    there = count(rotated(frames, angle, shift), turned)
    assert here.passages["lane_id"].tolist() == there.passages["lane_id"].tolist()
    assert here.passages["speed_mps"] == pytest.approx(there.passages["speed_mps"], abs=0.05)
    gap_s = (here.crossings["stamp_ns"] - there.crossings["stamp_ns"]) * 1e-9
    assert np.abs(gap_s).max() < 0.02


@pytest.mark.parametrize("rows", [3, 5, 8, 12])
def test_a_vehicle_is_on_the_line_for_as_long_whoever_is_counted_with_it(rows: int) -> None:
    """One that brakes hard on the line, and is lost soon after."""
    road = straight()
    lanes = [lane(1, road)]
    line_m = place_stations(lanes)[0].arc_m[0]
    braking = drive(
        lambda s: road(np.where(s < line_m, s, line_m + 0.1 * (s - line_m))),
        10.0,
        seen_m=(line_m - 40.0, line_m + rows),
        noise_m=0.0,
    )
    other = drive(road, start_s=60.0, track_id=2)
    alone, together = count(frames_of(braking), lanes), count(frames_of(braking, other), lanes)
    assert len(alone.crossings) == 1
    assert together.crossings[:1].tobytes() == alone.crossings.tobytes()


@pytest.mark.parametrize("seed", range(3))
def test_frame_by_frame_in_blocks_or_at_once_gives_the_same_bytes(seed: int) -> None:
    random = np.random.default_rng(seed)
    paths = [straight(offset_m=WIDTH_M * k) for k in range(2)]
    frames = traffic([Stream(path, 14) for path in paths], seed=seed)
    kept = random.random(len(frames.rows)) > 0.3
    rows = frames.rows[kept].copy()
    rows["track_id"] += 100 * (rows["x"] > random.uniform(30, 90))  # every track breaks
    frames = frames_from_rows(frames.row_stamp_ns()[kept], rows)
    lanes = [lane(k + 1, path) for k, path in enumerate(paths)]
    at_once = count(frames, lanes)
    assert len(at_once.crossings) == 28
    for step in (1, 7, 100):
        counter, parts = TrafficCounter(lanes), list[Counted]()
        for a in range(0, len(frames), step):
            b = min(a + step, len(frames))
            offset = frames.offset[a : b + 1]
            part = frames.rows[offset[0] : offset[-1]]
            counter.add(Frames(frames.stamp_ns[a:b], offset - offset[0], part))
            parts.append(counter.take())
        parts.append(counter.finish())
        passages = np.concatenate([part.passages for part in parts])
        crossings = np.concatenate([part.crossings for part in parts])
        assert passages.tobytes() == at_once.passages.tobytes(), step
        assert crossings.tobytes() == at_once.crossings.tobytes(), step


@pytest.mark.parametrize("gap_m", [0.0, 20.0, 60.0])
def test_a_vehicle_whose_track_breaks_is_one_vehicle(gap_m: float) -> None:
    first = drive(straight(), seen_m=(0.0, 50.0 - gap_m / 2), track_id=7)
    second = drive(straight(), seen_m=(50.0 + gap_m / 2, LENGTH_M), track_id=9, seed=1)
    counted = count(frames_of(first, second), TWO_LANES)
    assert counted.vehicles == 1
    assert counted.passages["track_id"].tolist() == [7]
    assert counted.crossings["lane_id"].tolist() == [3]


def test_a_follower_is_not_the_vehicle_before_it() -> None:
    leader = drive(straight(), seen_m=(0.0, 60.0), track_id=1)
    follower = drive(straight(), start_s=2.0, track_id=2, seed=1)
    counted = count(frames_of(leader, follower), TWO_LANES)
    assert counted.vehicles == 2


def test_two_vehicles_in_one_merged_box_for_two_seconds_are_two_vehicles() -> None:
    """The second one is lost behind the first, and found again under another id."""
    other = straight(offset_m=WIDTH_M)
    counted = count(
        frames_of(
            drive(straight(), track_id=1),
            drive(other, track_id=2, seen_m=(0.0, 40.0), seed=1),
            drive(other, track_id=3, seen_m=(90.0, LENGTH_M), seed=2),
        ),
        TWO_LANES,
    )
    assert counted.vehicles == 2
    assert sorted(counted.crossings["lane_id"].tolist()) == [3, 5]


@pytest.mark.parametrize("at_m", [30.0, 60.0, 90.0])
def test_a_vehicle_that_changes_lane_has_two_passages_and_is_counted_once(at_m: float) -> None:
    counted = count(frames_of(drive(changing(at_m))), TWO_LANES)
    passages, crossings = counted.passages, counted.crossings
    assert passages["lane_id"].tolist() == [3, 5]
    assert passages["to_lane"].tolist() == [5, 0]
    assert passages["from_lane"].tolist() == [0, 3]
    assert passages["last_arc_m"][0] == pytest.approx(at_m, abs=8.0)
    assert len(crossings) == 1
    if at_m != 60.0:  # the line is at 60 m
        assert crossings["lane_id"].tolist() == [5 if at_m < 60.0 else 3]


def test_noise_on_the_line_between_two_lanes_is_no_lane_change() -> None:
    counted = count(frames_of(drive(straight(offset_m=1.6), noise_m=0.4, seed=3)), TWO_LANES)
    assert counted.passages["lane_id"].tolist() == [3]


def test_speeds_are_right_within_their_errors() -> None:
    speeds = np.random.default_rng(0).uniform(8.0, 35.0, 200)
    vehicles = [
        drive(straight(), speed_mps=v, start_s=20.0 * k, track_id=k + 1, seed=k)
        for k, v in enumerate(speeds.tolist())
    ]
    counted = count(frames_of(*vehicles), TWO_LANES)
    for table in (counted.passages, counted.crossings):
        error = (table["speed_mps"] - speeds) / table["speed_sigma_mps"]
        assert np.abs(error).max() < 4.5
        assert np.median(np.abs(table["speed_mps"] - speeds)) < 0.15


def test_a_vehicle_is_timed_where_it_crosses_the_line() -> None:
    (station,) = place_stations(TWO_LANES)
    counted = count(frames_of(drive(straight(), speed_mps=20.0)), TWO_LANES)
    due_s = station.arc_m[0] / 20.0
    assert counted.crossings["stamp_ns"][0] * 1e-9 == pytest.approx(due_s, abs=0.01)


def test_who_crossed_before_the_recording_began_is_not_counted() -> None:
    late = drive(straight(), seen_m=(65.0, LENGTH_M))
    assert len(count(frames_of(late), TWO_LANES).crossings) == 0
    earlier = drive(straight(offset_m=WIDTH_M), track_id=2, start_s=-2.0)
    stamps, rows = earlier
    both = frames_of((late[0] + 5_000_000_000, late[1]), (stamps + 5_000_000_000, rows))
    assert sorted(count(both, TWO_LANES).crossings["lane_id"].tolist()) == [3, 5]


def test_oncoming_vehicles_in_a_lane_of_the_other_direction_are_in_no_lane() -> None:
    counted = count(frames_of(drive(backwards(straight()))), TWO_LANES)
    assert len(counted.passages) == 0
    assert counted.in_no_lane == 1


def test_lanes_side_by_side_share_a_line_and_a_ramp_that_ends_before_has_its_own() -> None:
    ramp = lane(9, straight(offset_m=-WIDTH_M), 0.0, 40.0)
    away = lane(8, backwards(straight(offset_m=9.0)))
    stations = place_stations([*TWO_LANES, ramp, away])
    assert [station.lanes for station in stations] == [(0, 1, 2), (3,)]
    assert stations[0].arc_m == pytest.approx((20.0, 20.0, 20.0), abs=1.5)
    far = lane(9, straight(offset_m=-WIDTH_M), 140.0, 180.0)
    assert [station.lanes for station in place_stations([*TWO_LANES, far])] == [(0, 1), (2,)]


@pytest.mark.parametrize("along_m", [20.0, 61.5, 97.0])
def test_a_station_is_where_it_is_wanted_and_counts_the_same_vehicles(along_m: float) -> None:
    back = backwards(straight(offset_m=-8.0))
    lanes = [*TWO_LANES, lane(7, back)]
    frames = traffic(
        [Stream(straight(offset_m=WIDTH_M * k), 9) for k in range(2)] + [Stream(back, 7)], seed=3
    )
    for place in (StationPlace(np.array([along_m, -1.0])), StationPlace(along_m=along_m)):
        counter = TrafficCounter(lanes, place=place)
        counter.add(frames)
        crossings = counter.finish().crossings
        assert np.bincount(crossings["lane_id"])[[3, 5, 7]].tolist() == [9, 9, 7]
        ahead, oncoming = counter.stations
        assert ahead.arc_m == pytest.approx((along_m, along_m), abs=0.01)
        there = LENGTH_M - along_m if place.point_m is not None else along_m
        assert oncoming.arc_m == pytest.approx((there,), abs=0.01)


def test_a_place_that_a_direction_does_not_pass_leaves_its_station_where_it_is_best() -> None:
    far = [lane(1, straight(offset_m=200.0)), *TWO_LANES]
    usual = {s.lanes: s.arc_m for s in place_stations(far)}
    chosen = {s.lanes: s.arc_m for s in place_stations(far, StationPlace(np.array([30.0, 0.0])))}
    assert chosen[(0,)] == usual[(0,)]
    assert chosen[(1, 2)] == pytest.approx((30.0, 30.0), abs=0.01)
    assert place_stations(far, StationPlace(along_m=500.0))[0].arc_m == place_stations(far)[0].arc_m


def rider(
    track_id: int, left_m: float, start_s: float, class_id: int = 3
) -> tuple[NDArray[np.int64], NDArray[np.void]]:
    """Somebody on two wheels at 10 m/s."""
    stamps, rows = drive(straight(offset_m=left_m), 10.0, start_s, track_id, seed=track_id)
    rows["class_id"], rows["length"] = class_id, 2.0
    return stamps, rows


@pytest.mark.parametrize("other_class", [1, 3])
def test_riders_side_by_side_are_two_and_two_ids_on_one_rider_are_one(other_class: int) -> None:
    beside = count(frames_of(rider(1, -0.8, 0.0), rider(2, 0.8, 0.1, other_class)), TWO_LANES)
    assert len(beside.crossings) == 2
    twice = count(frames_of(rider(1, 0.2, 0.0), rider(2, 0.0, 0.1, other_class)), TWO_LANES)
    assert len(twice.crossings) == 1
    behind = count(frames_of(rider(1, 0.2, 0.0), rider(2, 0.0, 0.6, other_class)), TWO_LANES)
    assert len(behind.crossings) == 2


@pytest.mark.parametrize(("before_m", "waits"), [(0.0, True), (1.5, True), (4.0, False)])
def test_who_stands_on_the_line_covers_it_all_the_time(before_m: float, waits: bool) -> None:
    (station,) = place_stations(TWO_LANES)
    counted = count(frames_of(timed(stops_at(station.arc_m[0] - before_m, 60.0), 1)), TWO_LANES)
    (row,) = counted.crossings
    over_s = (row["rear_ns"] - row["front_ns"]) * 1e-9
    assert over_s == pytest.approx(4.5 / 10.0 + 60.0 * waits, abs=1.0)
    assert row["front_ns"] <= row["stamp_ns"] <= row["rear_ns"]


def test_time_and_way_are_in_the_intervals_in_which_they_were_spent_and_driven() -> None:
    """A vehicle stands for a minute and a half; the minute in the middle knows no way."""
    frames = frames_of(timed(stops_at(40.0, 90.0), 1))
    recorded = record(TrafficCounter(TWO_LANES), [frames], 2.0)
    pieces = recorded.pieces
    (passage,) = recorded.passages
    assert pieces["way_m"].sum() == pytest.approx(passage["last_arc_m"] - passage["first_arc_m"])
    assert (pieces["first_ns"][1:] == pieces["last_ns"][:-1]).all()
    edges = np.array([0, 20, 80, 110]) * 10**9
    rows = measure(recorded.traffic(SCHEMES["coco"]), edges)
    rows = rows[(rows["lane_id"] == 3) & (rows["category"] == -1)]
    speed = rows["space_mean_speed_kmh"] / 3.6
    assert speed[1] == pytest.approx(0.0, abs=0.05)
    assert speed[0] == pytest.approx(40.0 / 20.0, rel=0.1)
    assert speed[2] == pytest.approx(79.0 / 22.0, rel=0.1)


@pytest.mark.parametrize("from_turn", [0.3, 0.6, 0.9])
def test_the_place_where_a_roundabout_begins_and_ends_is_no_end(from_turn: float) -> None:
    round_m = 2.0 * np.pi * 18.0
    ring = lane(4, arc(18.0), 0.0, round_m)
    path = arc(18.0)
    vehicle = drive(
        lambda s: path(s + from_turn * round_m), 8.0, seen_m=(0.0, 0.65 * round_m), noise_m=0.05
    )
    counted = count(frames_of(vehicle), [ring])
    assert (counted.passages["lane_id"] == 4).all()
    assert (counted.passages["from_lane"] == 0).all()
    assert counted.pieces["way_m"].sum() == pytest.approx(0.65 * round_m, abs=4.0)
    assert counted.passages["speed_mps"] == pytest.approx(8.0, abs=0.4)
    assert len(counted.crossings) == (from_turn > 0.85 or from_turn < 0.5)


def test_rows_of_another_kind_and_earlier_frames_are_refused() -> None:
    counter = TrafficCounter(TWO_LANES)
    counter.add(frames_of(drive(straight())))
    with pytest.raises(TableError, match="later stamp"):
        counter.add(frames_of(drive(straight())))
    boxes = Frames(np.array([1]), np.array([0, 0]), np.empty(0, PIXEL_TRACK_DTYPE))
    with pytest.raises(TableError, match="ground tracks"):
        TrafficCounter(TWO_LANES).add(boxes)
    with pytest.raises(TableError, match="at least one"):
        TrafficCounter([])


def timed(
    x_m: NDArray[np.float64], track_id: int, start_s: float = 0.0, class_id: int = 2, seed: int = 0
) -> tuple[NDArray[np.int64], NDArray[np.void]]:
    """A vehicle on the x axis by its places every tenth of a second."""
    _, rows = drive(straight(), track_id=track_id)
    rows = np.repeat(rows[:1], len(x_m))
    noise = np.random.default_rng(seed).normal(0.0, 0.3, (len(x_m), 2))
    rows["x"], rows["y"] = x_m + noise[:, 0], noise[:, 1]
    rows["class_id"], rows["sigma"] = class_id, 0.3
    tenths = np.round(10 * start_s + np.arange(len(x_m))).astype(np.int64)
    return tenths * 100_000_000, rows


def stops_at(at_m: float, wait_s: float, start_m: float = 0.0) -> NDArray[np.float64]:
    """Places of a vehicle at 10 m/s that stands at one place for a time."""
    going = np.arange(start_m, at_m, 1.0)
    standing = np.full(round(10 * wait_s), at_m)
    return np.concatenate((going, standing, np.arange(at_m, LENGTH_M, 1.0)))


@pytest.mark.parametrize("before_m", [2.0, 1.0, 0.3, 0.0, -0.5])
def test_who_waits_at_the_line_is_counted_when_it_drives_on(before_m: float) -> None:
    (station,) = place_stations(TWO_LANES)
    line_m = station.arc_m[0]
    vehicles = [
        timed(stops_at(line_m - before_m, 60.0), k + 1, 100.0 * k, seed=k) for k in range(10)
    ]
    counted = count(frames_of(*vehicles), TWO_LANES)
    assert len(counted.crossings) == 10
    assert len(counted.passages) == 10


def test_all_who_start_at_a_signal_are_counted() -> None:
    """Six metres apart, each a second after the one before it, with 1 m/s2."""
    vehicles = []
    for k in range(12):
        since_s = np.maximum(np.arange(0, 40, 0.1) - 1.0 * k, 0.0)
        driven_m = np.where(since_s < 10.0, 0.5 * since_s**2, 10.0 * since_s - 50.0)
        x_m = 58.0 - 6.0 * k + driven_m
        seen = (x_m > 0.0) & (x_m < LENGTH_M)
        vehicles.append(timed(x_m[seen], k + 1, float(seen.argmax()) / 10, seed=k))
    counted = count(frames_of(*vehicles), TWO_LANES)
    (station,) = place_stations(TWO_LANES)
    due = sum(1 for k in range(12) if 58.0 - 6.0 * k < station.arc_m[0])
    assert len(counted.crossings) == due
    assert len(counted.passages) == 12


@pytest.mark.parametrize("wait_s", [0.0, 5.0, 30.0, 120.0])
def test_the_speed_of_a_passage_is_its_way_over_its_time(wait_s: float) -> None:
    counted = count(frames_of(timed(stops_at(40.0, wait_s), 1)), TWO_LANES)
    (passage,) = counted.passages
    mean_mps = (LENGTH_M - 1.0) / ((LENGTH_M - 1.0) / 10.0 + wait_s)
    assert passage["speed_mps"] == pytest.approx(mean_mps, rel=0.05)
    assert abs(passage["speed_mps"] - mean_mps) < 4.0 * passage["speed_sigma_mps"]


def test_an_id_that_comes_back_at_the_beginning_of_the_lane_is_another_vehicle() -> None:
    """Some trackers give the lowest free id to the next vehicle."""
    way = np.arange(0.0, LENGTH_M, 2.5)
    vehicles = [timed(way, 1, (len(way) / 10 + 4.0) * k, seed=k) for k in range(20)]
    counted = count(frames_of(*vehicles), TWO_LANES)
    assert counted.vehicles == 20
    assert len(counted.crossings) == 20


def test_an_id_that_is_hidden_for_some_seconds_is_the_same_vehicle() -> None:
    stamps, rows = timed(np.arange(0.0, LENGTH_M, 1.0), 1)
    seen = (rows["x"] < 30.0) | (rows["x"] > 90.0)
    counted = count(frames_of((stamps[seen], rows[seen])), TWO_LANES)
    assert counted.vehicles == 1


@pytest.mark.parametrize("class_id", [0, 16])
def test_people_and_dogs_are_no_traffic(class_id: int) -> None:
    walkers = [timed(np.arange(0, 119, 0.15), k + 1, 20.0 * k, class_id) for k in range(3)]
    counted = count(frames_of(*walkers, timed(np.arange(0.0, 119.0), 9)), TWO_LANES)
    assert counted.vehicles == 1
    assert counted.crossings["track_id"].tolist() == [9]


def test_unsure_places_beside_the_only_lane_are_in_no_lane() -> None:
    stamps, rows = drive(straight(offset_m=WIDTH_M), noise_m=0.3)
    rows["sigma"] = 1.2
    assert count(frames_of((stamps, rows)), [lane(3, straight())]).in_no_lane == 1
    stamps, rows = drive(straight(offset_m=0.8), noise_m=0.3)
    rows["sigma"] = 1.2
    assert count(frames_of((stamps, rows)), [lane(3, straight())]).in_no_lane == 0
