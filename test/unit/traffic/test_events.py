"""Events on the road: planted ones are told while they last, ordinary traffic has none."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from made_lane_traffic import Stream, arc, straight, traffic
from numpy.typing import NDArray

from geoorbit_ros.core.errors import TableError
from geoorbit_ros.core.lanes import Lane, lane_of_map
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, TRACK_DTYPE, Frames, frames_from_rows
from geoorbit_ros.traffic.event_records import EventKind, EventState
from geoorbit_ros.traffic.events import EventWatch

WIDTH_M = 3.5
LENGTH_M = 120.0
Array = NDArray[np.float64]
Path = Callable[[Array], Array]
Vehicle = tuple[NDArray[np.int64], NDArray[np.void]]


def lane(lane_id: int, curve: Path, length_m: float = LENGTH_M) -> Lane:
    line = curve(np.arange(0.0, length_m + 1.0, 2.0))
    return lane_of_map(lane_id, line, offset_line(line, 1.75), offset_line(line, -1.75))


def placed(
    track_id: int, time_s: Array, place_m: Array, noise_m: float = 0.15, seed: int = 0
) -> Vehicle:
    """Stamps and rows of a vehicle at places (N, 2), five a second on the grid of frames."""
    random = np.random.default_rng([seed, track_id])
    rows = np.zeros(len(time_s), TRACK_DTYPE)
    rows["x"], rows["y"] = (place_m + random.normal(0.0, noise_m, (len(time_s), 2))).T
    rows["sigma"], rows["class_id"], rows["track_id"], rows["score"] = noise_m, 2, track_id, 0.9
    rows["length"] = 4.5
    return np.round(time_s * 5).astype(np.int64) * 200_000_000, rows


def driving(track_id: int, path: Path, start_s: float, speed_mps: float = 25.0) -> Vehicle:
    """A vehicle that drives by."""
    start_s = round(start_s * 5) / 5
    time_s = np.arange(0.0, LENGTH_M / speed_mps, 0.2)
    return placed(track_id, start_s + time_s, path(speed_mps * time_s))


def stopping(
    track_id: int, path: Path, start_s: float, at_m: float, stands_s: float, goes_on: bool = False
) -> Vehicle:
    """A vehicle that brakes with 3 m/s², stands, and drives on if told to."""
    speed = min(25.0, (6.0 * at_m) ** 0.5)
    brakes_s = speed / 3.0
    free_m = at_m - speed**2 / 6.0
    time_s = np.arange(0.0, free_m / speed + brakes_s + stands_s, 0.2)
    since = np.clip(time_s - free_m / speed, 0.0, brakes_s)
    s = np.minimum(speed * time_s, free_m) + speed * since - 1.5 * since**2
    if goes_on:
        more = np.arange(0.2, 40.0, 0.2)
        further = s[-1] + 1.0 * more**2
        keep = further < LENGTH_M
        time_s = np.append(time_s, time_s[-1] + more[keep])
        s = np.append(s, further[keep])
    return placed(track_id, round(start_s * 5) / 5 + time_s, path(s))


def frames_of(vehicles: Sequence[Vehicle], until_s: float) -> Frames:
    """Frames five times a second, those without a vehicle included."""
    stamps, rows = (np.concatenate(part) for part in zip(*vehicles, strict=True))
    found = frames_from_rows(stamps + 1_000_000_000, rows)
    grid = np.arange(1, round(until_s * 5) + 1) * 200_000_000 + 1_000_000_000
    stamp = np.union1d(grid, found.stamp_ns)
    count = np.zeros(len(stamp), np.int64)
    count[np.searchsorted(stamp, found.stamp_ns)] = np.diff(found.offset)
    return Frames(stamp, np.append(0, np.cumsum(count)), found.rows)


def flow(
    path: Path, first_id: int, begin_s: float, end_s: float, every_s: float, seed: int = 0
) -> list[Vehicle]:
    """Vehicles one after the other."""
    random = np.random.default_rng([seed, first_id])
    starts = np.arange(begin_s, end_s, every_s)
    starts = starts + random.uniform(0.0, 0.5 * every_s, len(starts))
    speeds = random.uniform(23.0, 27.0, len(starts))
    return [
        driving(first_id + k, path, start, speed)
        for k, (start, speed) in enumerate(zip(starts.tolist(), speeds.tolist(), strict=True))
    ]


def watch(frames: Frames, lanes: Sequence[Lane], step: int = 0) -> NDArray[np.void]:
    """All rows, from all frames at once or from `step` at a time."""
    watch = EventWatch(lanes)
    if not step:
        watch.add(frames)
        return watch.take()
    parts = []
    for a in range(0, len(frames), step):
        b = min(a + step, len(frames))
        offset = frames.offset[a : b + 1]
        part = frames.rows[offset[0] : offset[-1]]
        watch.add(Frames(frames.stamp_ns[a:b], offset - offset[0], part))
        parts.append(watch.take())
    return np.concatenate(parts)


def kinds(rows: NDArray[np.void], state: EventState = EventState.BEGAN) -> list[EventKind]:
    return [EventKind(k) for k in rows["kind"][rows["state"] == state].tolist()]


RIGHT, LEFT = straight(), straight(offset_m=WIDTH_M)
LANES = [lane(3, RIGHT), lane(5, LEFT)]


def backwards(path: Path) -> Path:
    return lambda s: path(LENGTH_M - s)


def stopped_car(path: Path = RIGHT, beside: Path = LEFT) -> list[Vehicle]:
    """Free traffic for a minute, then a car stops and the others keep to the lane beside."""
    return [
        *flow(path, 100, 0.0, 60.0, 4.0),
        *flow(beside, 200, 0.0, 170.0, 4.0),
        stopping(7, path, 62.0, 70.0, 90.0),
    ]


def wrong_way_car(path: Path = RIGHT, beside: Path = LEFT) -> list[Vehicle]:
    return [
        *flow(path, 100, 0.0, 60.0, 4.0),
        *flow(beside, 200, 0.0, 80.0, 4.0),
        driving(7, backwards(path), 66.0, 20.0),
    ]


def waiting(path: Path = RIGHT, beside: Path = LEFT) -> list[Vehicle]:
    """In both lanes vehicles stop one behind the other; only on the right they are three."""
    return [
        *flow(path, 100, 0.0, 40.0, 4.0),
        *flow(beside, 200, 0.0, 40.0, 4.0),
        *(
            stopping(10 + k, path, 50.0 + 4.0 * k, 90.0 - 8.0 * k, 60.0 - 3.0 * k, goes_on=True)
            for k in range(6)
        ),
        *(
            stopping(20 + k, beside, 50.0 + 4.0 * k, 90.0 - 8.0 * k, 60.0 - 3.0 * k, goes_on=True)
            for k in range(2)
        ),
    ]


def closed(path: Path = RIGHT, beside: Path = LEFT) -> list[Vehicle]:
    """After five minutes nobody drives in the lane."""
    return [*flow(path, 100, 0.0, 300.0, 4.0), *flow(beside, 1000, 0.0, 700.0, 4.0)]


def slower(path: Path = RIGHT, beside: Path = LEFT) -> list[Vehicle]:
    """After two minutes everybody drives at 8 m/s."""
    late = [driving(500 + k, path, 120.0 + 5.0 * k, 8.0) for k in range(12)]
    return [*flow(path, 100, 0.0, 118.0, 3.0), *flow(beside, 1000, 0.0, 180.0, 4.0), *late]


PLANTED: list[tuple[Callable[..., list[Vehicle]], EventKind, float]] = [
    (stopped_car, EventKind.STOPPED, 170.0),
    (wrong_way_car, EventKind.WRONG_WAY, 90.0),
    (waiting, EventKind.QUEUE, 160.0),
    (closed, EventKind.LANE_UNUSED, 700.0),
    (slower, EventKind.SPEED_DROP, 190.0),
]


@pytest.mark.parametrize(("plant", "kind", "until_s"), PLANTED)
def test_a_planted_event_and_no_other_is_told(
    plant: Callable[..., list[Vehicle]], kind: EventKind, until_s: float
) -> None:
    rows = watch(frames_of(plant(), until_s), LANES)
    assert kinds(rows) == [kind]
    assert rows["lane_id"][0] == 3
    assert (rows["first_ns"] <= rows["last_ns"]).all()
    assert (rows["last_ns"] <= rows["stamp_ns"]).all()


@pytest.mark.parametrize(("plant", "kind", "until_s"), PLANTED)
def test_a_bent_and_shifted_road_has_the_same_events(
    plant: Callable[..., list[Vehicle]], kind: EventKind, until_s: float
) -> None:
    def bent(offset_m: float) -> Path:
        curve = arc(200.0, 2.0, offset_m)
        return lambda s: np.add(curve(s), [300.0, -80.0])

    paths = [bent(0.0), bent(WIDTH_M)]
    there = watch(frames_of(plant(*paths), until_s), [lane(3, paths[0]), lane(5, paths[1])])
    here = watch(frames_of(plant(), until_s), LANES)
    assert kinds(there) == kinds(here) == [kind]
    assert there["lane_id"].tolist() == here["lane_id"].tolist()
    assert np.abs(there["stamp_ns"] - here["stamp_ns"]).max() <= 1_000_000_000
    assert there["arc_m"] == pytest.approx(here["arc_m"], abs=3.0)


@pytest.mark.parametrize(("plant", "kind", "until_s"), PLANTED)
def test_frame_by_frame_in_blocks_or_at_once_gives_the_same_bytes(
    plant: Callable[..., list[Vehicle]], kind: EventKind, until_s: float
) -> None:
    frames = frames_of(plant(), until_s)
    at_once = watch(frames, LANES)
    assert kind in kinds(at_once)
    for step in (1, 7, 1000):
        assert watch(frames, LANES, step).tobytes() == at_once.tobytes(), step


def test_a_stopped_vehicle_is_told_while_it_stands_and_ends_when_it_is_gone() -> None:
    rows = watch(frames_of(stopped_car(), 200.0), LANES)
    assert rows["state"].tolist() == [EventState.BEGAN, EventState.ENDED]
    begin, end = rows
    stood_s = (begin["stamp_ns"] - begin["first_ns"]) * 1e-9
    assert 14.0 < stood_s < 17.0
    assert begin["track_id"] == 7
    assert (begin["x"], begin["y"]) == pytest.approx((70.0, 0.0), abs=2.0)
    assert (end["last_ns"] - begin["first_ns"]) * 1e-9 == pytest.approx(90.0, abs=4.0)


def test_a_stopped_vehicle_with_a_new_id_every_few_seconds_is_one_event() -> None:
    stamps, rows = stopping(7, RIGHT, 62.0, 70.0, 90.0)
    rows["track_id"] = 7 + np.arange(len(rows)) // 40
    kept = np.arange(len(rows)) % 40 < 34
    vehicles = [*stopped_car()[:-1], (stamps[kept], rows[kept])]
    assert kinds(watch(frames_of(vehicles, 160.0), LANES)) == [EventKind.STOPPED]


@pytest.mark.parametrize("offset_m", [-3.2, 0.3])
def test_a_car_on_the_shoulder_and_a_sign_that_is_driven_through_are_none(offset_m: float) -> None:
    """The sign is there from the beginning; somebody's id jumps onto it."""
    time_s = np.arange(0.0, 170.0, 0.2)
    sign = placed(7, time_s, np.tile([70.0, offset_m], (len(time_s), 1)))
    shoulder = stopping(8, straight(offset_m=-3.4), 40.0, 80.0, 100.0)
    stamps, rows = driving(9, RIGHT, 30.0)
    jump = placed(9, np.arange(35.0, 150.0, 0.2), np.tile([100.0, 0.2], (575, 1)))
    jumper = np.append(stamps, jump[0]), np.append(rows, jump[1])
    vehicles = [*flow(RIGHT, 100, 0.0, 170.0, 4.0), *flow(LEFT, 400, 0.0, 170.0, 4.0)]
    assert not len(watch(frames_of([*vehicles, sign, shoulder, jumper], 175.0), LANES))


