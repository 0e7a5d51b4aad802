"""Traffic beside stored tracks: each interval once, whoever stopped when; old and damaged files."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_traffic_days import CLOCK, LANES, MOVED, NS, SCHEME, SUMMER_ENDS_NS, day, offline, without
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.storage.database.schema import MIGRATIONS, connect, decode_rows, encode_rows
from geoorbit_ros.storage.database.traffic import (
    TrafficDatabase,
    TrafficMap,
    TrafficPart,
    TrafficReader,
)
from geoorbit_ros.storage.database.traffic_series import SeriesName
from geoorbit_ros.traffic.class_schemes import SCHEMES, scheme_text, stored_scheme
from geoorbit_ros.traffic.follower import TrafficFollower
from geoorbit_ros.traffic.interval_clock import IntervalClock
from geoorbit_ros.traffic.lane_maps import StampedLanes
from geoorbit_ros.traffic.measures import MEASURE_DTYPE
from geoorbit_ros.traffic.packed import (
    PACKED_MEASURE_DTYPE,
    PACKED_MOVEMENT_DTYPE,
    PACKED_PASSAGE_DTYPE,
    pack_measures,
    pack_passages,
)
from geoorbit_ros.traffic.records import last_seen

NAMED: dict[str, list[Lane]] = {"first": LANES, "moved": MOVED}
SERIES = SeriesName("north", CLOCK.length_s, CLOCK.zone, scheme_text(SCHEME))


def parse(text: str) -> StampedLanes:
    return StampedLanes(0, NAMED.get(text, []))


def follower(database: TrafficDatabase, clock: IntervalClock = CLOCK) -> TrafficFollower:
    return TrafficFollower(database, "north", SCHEME, clock, parse)


def record(database: TrafficDatabase, frames: Frames) -> None:
    for k, stamp_ns in enumerate(frames.stamp_ns.tolist()):
        database.append("north", stamp_ns, frames.frame(k))
    database.flush()


def count_all(found: TrafficFollower, batches: int = 50) -> None:
    while found.step(batches).batches:
        pass


def rows_until(frames: Frames, end_ns: int) -> tuple[NDArray[np.void], NDArray[np.void]]:
    recorded, rows = offline(frames)
    passages = recorded.passages[last_seen(recorded.passages) < end_ns]
    return pack_measures(rows[rows["start_ns"] < end_ns]), pack_passages(passages)


def assert_offline(path: Path, frames: Frames) -> None:
    with TrafficReader(path) as reader:
        (content,) = reader.traffic_series("north")
        rows, vehicles = reader.traffic_rows(SERIES), reader.traffic_vehicles("north")
    assert content.end_ns >= frames.stamp_ns[-1] - 90 * NS
    starts = np.unique(rows["start_ns"])
    assert (np.diff(starts) == 60 * NS).all()
    assert content.intervals == len(starts)
    expected, passages = rows_until(frames, content.end_ns)
    assert rows.tobytes() == expected.tobytes()
    assert vehicles.tobytes() == passages.tobytes()


@pytest.mark.parametrize("stops", [(), (0.5,), (0.2, 0.21, 0.6, 0.95)])
def test_stored_traffic_is_the_offline_one_however_often_the_counter_stopped(
    tmp_path: Path, stops: tuple[float, ...]
) -> None:
    """What was stored while it was away is counted, and no interval twice."""
    path, frames = tmp_path / "t.db", day(SUMMER_ENDS_NS - 10 * 60 * NS, 30, vehicles=4)
    frames = without(frames, SUMMER_ENDS_NS, SUMMER_ENDS_NS + 240 * NS)
    ends = [*(int(share * len(frames)) for share in stops), len(frames)]
    begin = 0
    for end in ends:
        with TrafficDatabase(path) as database:
            database.append_lanes("north", int(frames.stamp_ns[0]), "first")
            record(database, frames.part(begin, end))
            count_all(follower(database))
        begin = end
    assert_offline(path, frames)


def test_nothing_is_counted_before_there_are_lanes(tmp_path: Path) -> None:
    path, frames = tmp_path / "t.db", day(SUMMER_ENDS_NS, 4)
    with TrafficDatabase(path) as database:
        found = follower(database)
        assert found.step().batches == 0
        record(database, frames)
        database.append_lanes("north", int(frames.stamp_ns[0]), "no lanes yet")
        assert found.step().batches == 0
        database.append_lanes("north", int(frames.stamp_ns[900]), "first")
        count_all(found)
    assert_offline(path, frames)


def test_lane_maps_are_stored_where_they_begin_to_count(tmp_path: Path) -> None:
    frames = day(SUMMER_ENDS_NS, 6)
    results = []
    for stop in (len(frames), 2 * len(frames) // 3):
        with TrafficDatabase(tmp_path / f"{stop}.db") as database:
            database.append_lanes("north", SUMMER_ENDS_NS + 30 * NS, "first")
            record(database, frames.part(0, stop))
            count_all(follower(database))
            database.append_lanes("north", SUMMER_ENDS_NS + 260 * NS, "moved")
            record(database, frames.part(stop, len(frames)))
            count_all(follower(database))
            starts = [SUMMER_ENDS_NS, SUMMER_ENDS_NS + 300 * NS]
            maps = [database.traffic_map(SERIES, at_ns + 1) for at_ns in starts]
            results.append(database.traffic_rows(SERIES))
        if stop < len(frames):
            assert [m.geojson for m in maps if m] == ["first", "first"]  # the sixth isn't finished
        lanes = results[-1]["lane_id"][results[-1]["start_ns"] < SUMMER_ENDS_NS + 300 * NS]
        assert set(lanes.tolist()) == {0, 3, 5}


def test_another_length_is_another_series_and_vehicles_are_stored_once(tmp_path: Path) -> None:
    path, frames = tmp_path / "t.db", day(SUMMER_ENDS_NS, 12, vehicles=3)
    with TrafficDatabase(path) as database:
        database.append_lanes("north", SUMMER_ENDS_NS, "first")
        record(database, frames)
        count_all(follower(database))
        before = database.traffic_vehicles("north")
        count_all(follower(database, IntervalClock(300, CLOCK.zone)))
        lengths = [(s.name.length_s, s.intervals) for s in database.traffic_series()]
        assert lengths == [(60, 11), (300, 2)]
        assert database.traffic_vehicles("north").tobytes() == before.tobytes()
        count = database.traffic_vehicle_count("north")
        assert count == len(before)


def test_a_disk_that_was_full_leaves_no_hole(tmp_path: Path) -> None:
    path, frames = tmp_path / "t.db", day(SUMMER_ENDS_NS, 8, vehicles=3)
    with TrafficDatabase(path) as database:
        database.append_lanes("north", SUMMER_ENDS_NS, "first")
        record(database, frames)
        found = follower(database)
        found.step(200)
        database._connection.execute(
            "CREATE TRIGGER full BEFORE INSERT ON traffic_interval"
            " BEGIN SELECT RAISE(ABORT, 'disk is full'); END"
        )
        with pytest.raises(InputFileError, match="disk is full"):
            count_all(found, 200)
        database._connection.execute("DROP TRIGGER full")
        count_all(found)
    assert_offline(path, frames)


def part(start_s: int, intervals: int = 1) -> TrafficPart:
    rows = np.zeros(3 * intervals, PACKED_MEASURE_DTYPE)
    rows["start_ns"] = (start_s + 60 * np.repeat(np.arange(intervals), 3)) * NS
    vehicles = np.zeros(2, PACKED_PASSAGE_DTYPE)
    vehicles["vehicle_id"], vehicles["last_ms"] = start_s, 1000 * start_s + 5
    moved = np.zeros(intervals, PACKED_MOVEMENT_DTYPE)
    moved["start_ns"] = rows["start_ns"][::3]
    lane_map = TrafficMap(start_s * NS, 0, "first")
    end_ns = (start_s + 60 * intervals) * NS
    return TrafficPart(start_s * NS, end_ns, intervals, rows, vehicles, moved, lane_map)


def test_an_interval_is_never_stored_twice(tmp_path: Path) -> None:
    with TrafficDatabase(tmp_path / "t.db") as database, TrafficDatabase(tmp_path / "t.db") as two:
        database.append_traffic(SERIES, part(0, 3))
        for writer in (database, two):
            with pytest.raises(InputFileError, match="no interval is stored twice"):
                writer.append_traffic(SERIES, part(120))
        two.append_traffic(SERIES, part(180))
        assert len(database.traffic_rows(SERIES)) == 12
        assert len(database.traffic_vehicles("north")) == 4


def test_blocks_are_read_by_time(tmp_path: Path) -> None:
    with TrafficDatabase(tmp_path / "t.db", wall_ns=lambda: 0) as database:
        for k in range(250):
            database.append_traffic(SERIES, part(60 * k))
        blocks = database._connection.execute("SELECT count(*) FROM traffic_interval").fetchone()
        assert blocks == (3,)
        for begin, end in ((0, 250), (95, 97), (100, 101), (249, 260), (300, 400)):
            rows = database.traffic_rows(SERIES, 60 * begin * NS, 60 * end * NS)
            expected = np.repeat(np.arange(begin, min(end, 250)) * 60 * NS, 3)
            assert (
                rows["start_ns"].tolist() == expected.tolist() if len(expected) else not len(rows)
            )
            vehicles = database.traffic_vehicles("north", 60 * begin * NS, 60 * end * NS)
            assert len(vehicles) == 2 * max(min(end, 250) - begin, 0)
        assert database.prune("north", 10**18) == 0  # of tracks and maps alone
        assert database.prune_traffic("south", 96 * 60 * NS + 1) == 0
        # Stored by a computer whose clock is not set: stamps say how old it is.
        assert database.prune_traffic("north", 96 * 60 * NS + 1) > 0
        assert database.traffic_rows(SERIES)["start_ns"].min() == 96 * 60 * NS


def test_columns_of_older_versions_are_read(tmp_path: Path) -> None:
    rows = np.zeros(4, np.dtype([("start_ns", "<i8"), ("volume", "<i4")]))
    assert decode_rows(encode_rows(rows), 4).dtype == rows.dtype
    with TrafficDatabase(tmp_path / "t.db") as database:
        database.append_traffic(SERIES, replace(part(0), rows=rows))
        database.append_traffic(SERIES, part(60))
        assert database.traffic_rows(SERIES).dtype.names == ("start_ns", "volume")


@pytest.mark.parametrize("version", [1, 2])
def test_an_older_database_is_read_as_it_is_and_brought_up_to_date_to_count(
    tmp_path: Path, version: int
) -> None:
    path, frames = tmp_path / "t.db", day(SUMMER_ENDS_NS, 3)
    connect(path, read_only=False, migrations=MIGRATIONS[:version]).close()
    raw = sqlite3.connect(path)
    raw.execute("INSERT INTO camera (name) VALUES ('north')")
    raw.commit()
    raw.close()
    with TrafficReader(path) as reader:
        assert reader.traffic_series() == ()
        assert reader.traffic_end(SERIES) is None
        assert len(reader.traffic_rows(SERIES)) == len(reader.traffic_vehicles("north")) == 0
        assert reader.traffic_vehicle_count("north") == 0
        assert len(reader.traffic_events(SERIES)) == len(reader.traffic_movements(SERIES)) == 0
        assert reader.traffic_event_rows(SERIES) == 0
        assert reader.traffic_watch(SERIES) is None
    with TrafficDatabase(path) as database:
        database.append_lanes("north", SUMMER_ENDS_NS, "first")
        record(database, frames)
        count_all(follower(database))
    assert_offline(path, frames)


@pytest.mark.parametrize("damage", [b"", b"nonsense", encode_rows(np.zeros(2, MEASURE_DTYPE))])
def test_damage_is_one_sentence(tmp_path: Path, damage: bytes) -> None:
    path = tmp_path / "t.db"
    with TrafficDatabase(path) as database:
        database.append_traffic(SERIES, part(0))
        database._connection.execute("UPDATE traffic_interval SET data = ?", (damage,))
        with pytest.raises(InputFileError, match="a sound trajectory database") as caught:
            database.traffic_rows(SERIES)
        assert "\n" not in str(caught.value)


def test_schemes_are_stored_whole() -> None:
    for scheme in SCHEMES.values():
        assert stored_scheme(scheme_text(scheme)) == scheme
