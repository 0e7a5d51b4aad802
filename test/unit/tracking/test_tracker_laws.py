"""What holds for the tracker on any recording."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_traffic import (
    SECOND,
    SIZE,
    Table,
    Vehicle,
    detections,
    id_at,
    observed,
    seconds,
    stamps,
    track_all,
)

from geoorbit_ros.core.errors import ParameterError, TableError
from geoorbit_ros.core.tables import (
    DETECTION_DTYPE,
    FLAG_PREDICTED,
    FLAG_TRUNCATED,
    PIXEL_TRACK_DTYPE,
)
from geoorbit_ros.tracking.parameters import TrackerParameters, first_id_at
from geoorbit_ros.tracking.tracker import MAX_TRACKS, Tracker

# Two lanes each way: neighbours, oncoming traffic, a truck that hides what is behind it.
ROAD = [
    Vehicle(-6.0, 150.0, -20.0),
    Vehicle(-6.0, 185.0, -21.0),
    Vehicle(-2.5, 120.0, -25.0),
    Vehicle(2.5, 30.0, 22.0, class_id=7, width_m=2.5, height_m=3.5),
    Vehicle(2.5, 12.0, 22.5),
    Vehicle(6.0, 20.0, 27.0),
    Vehicle(6.0, 70.0, 24.0),
]
FAR_ROAD = [v for v in ROAD if v.ahead_m >= 30.0]
Frame = tuple[int, Table]
PLACE = (("x", "width"), ("y", "height"))


def recording(
    count: int = 100, fps: float = 25.0, noise: float = 0.0, missed: float = 0.0
) -> list[Frame]:
    """Detections of `ROAD`, with errors relative to the box and with misses."""
    random = np.random.default_rng(7)
    frames = []
    for stamp_ns in stamps(count, fps):
        rows = detections(ROAD, seconds(stamp_ns))
        for field, side in (("x", "width"), ("y", "height"), ("width",) * 2, ("height",) * 2):
            rows[field] += noise * rows[side] * random.standard_normal(len(rows))
        rows["score"] = random.uniform(0.5, 0.95, len(rows))
        frames.append((stamp_ns, rows[random.uniform(size=len(rows)) >= missed]))
    return frames


NOISY = recording(noise=0.03, missed=0.1)


def ids(output: list[Table]) -> list[list[int]]:
    return [rows["track_id"].tolist() for rows in output]


def test_every_vehicle_keeps_one_id_through_noise_and_misses() -> None:
    output = track_all(NOISY)
    owners: dict[int, set[int]] = {}
    for (stamp_ns, _), rows in zip(NOISY, output, strict=True):
        truth = detections(ROAD, seconds(stamp_ns))
        for row in observed(rows):
            distance = np.hypot(truth["x"] - row["x"], truth["y"] - row["y"]) / truth["height"]
            owners.setdefault(int(row["track_id"]), set()).add(int(np.argmin(distance)))
    assert sorted(len(vehicles) for vehicles in owners.values()) == [1] * len(ROAD)
    assert set.union(*owners.values()) == set(range(len(ROAD)))


def test_ids_are_unique_sorted_and_never_used_again() -> None:
    tracker = Tracker(TrackerParameters(first_id=40))
    gone: set[int] = set()
    before: set[int] = set()
    rng = np.random.default_rng(1)
    for lap in range(6):
        offset_ns = 30 * lap * SECOND
        shown = [ROAD[k] for k in rng.permutation(len(ROAD))[:4]]
        for stamp_ns in stamps(50):
            rows = tracker.update(stamp_ns + offset_ns, detections(shown, seconds(stamp_ns)))
            now = rows["track_id"].tolist()
            assert now == sorted(set(now))
            assert not gone & set(now)
            gone |= before - set(now)
            before = set(now)
        if lap == 3:
            tracker.reset()
    assert min(gone | before) == 40
    assert len(gone | before) == tracker.counts.births == 24
    assert tracker.counts.deaths + tracker.alive == 20  # what `reset` forgets is no death


@settings(max_examples=15, deadline=None)
@given(st.randoms(use_true_random=False))
def test_the_order_of_detections_in_a_frame_changes_nothing(random: np.random.Generator) -> None:
    mixed = []
    for stamp_ns, rows in NOISY:
        order = list(range(len(rows)))
        random.shuffle(order)
        mixed.append((stamp_ns, rows[order]))
    for a, b in zip(track_all(NOISY), track_all(mixed), strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("shift_ns", [-999_999_999, 1_700_000_000 * SECOND])
def test_the_origin_of_time_changes_nothing(shift_ns: int) -> None:
    later = [(stamp_ns + shift_ns, rows) for stamp_ns, rows in NOISY]
    for a, b in zip(track_all(NOISY), track_all(later), strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize(
    ("scale", "dx", "dy"), [(1.0, 640.0, -200.0), (0.5, 0.0, 0.0), (4.0, 8.0, 8.0)]
)
def test_scale_and_origin_of_the_image_change_nothing(scale: float, dx: float, dy: float) -> None:
    moved = []
    for stamp_ns, rows in NOISY:
        other = rows.copy()
        for field in ("x", "y", "width", "height"):
            other[field] *= scale
        other["x"] += dx
        other["y"] += dy
        moved.append((stamp_ns, other))
    for a, b in zip(track_all(NOISY), track_all(moved), strict=True):
        assert a["track_id"].tolist() == b["track_id"].tolist()
        assert b["x"] == pytest.approx(scale * a["x"] + dx, rel=1e-4, abs=0.05)
        assert b["height"] == pytest.approx(scale * a["height"], rel=1e-3)


def test_frames_without_detections_change_nothing() -> None:
    nothing = np.empty(0, DETECTION_DTYPE)
    kept = [f for k, f in enumerate(NOISY) if k % 3 == 0 or k < 10]
    full = [(s, rows if k % 3 == 0 or k < 10 else nothing) for k, (s, rows) in enumerate(NOISY)]
    tracked = dict(zip([s for s, _ in full], track_all(full), strict=True))
    for (stamp_ns, _), rows in zip(kept, track_all(kept), strict=True):
        assert observed(rows).tobytes() == observed(tracked[stamp_ns]).tobytes()


def test_uneven_times_keep_the_ids() -> None:
    random = np.random.default_rng(3)
    times_ns = SECOND + np.cumsum(random.integers(5, 250, 60)) * 1_000_000
    frames = [(int(t), detections(ROAD, seconds(int(t)))) for t in times_ns if seconds(int(t)) < 5]
    output = track_all(frames)
    assert sorted({i for frame in ids(output[2:]) for i in frame}) == list(range(1, 8))
    for (_, rows), tracks in zip(frames[5:], output[5:], strict=True):
        assert id_at(tracks, rows[3].tolist()) == id_at(output[4], frames[4][1][3].tolist())


@pytest.mark.parametrize("vehicle", [Vehicle(-3.0, 120.0, -20.0), Vehicle(3.0, 25.0, 25.0)])
@pytest.mark.parametrize(("gap_s", "same"), [(0.2, True), (0.9, True), (1.45, True), (1.7, False)])
def test_a_gap_is_bridged_up_to_the_limit(vehicle: Vehicle, gap_s: float, same: bool) -> None:
    frames = [
        (s, detections([vehicle] if not 1.0 < seconds(s) < 1.0 + gap_s else [], seconds(s)))
        for s in stamps(100)
    ]
    output = track_all(frames, max_gap_s=1.6)
    assert (output[20]["track_id"][0] == output[-1]["track_id"][0]) == same


def test_a_vehicle_hidden_by_a_truck_keeps_its_id_beside_others() -> None:
    hidden, rest = ROAD[4], [v for v in ROAD if v is not ROAD[4]]
    frames = [
        (s, detections(rest if 0.8 < seconds(s) < 1.9 else [*rest, hidden], seconds(s)))
        for s in stamps(75)
    ]
    output = track_all(frames)
    before = id_at(output[19], hidden.box(seconds(frames[19][0])))
    assert before == id_at(output[-1], hidden.box(seconds(frames[-1][0])))
    assert len({i for frame in ids(output) for i in frame}) == len(ROAD)


def test_oncoming_vehicles_that_pass_each_other_in_the_image_keep_their_ids() -> None:
    # The near one hides the far one while their boxes overlap.
    near, far = Vehicle(-2.0, 40.0, 10.0), Vehicle(-2.4, 110.0, -14.0, height_m=1.6)
    frames = []
    for s in stamps(75):
        boxes = detections([near, far], seconds(s))
        close = np.abs(np.diff(boxes["x"])) < 0.5 * boxes["width"].mean()
        close &= np.abs(np.diff(boxes["y"])) < 0.5 * boxes["height"].mean()
        behind = near.box(seconds(s))[3] < far.box(seconds(s))[3]
        frames.append((s, np.delete(boxes, int(not behind)) if close.any() else boxes))
    assert min(len(rows) for _, rows in frames) == 1
    output = track_all(frames)
    for vehicle in (near, far):
        first, last = (
            id_at(output[k], vehicle.box(seconds(frames[k][0]))) for k in (5, len(frames) - 1)
        )
        assert first == last


def test_unseen_vehicles_are_predicted_where_they_are_and_flagged() -> None:
    vehicle = Vehicle(3.0, 120.0, -18.0)
    frames = [
        (s, detections([vehicle] if seconds(s) < 2.4 else [], seconds(s))) for s in stamps(90)
    ]
    output = track_all(frames, predict_s=0.6)
    shown = [(s, rows[0]) for (s, _), rows in zip(frames, output, strict=True) if len(rows)]
    assert seconds(shown[-1][0]) == pytest.approx(2.36 + 0.6, abs=0.041)
    for stamp_ns, row in shown:
        predicted = bool(row["flags"] & FLAG_PREDICTED)
        assert predicted == (seconds(stamp_ns) >= 2.4)
        truth = vehicle.box(seconds(stamp_ns))
        assert abs(row["x"] - truth[0]) < 0.2 * truth[2]
        assert abs(row["y"] - truth[1]) < 0.2 * truth[3]
        assert row["height"] == pytest.approx(truth[3], rel=0.1)


def test_what_was_seen_for_a_moment_is_not_predicted_but_known_again() -> None:
    vehicle = Vehicle(3.0, 120.0, -18.0)
    frames = [
        (s, detections([vehicle] if k < 3 or k > 20 else [], seconds(s)))
        for k, s in enumerate(stamps(26))
    ]
    output = track_all(frames)
    assert [len(rows) for rows in output[4:21]] == [0] * 17
    assert output[-1]["track_id"][0] == output[2]["track_id"][0]


@pytest.mark.parametrize(("score", "first"), [(0.9, 0), (0.5, 1)])
def test_a_sure_detection_is_a_track_at_once_a_doubtful_one_when_seen_again(
    score: float, first: int
) -> None:
    vehicle = Vehicle(3.0, 60.0, -10.0, score=score)
    frames = [(s, detections([vehicle], seconds(s))) for s in stamps(4, fps=10.0)]
    shown = [len(rows) for rows in track_all(frames)]
    assert shown == [0] * first + [1] * (4 - first)
    assert [len(rows) for rows in track_all(frames, confirm_score=1.0)] == [0, 1, 1, 1]


@pytest.mark.parametrize("fps", [10.0, 25.0, 50.0])
def test_a_false_box_is_no_track_however_often_it_is_looked_at(fps: float) -> None:
    """It is there again in the next image; more images of one moment are no more evidence."""
    lasting = Vehicle(3.0, 60.0, -10.0)
    brief = Vehicle(-3.0, 40.0, 0.0, score=0.5)
    frames = []
    for s in stamps(int(2 * fps), fps):
        seen = [brief] if 1.0 <= seconds(s) < 1.0 + 0.07 else []
        frames.append((s, detections([lasting, *seen], seconds(s))))
    assert {int(i) for rows in track_all(frames) for i in rows["track_id"]} == {1}


def test_vehicles_that_a_detector_joins_for_a_moment_keep_their_ids() -> None:
    left, right = Vehicle(2.0, 30.0, 14.0), Vehicle(4.6, 30.5, 14.0)
    frames = []
    for s in stamps(60):
        rows = detections([left, right], seconds(s))
        if 1.0 < seconds(s) < 1.4:
            edges = [rows[n] + k * rows[m] / 2 for n, m in PLACE for k in (-1, 1)]
            low, high = [min(e) for e in edges[::2]], [max(e) for e in edges[1::2]]
            rows = rows[:1]
            rows["x"], rows["y"] = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2
            rows["width"], rows["height"] = high[0] - low[0], high[1] - low[1]
        frames.append((s, rows))
    output = track_all(frames)
    assert {i for frame in ids(output) for i in frame} == {1, 2}
    for vehicle in (left, right):
        one, two = (id_at(output[k], vehicle.box(seconds(frames[k][0]))) for k in (20, -1))
        assert one == two


@pytest.mark.parametrize(("fps", "spacing_m"), [(3.0, 15.0), (4.0, 11.0), (5.0, 9.0)])
def test_a_dense_platoon_is_told_apart_where_traffic_was_seen_before(
    fps: float, spacing_m: float
) -> None:
    """From frame to frame each vehicle comes close to where the one ahead was, or beyond."""
    first = [Vehicle(3.0, 20.0 - 61.0 * k, 28.0) for k in range(16)]
    platoon = [Vehicle(3.0, -1050.0 - spacing_m * k, 28.0) for k in range(6)]
    owner: dict[int, set[int]] = {k: set() for k in range(len(platoon))}
    tracker = Tracker()
    for s in stamps(round(45.0 * fps), fps):
        here = [v for v in first + platoon if 30.0 < v.ahead_m + v.speed_mps * seconds(s) < 150.0]
        rows = observed(tracker.update(s, detections(here, seconds(s))))
        for vehicle in set(here) & set(platoon):
            owner[platoon.index(vehicle)].add(id_at(rows, vehicle.box(seconds(s))))
    assert [len(ids_of) for ids_of in owner.values()] == [1] * len(platoon)
    assert len(set.union(*owner.values())) == len(platoon)


@pytest.mark.parametrize(("returning", "shown"), [(True, True), (False, False)])
def test_predictions_are_shown_while_vehicles_come_back_where_they_are_expected(
    returning: bool, shown: bool
) -> None:
    """One detector misses vehicles now and then, another loses each for good."""
    predicted = []
    tracker = Tracker(TrackerParameters())
    for s in stamps(1500):
        turn, now = divmod(seconds(s), 2.0)
        place_m = 3.0 if returning else 3.0 + 30.0 * (turn % 2)
        gap = 1.0 < now < 1.2 if returning else now > 1.0
        rows = tracker.update(s, detections([] if gap else [Vehicle(place_m, 40.0, 0.0)], now))
        if seconds(s) > 50.0:
            predicted.append(int(np.count_nonzero(rows["flags"] & FLAG_PREDICTED)))
    assert (sum(predicted) > 0) == shown


@pytest.mark.parametrize("fps", [5.0, 8.0, 25.0])
def test_a_low_rate_with_uneven_stamps_and_lost_frames_keeps_the_ids(fps: float) -> None:
    random = np.random.default_rng(11)
    frames = []
    for s in stamps(round(4.5 * fps), fps):
        late = s + round(SECOND * random.uniform(-0.3, 0.3) / fps)
        rows = detections(FAR_ROAD, seconds(late))
        for field, side in (("x", "width"), ("y", "height"), ("width",) * 2, ("height",) * 2):
            rows[field] += 0.03 * rows[side] * random.standard_normal(len(rows))
        if random.uniform() > 0.2:
            frames.append((late, rows))
    owners: dict[int, set[int]] = {}
    for (s, _), rows in zip(frames, track_all(frames), strict=True):
        truth = detections(FAR_ROAD, seconds(s))
        for row in observed(rows):
            distance = np.hypot(truth["x"] - row["x"], truth["y"] - row["y"]) / truth["height"]
            owners.setdefault(int(np.argmin(distance)), set()).add(int(row["track_id"]))
    assert [len(owners[k]) for k in range(len(FAR_ROAD))] == [1] * len(FAR_ROAD)


def test_a_box_that_enters_the_image_piece_by_piece_keeps_its_id() -> None:
    # Its width doubles from frame to frame, which is no growth of the vehicle.
    entering = Vehicle(-14.0, 20.0, 9.0)
    frames = []
    for s in stamps(40, 12.0):
        rows = detections([entering], seconds(s))
        left = np.clip(rows["x"] - rows["width"] / 2, 0.0, SIZE[0])
        right = np.clip(rows["x"] + rows["width"] / 2, 0.0, SIZE[0])
        rows["x"], rows["width"] = (left + right) / 2, right - left
        frames.append((s, rows[rows["width"] > 0.2 * rows["height"]]))
    output = track_all(frames, image_width=SIZE[0], image_height=SIZE[1])
    assert sum(len(rows) for _, rows in frames) > 25
    assert {i for frame in ids(output) for i in frame} == {1}


@pytest.mark.parametrize(("speed_mps", "same"), [(2.0, True), (25.0, False)])
def test_what_stands_where_a_slow_vehicle_was_last_seen_is_that_vehicle(
    speed_mps: float, same: bool
) -> None:
    # A fast one can't have stopped there: it is another one.
    moving = Vehicle(3.0, 30.0, speed_mps)
    box = detections([moving], 1.0)
    frames = [
        (s, detections([moving], seconds(s)) if seconds(s) <= 1.0 else box[: int(seconds(s) > 2.2)])
        for s in stamps(70)
    ]
    output = track_all(frames)
    assert (output[-1]["track_id"][0] == output[20]["track_id"][0]) == same


def test_what_leaves_the_image_ends_and_cut_boxes_are_flagged() -> None:
    leaving = Vehicle(-9.0, 40.0, -14.0)
    frames = []
    for s in stamps(70):
        rows = detections([leaving], seconds(s))
        left, right = rows["x"] - rows["width"] / 2, rows["x"] + rows["width"] / 2
        left, right = np.clip(left, 0.0, SIZE[0]), np.clip(right, 0.0, SIZE[0])
        rows["x"], rows["width"] = (left + right) / 2, right - left
        frames.append((s, rows[rows["width"] > 0.3 * rows["height"]]))
    output = track_all(frames, image_width=SIZE[0], image_height=SIZE[1], predict_s=1.0)
    last = max(k for k, (_, rows) in enumerate(frames) if len(rows))
    assert 5 < last < 56
    assert output[last]["flags"].tolist() == [FLAG_TRUNCATED]
    assert output[3]["flags"].tolist() == [0]
    assert not any(len(rows) for rows in output[last + 12 :])
    assert all(0.0 <= x <= SIZE[0] for rows in output for x in rows["x"])


def test_weak_detections_continue_a_track_and_begin_none() -> None:
    strong = Vehicle(3.0, 60.0, -10.0)
    weak = Vehicle(3.0, 60.0, -10.0, score=0.2)
    false_box = Vehicle(-8.0, 50.0, 0.0, score=0.2)
    frames = [
        (s, detections([strong if seconds(s) < 1.0 else weak, false_box], seconds(s)))
        for s in stamps(60)
    ]
    output = track_all(frames)
    assert {i for frame in ids(output) for i in frame} == {1}
    assert len(observed(output[-1])) == 1
    assert track_all(frames, low_score=0.3)[-1].size == 0


def test_a_false_box_that_a_vehicle_drove_over_is_not_followed_for_ever() -> None:
    vehicle, false_box = Vehicle(3.0, 60.0, -3.0), Vehicle(3.0, 54.0, 0.0, score=0.4)
    frames = []
    for s in stamps(300):
        here = [false_box] if seconds(s) > 2.0 else [vehicle]
        frames.append((s, detections(here, seconds(s))))
    output = track_all(frames)
    assert len(output[60]) == 1
    assert not any(len(rows) for rows in output[270:])


def test_the_class_is_that_of_most_detections_and_a_person_stays_apart() -> None:
    car, person = Vehicle(1.0, 40.0, -3.0), Vehicle(3.2, 40.0, -3.0, 0, width_m=0.6, height_m=1.8)
    random = np.random.default_rng(4)
    frames = []
    for s in stamps(80):
        rows = detections([car, person], seconds(s))
        if random.uniform() < 0.3:
            rows["class_id"][0] = 7
        frames.append((s, rows))
    output = track_all(frames)
    for (s, _), rows in zip(frames[30:], output[30:], strict=True):
        classes = dict(zip(rows["track_id"].tolist(), rows["class_id"].tolist(), strict=True))
        assert classes[id_at(rows, car.box(seconds(s)))] == 2
        assert classes[id_at(rows, person.box(seconds(s)))] == 0
    assert len({i for frame in ids(output) for i in frame}) == 2


numbers = st.floats(width=32, allow_nan=False, allow_infinity=False)
any_rows = st.lists(
    st.tuples(numbers, numbers, numbers, numbers, numbers, st.integers(-(2**31), 2**31 - 1)),
    max_size=6,
)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 10**13), any_rows), max_size=6), st.booleans())
@pytest.mark.filterwarnings("error")
def test_no_table_of_finite_numbers_is_too_odd(
    steps: list[tuple[int, list[tuple[float, ...]]]], sized: bool
) -> None:
    size = SIZE if sized else (0, 0)
    tracker = Tracker(TrackerParameters(image_width=size[0], image_height=size[1], confirm_hits=1))
    stamp_ns = 0
    for step_ns, values in steps:
        stamp_ns += step_ns
        rows = np.array([tuple(v) for v in values], DETECTION_DTYPE)
        output = tracker.update(stamp_ns, rows)
        assert output.dtype == PIXEL_TRACK_DTYPE
        for name in ("x", "y", "width", "height", "score"):
            assert np.isfinite(output[name]).all()
        seen = set(rows[["x", "y", "width", "height"]].tolist())
        assert set(observed(output)[["x", "y", "width", "height"]].tolist()) <= seen


def test_what_is_no_number_or_has_no_area_is_left_out_and_counted() -> None:
    rows = detections(ROAD[:4], 0.0)
    rows["x"][0], rows["width"][1], rows["score"][2] = np.nan, 0.0, np.inf
    tracker = Tracker(TrackerParameters(confirm_hits=1))
    assert len(tracker.update(SECOND, rows)) == 1
    assert (tracker.counts.detections, tracker.counts.unusable) == (4, 3)


def test_memory_is_bounded_in_clutter() -> None:
    random = np.random.default_rng(6)
    tracker = Tracker(TrackerParameters(confirm_hits=1, max_gap_s=60.0))
    for stamp_ns in stamps(12):
        rows = np.zeros(1500, DETECTION_DTYPE)
        rows["x"], rows["y"] = random.uniform(0.0, 1e5, (2, len(rows)))
        rows["width"] = rows["height"] = 20.0
        rows["score"] = random.uniform(0.5, 0.9, len(rows))
        tracker.update(stamp_ns, rows)
        assert tracker.alive <= MAX_TRACKS + 1000


def test_frames_of_another_type_or_time_are_refused() -> None:
    tracker = Tracker()
    with pytest.raises(TableError, match="track_id"):
        tracker.update(SECOND, np.zeros(1, PIXEL_TRACK_DTYPE))
    tracker.update(SECOND, detections(ROAD, 0.0))
    with pytest.raises(TableError, match="stamps that increase"):
        tracker.update(SECOND, detections(ROAD, 0.0))


def test_parameters_out_of_bounds_are_named() -> None:
    for wrong in ({"high_score": 1.5}, {"max_gap_s": float("nan")}, {"first_id": 0}):
        with pytest.raises(ParameterError, match=next(iter(wrong))):
            TrackerParameters(**wrong)
    with pytest.raises(ParameterError, match="both"):
        TrackerParameters(image_width=1920)


def test_a_tracker_started_later_repeats_no_id() -> None:
    births_in_an_hour = 3600 * 9
    assert first_id_at(3600 * SECOND) > first_id_at(0) + births_in_an_hour
    assert 1 <= first_id_at(1_800_000_000 * SECOND) < 2**31