def test_who_waits_behind_a_stopped_vehicle_has_not_driven_through_it() -> None:
    """Ids of who comes to wait behind it jump to it."""
    vehicles = stopped_car()
    for k in range(4):
        stamps, rows = driving(30 + k, RIGHT, 69.1 + 1.5 * k)
        rows["x"] = np.where(rows["x"] > 55.0, 71.5, rows["x"])
        vehicles.append((stamps, rows))
    assert kinds(watch(frames_of(vehicles, 170.0), LANES)) == [EventKind.STOPPED]


def test_what_stands_from_the_beginning_where_its_lane_ends_is_no_vehicle() -> None:
    """A sign: all leave the lane before it, as they must."""
    time_s = np.arange(0.0, 170.0, 0.2)
    sign = placed(7, time_s, np.tile([110.0, 0.0], (len(time_s), 1)))

    def merging(s: Array) -> Array:
        return np.column_stack((s, WIDTH_M * np.clip((s - 80.0) / 20.0, 0.0, 1.0)))

    vehicles = [*flow(merging, 100, 0.0, 170.0, 8.0), *flow(LEFT, 400, 4.0, 170.0, 8.0)]
    ends = [lane(3, RIGHT, 114.0), LANES[1]]
    assert not len(watch(frames_of([*vehicles, sign], 175.0), ends))
    assert kinds(watch(frames_of([*vehicles, sign], 175.0), [lane(3, RIGHT, 160.0), LANES[1]])) == [
        EventKind.STOPPED
    ]


