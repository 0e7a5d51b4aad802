"""Events live and stored are those of the offline way: each told once, whoever stopped when."""

from __future__ import annotations

import json
import os
import pickle
import zlib
from pathlib import Path

import numpy as np
import pytest
from made_traffic_days import (
    CLOCK,
    LANES,
    NS,
    SCHEME,
    STOPPED_LANE,
    SUMMER_ENDS_NS,
    blocks,
    day,
    offline,
    with_events,
)
from numpy.typing import NDArray

from geoorbit_ros.core.tables import Frames
from geoorbit_ros.storage.database.traffic import TrafficDatabase
from geoorbit_ros.storage.database.traffic_series import SeriesName
from geoorbit_ros.traffic.class_schemes import scheme_text
from geoorbit_ros.traffic.count import all_movements
from geoorbit_ros.traffic.event_records import EVENT_DTYPE, EventKind, EventState, newest_rows
from geoorbit_ros.traffic.events import EventWatch
from geoorbit_ros.traffic.follower import TrafficFollower
from geoorbit_ros.traffic.lane_maps import StampedLanes
from geoorbit_ros.traffic.live import LiveTraffic
from geoorbit_ros.traffic.messages import EVENT_POINT_DTYPE, events_json, point_table
from geoorbit_ros.traffic.packed import PACKED_MOVEMENT_DTYPE
from geoorbit_ros.traffic.watch_state import code_checksum, pack_watch, unpack_watch

ROAD = [*LANES, STOPPED_LANE]
SERIES = SeriesName("north", CLOCK.length_s, CLOCK.zone, scheme_text(SCHEME))


@pytest.fixture(scope="module")
def frames() -> Frames:
    return with_events(day(SUMMER_ENDS_NS, 11, vehicles=6))


@pytest.fixture(scope="module")
def expected(frames: Frames) -> NDArray[np.void]:
    """What the offline watch tells, row by row."""
    watch = EventWatch(ROAD)
    watch.add(frames)
    rows = watch.take()
    kinds = rows["kind"][rows["state"] == EventState.BEGAN].tolist()
    assert kinds.count(EventKind.STOPPED) == kinds.count(EventKind.WRONG_WAY) == 2
    return rows


def lanes_at(_: int) -> StampedLanes:
    return StampedLanes(0, ROAD)


@pytest.mark.parametrize("seed", range(3))
def test_live_events_are_the_offline_ones_however_frames_come(
    frames: Frames, expected: NDArray[np.void], seed: int
) -> None:
    live = LiveTraffic(SCHEME, CLOCK, lanes_at)
    rows = []
    for part in blocks(frames, seed):
        live.add(part)
        rows.append(live.events())
    assert np.concatenate(rows).tobytes() == expected.tobytes()


def count_from(path: Path, frames: Frames, end: int) -> list[NDArray[np.void]]:
    """Store frames up to `end`, count what is stored, go; what was told."""
    told = []
    with TrafficDatabase(path) as database:
        stored = {c.camera_id: c.end_ns for c in database.cameras()}.get("north", 0)
        database.append_lanes("north", int(frames.stamp_ns[0]), "road")
        begin = int(np.searchsorted(frames.stamp_ns, stored, side="right"))
        for k in range(begin, end):
            database.append("north", int(frames.stamp_ns[k]), frames.frame(k))
        database.flush()
        found = TrafficFollower(database, "north", SCHEME, CLOCK, lambda _: StampedLanes(0, ROAD))
        while (step := found.step(40)).batches:
            told.append(step.events)
    return told