def test_who_waits_alone_at_a_red_light_of_a_city_street_has_not_stopped() -> None:
    slow = [driving(100 + k, RIGHT, 6.0 * k, 12.0) for k in range(12)]
    waits = stopping(7, RIGHT, 80.0, 70.0, 80.0, goes_on=True)
    assert not len(watch(frames_of([*slow, waits], 200.0), LANES[:1]))


def test_a_queue_tells_its_tail_and_how_many_wait() -> None:
    rows = watch(frames_of(waiting(), 160.0), LANES)
    told = rows[rows["state"] != EventState.ENDED]
    last = told[-1]
    assert last["vehicles"] >= 4
    behind = 90.0 - 8.0 * (last["vehicles"] - 1) - 2.25
    assert last["arc_m"] == pytest.approx(behind, abs=3.0)
    assert rows["state"][-1] == EventState.ENDED


def test_a_queue_is_told_though_every_vehicle_is_hidden_now_and_then() -> None:
    """Lorries beside hide each of them for five of ten seconds; then it has a new id."""
    vehicles = list[Vehicle]()
    for k, (stamps, rows) in enumerate(waiting()):
        standing = np.abs(rows["x"] - np.median(rows["x"])) < 1.0
        since = np.arange(len(rows)) - int(standing.argmax()) - 10
        hidden = standing & (since > 0) & ((since + 10 * k) % 50 < 25)
        rows["track_id"] = rows["track_id"] * 1000 + (np.maximum(since, 0) + 10 * k) // 50
        vehicles.append((stamps[~hidden], rows[~hidden]))
    assert kinds(watch(frames_of(vehicles, 160.0), LANES)) == [EventKind.QUEUE]