@pytest.mark.parametrize("stops", [(), (0.3,), (0.05, 0.31, 0.33, 0.77)])
def test_stored_events_and_movements_are_the_offline_ones_however_often_the_counter_stopped(
    tmp_path: Path, frames: Frames, expected: NDArray[np.void], stops: tuple[float, ...]
) -> None:
    path, told = tmp_path / "t.db", list[NDArray[np.void]]()
    for end in [*(int(share * len(frames)) for share in stops), len(frames)]:
        told += count_from(path, frames, end)
    assert np.concatenate(told).tobytes() == expected.tobytes()
    with TrafficDatabase(path) as database:
        assert database.traffic_events(SERIES).tobytes() == expected.tobytes()
        assert database.traffic_event_rows(SERIES) == len(expected)
        (content,) = database.traffic_series()
        moved = database.traffic_movements(SERIES)
        middle_ns = int(expected["stamp_ns"][len(expected) // 2])
        later = database.traffic_events(SERIES, middle_ns)
        assert later.tobytes() == expected[expected["stamp_ns"] >= middle_ns].tobytes()
    recorded, _ = offline(frames, lanes=ROAD)
    wanted = all_movements(recorded, SCHEME, CLOCK)
    wanted = wanted[wanted["start_ns"] < content.end_ns]
    assert moved.tobytes() == wanted.astype(PACKED_MOVEMENT_DTYPE).tobytes()


def test_rows_are_stored_once_whoever_tells_them_again(
    tmp_path: Path, expected: NDArray[np.void]
) -> None:
    with TrafficDatabase(tmp_path / "t.db") as database:
        assert len(database.append_events(SERIES, 0, expected[:3])) == 3
        assert database.append_events(SERIES, 1, expected[1:6]).tobytes() == expected[3:6].tobytes()
        assert not len(database.append_events(SERIES, 0, expected[:6]))
        assert database.traffic_events(SERIES).tobytes() == expected[:6].tobytes()
        assert database.prune_traffic("north", 2**62) > 0
        assert not len(database.traffic_events(SERIES))


def test_a_lost_watch_ends_what_it_told_and_a_new_one_goes_on_with_its_numbers(
    tmp_path: Path, frames: Frames
) -> None:
    """As after an update of the program."""
    path = tmp_path / "t.db"
    stop = int(np.searchsorted(frames.stamp_ns, SUMMER_ENDS_NS + 205 * NS))  # one stands there
    count_from(path, frames, stop)
    with TrafficDatabase(path) as database:
        before = database.traffic_events(SERIES)
        database._connection.execute("UPDATE traffic_watch SET data = ?", (b"another version",))
    (lasting,) = [row for row in newest_rows(before) if row["state"] != EventState.ENDED]
    assert lasting["kind"] == EventKind.STOPPED
    count_from(path, frames, len(frames))
    with TrafficDatabase(path) as database:
        rows = database.traffic_events(SERIES)
    assert rows[: len(before)].tobytes() == before.tobytes()
    ended = rows[len(before)]
    assert (ended["event_id"], ended["state"]) == (lasting["event_id"], EventState.ENDED)
    new = rows[len(before) + 1 :]
    assert new["event_id"].min() == before["event_id"].max() + 1
    assert new["first_ns"].min() >= int(before["stamp_ns"].max())


def test_a_copied_watch_goes_on_like_the_first(frames: Frames, expected: NDArray[np.void]) -> None:
    watch, rows = EventWatch(ROAD), []
    for k in range(0, len(frames), 700):
        watch.add(frames.part(k, min(k + 700, len(frames))))
        rows.append(watch.take())
        copied = unpack_watch(pack_watch(watch))
        assert copied is not None
        watch = copied
    assert np.concatenate(rows).tobytes() == expected.tobytes()


class _Harm:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch harm",)


@pytest.mark.parametrize("content", [_Harm(), {"a": 1}, np.zeros(3), [os.getcwd]])
def test_a_foreign_state_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: object
) -> None:
    monkeypatch.chdir(tmp_path)
    packed = zlib.compress(pickle.dumps(content, 4))
    assert unpack_watch(code_checksum() + packed) is None
    assert unpack_watch(code_checksum() + packed[:-9]) is None
    assert unpack_watch(b"") is None
    assert list(tmp_path.iterdir()) == []


def test_what_lasts_is_told_as_text_and_as_points(frames: Frames) -> None:
    watch = EventWatch(ROAD)
    stop = int(np.searchsorted(frames.stamp_ns, SUMMER_ENDS_NS + 205 * NS))
    watch.add(frames.part(0, stop))
    text = json.loads(events_json(watch.lasting, CLOCK, "north"))
    assert text["camera_id"] == "north"
    (event,) = text["events"]
    assert (event["kind"], event["lane_id"]) == ("stopped_vehicle", 7)
    assert event["since"].startswith("2026-10-25T02:01:1")
    assert point_table(watch.take()).dtype == EVENT_POINT_DTYPE
    watch.add(frames.part(stop, int(np.searchsorted(frames.stamp_ns, SUMMER_ENDS_NS + 240 * NS))))
    assert json.loads(events_json(watch.lasting, CLOCK, "north"))["events"] == []
    assert np.empty(0, EVENT_DTYPE).dtype == watch.lasting.dtype