def test_who_drives_the_wrong_way_is_told_through_breaks_of_its_track_and_exchanged_ids() -> None:
    vehicles = wrong_way_car()
    stamps, rows = vehicles.pop()
    rows["track_id"] = 7000 + np.arange(len(rows)) // 8
    kept = np.arange(len(rows)) % 8 < 6
    broken = watch(frames_of([*vehicles, (stamps[kept], rows[kept])], 90.0), LANES)
    assert kinds(broken) == [EventKind.WRONG_WAY]
    rows["track_id"] = 7
    forward = driving(7, RIGHT, 61.0, 25.0)
    both = np.append(forward[0], stamps), np.append(forward[1], rows)
    assert kinds(watch(frames_of([*vehicles, both], 90.0), LANES)) == [EventKind.WRONG_WAY]


def test_vehicles_on_the_line_do_not_use_an_empty_lane() -> None:
    """One in thirty of the full lane beside a closed one is placed on the line between them."""
    line = straight(offset_m=0.45 * WIDTH_M)
    strays = [driving(5000 + k, line, 310.0 + 40.0 * k) for k in range(10)]
    found = kinds(watch(frames_of([*closed(), *strays], 700.0), LANES))
    assert found == [EventKind.LANE_UNUSED]


def test_only_who_drives_in_the_lane_for_metres_drives_the_wrong_way() -> None:
    """No oncoming lane, no reversing, no overtaking, no id that jumps back and forth."""
    oncoming = straight(offset_m=2.0 * WIDTH_M)
    lanes = [*LANES, lane(9, backwards(oncoming))]
    vehicles = [
        *flow(RIGHT, 100, 0.0, 120.0, 4.0),
        *flow(LEFT, 300, 0.0, 120.0, 4.0),
        *flow(backwards(oncoming), 500, 0.0, 120.0, 4.0),
    ]
    back_s = np.arange(0.0, 8.0, 0.2)
    reversing = np.column_stack((60.0 - 1.5 * back_s, np.zeros(len(back_s))))
    vehicles.append(placed(7, 50.0 + back_s, reversing))

    def overtaking(s: Array) -> Array:
        aside = WIDTH_M * np.clip(np.minimum(s - 20.0, 90.0 - s) / 15.0, 0.0, 1.0)
        return np.column_stack((LENGTH_M - s, 2.0 * WIDTH_M - aside))

    vehicles.append(driving(8, overtaking, 70.0, 25.0))
    time_s = np.arange(0.0, 6.0, 0.2)
    jumping = 100.0 - 12.0 * np.floor(time_s / 0.6) + 20.0 * (time_s % 0.6)
    vehicles.append(placed(9, 90.0 + time_s, np.column_stack((jumping, 0.0 * time_s))))
    assert not len(watch(frames_of(vehicles, 125.0), lanes))


def test_on_a_narrow_road_that_leads_both_ways_nobody_drives_the_wrong_way() -> None:
    """Those in the middle of it are nearer to the oncoming lane than to their own."""
    other = straight(offset_m=2.0)
    vehicles = [
        *flow(RIGHT, 100, 0.0, 120.0, 5.0),
        *flow(backwards(straight(offset_m=0.9)), 300, 40.0, 120.0, 10.0),
    ]
    assert not len(watch(frames_of(vehicles, 125.0), [LANES[0], lane(9, backwards(other))]))


@pytest.mark.parametrize("seed", range(3))
def test_ordinary_traffic_with_broken_tracks_has_no_events(seed: int) -> None:
    random = np.random.default_rng(seed)
    paths = [straight(offset_m=WIDTH_M * k) for k in range(3)]
    streams = [Stream(path, 150 - 40 * k, speed_mps=22.0 + 4 * k) for k, path in enumerate(paths)]
    frames = traffic(streams, seed, noise_m=0.4, duration_s=400.0, fps=5.0)
    kept = random.random(len(frames.rows)) > 0.2
    rows = frames.rows[kept].copy()
    rows["track_id"] += 1000 * (rows["x"] > random.uniform(30, 90))
    frames = frames_from_rows(frames.row_stamp_ns()[kept], rows)
    assert not len(watch(frames, [lane(k + 1, path) for k, path in enumerate(paths)]))


def test_an_outage_is_no_event() -> None:
    """Nobody comes for ten minutes because nobody looks."""
    vehicles = [
        *flow(RIGHT, 100, 0.0, 300.0, 4.0),
        *flow(LEFT, 400, 0.0, 300.0, 4.0),
        *flow(RIGHT, 700, 900.0, 1000.0, 4.0),
        *flow(LEFT, 800, 900.0, 1000.0, 4.0),
    ]
    stamps, rows = (np.concatenate(part) for part in zip(*vehicles, strict=True))
    assert not len(watch(frames_from_rows(stamps + 1, rows), LANES))


def test_an_event_goes_on_when_the_map_is_replaced() -> None:
    frames = frames_of(stopped_car(), 200.0)
    watch = EventWatch(LANES)
    half = 500
    watch.add(
        Frames(
            frames.stamp_ns[:half], frames.offset[: half + 1], frames.rows[: frames.offset[half]]
        )
    )
    watch.use_lanes([LANES[1], LANES[0], lane(8, straight(offset_m=20.0))])
    offset = frames.offset[half:]
    watch.add(Frames(frames.stamp_ns[half:], offset - offset[0], frames.rows[offset[0] :]))
    rows = watch.take()
    assert kinds(rows) == kinds(rows, EventState.ENDED) == [EventKind.STOPPED]
    assert rows["lane_id"].tolist() == [3, 3]


def test_rows_of_another_kind_and_earlier_frames_are_refused() -> None:
    frames = frames_of([driving(1, RIGHT, 0.0)], 5.0)
    watch = EventWatch(LANES)
    watch.add(frames)
    with pytest.raises(TableError, match="later stamp"):
        watch.add(frames)
    boxes = Frames(np.array([1]), np.array([0, 0]), np.empty(0, PIXEL_TRACK_DTYPE))
    with pytest.raises(TableError, match="ground tracks"):
        EventWatch(LANES).add(boxes)
    with pytest.raises(TableError, match="at least one"):
        EventWatch([])
