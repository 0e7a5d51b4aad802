from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_frames import assert_same, ground_frames, steady_frames

from geoorbit_ros.core.errors import InputFileError, MessageError, ParameterError, TableError
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, TRACK_DTYPE, Frames
from geoorbit_ros.storage.database.schema import (
    MAX_BATCH_SPAN_NS,
    MIGRATIONS,
    connect,
    decode_batch,
    encode_batch,
)
from geoorbit_ros.storage.database.writer import TrajectoryDatabase, TrajectoryReader

FRAMES = steady_frames(200, 5, TRACK_DTYPE, start_ns=10**18)  # 6.6 s
SECOND_NS = 10**9
NOW_NS = 1_800_000_000 * SECOND_NS  # 2027, when a computer has set its clock


def append_all(database: TrajectoryDatabase, frames: Frames, camera_id: str = "a") -> None:
    for k, stamp_ns in enumerate(frames.stamp_ns.tolist()):
        database.append(camera_id, stamp_ns, frames.frame(k))


def between(frames: Frames, start_ns: int, end_ns: int) -> Frames:
    kept = (frames.stamp_ns >= start_ns) & (frames.stamp_ns < end_ns)
    count = np.diff(frames.offset)
    rows = frames.rows[np.repeat(kept, count)]
    return Frames(frames.stamp_ns[kept], np.append(0, np.cumsum(count[kept])), rows)


@settings(deadline=None)
@given(ground_frames())
def test_a_batch_unpacks_to_what_was_packed(frames: Frames) -> None:
    packed = encode_batch(frames.stamp_ns.tolist(), [frames.frame(k) for k in range(len(frames))])
    assert_same(decode_batch(packed, len(frames), len(frames.rows)), frames)


@settings(deadline=None, max_examples=30)
@given(ground_frames(), st.integers(0, 5))
def test_reading_gives_back_what_was_appended(
    tmp_path_factory: pytest.TempPathFactory, frames: Frames, reopened_after: int
) -> None:
    """Whatever the gaps between stamps, and when the writer was restarted."""
    path = tmp_path_factory.mktemp("db") / "tracks.db"
    for part in (slice(None, reopened_after), slice(reopened_after, None)):
        with TrajectoryDatabase(path) as database:
            for k in range(len(frames))[part]:
                database.append("a", int(frames.stamp_ns[k]), frames.frame(k))
    with TrajectoryReader(path) as reader:
        assert_same(reader.read("a"), frames)


@settings(deadline=None, max_examples=30)
@given(st.integers(-1, 70), st.integers(-1, 70))
def test_a_time_window_is_half_open(stored: Path, start: int, end: int) -> None:
    start_ns, end_ns = (10**18 + k * 99_000_000 for k in (start, end))
    with TrajectoryReader(stored) as reader:
        assert_same(reader.read("a", start_ns, end_ns), between(FRAMES, start_ns, end_ns))


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("db") / "tracks.db"
    with TrajectoryDatabase(path) as database:
        append_all(database, FRAMES)
        append_all(database, steady_frames(3, 0, TRACK_DTYPE), "empty road")
    return path


def test_content_is_summed_per_camera(stored: Path) -> None:
    with TrajectoryReader(stored) as reader:
        first, second = reader.cameras()
    assert (first.camera_id, first.frames, first.rows) == ("a", 200, 1000)
    assert (first.start_ns, first.end_ns) == (FRAMES.stamp_ns[0], FRAMES.stamp_ns[-1])
    assert (second.camera_id, second.frames, second.rows) == ("empty road", 3, 0)


def test_no_batch_is_longer_than_readers_believe(stored: Path) -> None:
    spans = sqlite3.connect(stored).execute("SELECT end_ns - start_ns FROM track_batch").fetchall()
    assert len(spans) > 6
    assert max(span for (span,) in spans) < MAX_BATCH_SPAN_NS


@pytest.mark.parametrize(
    ("step_ns", "clock"), [(33_000_000, 0), (1000, 1)], ids=["data-time", "wall-time"]
)
def test_a_killed_writer_loses_less_than_its_last_second(
    tmp_path: Path, step_ns: int, clock: int
) -> None:
    """A second of data at 30 Hz, replayed fast; of wall time where hardly any data time passes."""
    path = tmp_path / "tracks.db"
    script = Path(__file__).with_name("append_until_killed.py")
    command = [sys.executable, str(script), str(path), str(step_ns)]
    appended: list[tuple[int, int]] = []
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as writer:
        assert writer.stdout is not None
        try:
            for line in writer.stdout:
                stamp_ns, now_ns = map(int, line.split())
                appended.append((stamp_ns, now_ns))
                if len(appended) % 500 == 0:
                    with TrajectoryReader(path) as reader:  # a prefix, whenever one looks
                        seen = reader.read("pole_7")
                    expected = step_ns * np.arange(1, len(seen) + 1)
                    np.testing.assert_array_equal(seen.stamp_ns, expected)
                if now_ns - appended[0][1] > 1.3e9:
                    break
        finally:
            writer.kill()
        appended += [
            (int(s), int(n)) for s, n in (x.split() for x in writer.stdout if x[-1:] == b"\n")
        ]
    with TrajectoryDatabase(path) as database:
        found = database.read("pole_7")
    assert sqlite3.connect(path).execute("PRAGMA integrity_check").fetchone() == ("ok",)
    assert len(found) > 0
    assert found.rows["x"].tolist() == [s % 1_000_003 for s in found.stamp_ns for _ in range(3)]
    lost = [pair for pair in appended if pair[0] > found.stamp_ns[-1]]
    if lost:
        assert appended[-1][clock] - lost[0][clock] < SECOND_NS
    np.testing.assert_array_equal(found.stamp_ns, step_ns * np.arange(1, len(found) + 1))


def test_a_reader_sees_commits_and_never_blocks_the_writer(tmp_path: Path) -> None:
    path = tmp_path / "tracks.db"
    with TrajectoryDatabase(path) as writer, TrajectoryReader(path) as reader:
        append_all(writer, between(FRAMES, 0, 10**18 + SECOND_NS // 2))
        writer.flush()
        before = reader.read("a")
        snapshot = sqlite3.connect(path, isolation_level=None)
        snapshot.execute("BEGIN")
        frozen = snapshot.execute("SELECT count(*) FROM track_batch").fetchone()
        append_all(writer, between(FRAMES, 10**18 + SECOND_NS // 2, 2 * 10**18))
        writer.flush()
        assert_same(before, between(FRAMES, 0, 10**18 + SECOND_NS // 2))
        assert_same(reader.read("a"), FRAMES)
        assert snapshot.execute("SELECT count(*) FROM track_batch").fetchone() == frozen
        snapshot.close()


def test_several_writers_share_a_new_file(tmp_path: Path) -> None:
    path = tmp_path / "tracks.db"
    start = threading.Barrier(4)
    faults: list[BaseException] = []

    def record(camera_id: str) -> None:
        try:
            start.wait(timeout=60)
            with TrajectoryDatabase(path) as database:
                append_all(database, FRAMES, camera_id)
        except BaseException as error:
            faults.append(error)

    threads = [threading.Thread(target=record, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=120)
    assert faults == []
    with TrajectoryReader(path) as reader:
        for name in "abcd":
            assert_same(reader.read(name), FRAMES)


def test_lane_maps_come_back_and_the_same_stamp_replaces(tmp_path: Path) -> None:
    with TrajectoryDatabase(tmp_path / "tracks.db") as database:
        for stamp_ns, text in ((5, "first"), (9, "zweite Fahrspur ü"), (9, "again"), (7, "{}")):
            database.append_lanes("a", stamp_ns, text)
        assert database.lane_maps("a") == [(5, "first"), (7, "{}"), (9, "again")]
        assert database.lane_maps("a", 6, 9) == [(7, "{}")]
        assert database.cameras()[0].lane_maps == 3


def test_frames_that_cannot_be_stored_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "tracks.db"
    with TrajectoryDatabase(path) as database:
        append_all(database, FRAMES)
        with pytest.raises(MessageError, match="one later than"):
            database.append("a", int(FRAMES.stamp_ns[-1]), FRAMES.frame(0))
        with pytest.raises(TableError, match="fields of tracks"):
            database.append("a", 2 * 10**18, np.zeros(1, PIXEL_TRACK_DTYPE))
    with TrajectoryDatabase(path) as database:  # the same bag again
        with pytest.raises(MessageError, match="one later than"):
            database.append("a", int(FRAMES.stamp_ns[0]), FRAMES.frame(0))
        with pytest.raises(ParameterError, match=r"found 'b', expected a camera in .*\('a'\)"):
            database.read("b")
        assert_same(database.read("a"), FRAMES)


def test_the_caller_may_reuse_its_array(tmp_path: Path) -> None:
    rows = np.zeros(1, TRACK_DTYPE)
    with TrajectoryDatabase(tmp_path / "tracks.db") as database:
        for k in range(3):
            rows["x"] = k
            database.append("a", k, rows)
        database.flush()
        assert database.read("a").rows["x"].tolist() == [0, 1, 2]


def test_old_data_goes_in_small_steps_and_the_file_stays_bounded(tmp_path: Path) -> None:
    path, sizes, now_ns = tmp_path / "tracks.db", [], [NOW_NS]
    span_ns = int(FRAMES.stamp_ns[-1] - FRAMES.stamp_ns[0]) + SECOND_NS
    with TrajectoryDatabase(path, wall_ns=lambda: now_ns[0]) as database:
        for k in range(30):
            now_ns[0] = NOW_NS + k * span_ns
            shifted = Frames(FRAMES.stamp_ns + k * span_ns, FRAMES.offset, FRAMES.rows)
            append_all(database, shifted)
            database.append_lanes("a", int(shifted.stamp_ns[-1]), "{}" * 1000)
            database.flush()
            while deleted := database.prune("a", NOW_NS + (k - 2) * span_ns, limit=5):
                assert deleted <= 2 * 5
            limit_ns = int(FRAMES.stamp_ns[0]) + (k - 2) * span_ns
            kept = database.read("a")
            assert kept.stamp_ns[0] >= limit_ns
            assert kept.stamp_ns[-1] == shifted.stamp_ns[-1]
            assert len(kept) == min(k + 1, 3) * len(FRAMES)
            assert all(stamp_ns >= limit_ns for stamp_ns, _ in database.lane_maps("a"))
            sizes.append(database._connection.execute("PRAGMA page_count").fetchone()[0])
        assert max(sizes[4:]) <= 1.3 * sizes[3]
        while database.prune("a", 4 * 10**18, limit=5):
            pass
        assert database._connection.execute("PRAGMA page_count").fetchone()[0] < sizes[0]
        assert database.cameras()[0].frames == 0


def test_a_full_disk_is_reported_with_what_was_lost(tmp_path: Path) -> None:
    with TrajectoryDatabase(tmp_path / "tracks.db") as database:
        database.append("a", 0, FRAMES.frame(0))
        database.flush()
        pages = database._connection.execute("PRAGMA page_count").fetchone()[0]
        database._connection.execute(f"PRAGMA max_page_count = {pages}")
        noise = np.frombuffer(np.random.default_rng(1).bytes(4800 * 20), TRACK_DTYPE)
        database.append("a", 1, noise)
        with pytest.raises(InputFileError, match="full; 1 frames lost"):
            database.flush()
        database._connection.execute(f"PRAGMA max_page_count = {pages + 1000}")
        database.append("a", 2, noise)
        database.flush()
        assert database.read("a").stamp_ns.tolist() == [0, 2]


def test_an_older_schema_is_brought_up_to_date_with_its_data(tmp_path: Path) -> None:
    path = tmp_path / "tracks.db"
    with TrajectoryDatabase(path) as database:
        append_all(database, FRAMES)
    newer = (*MIGRATIONS, "ALTER TABLE camera ADD COLUMN note TEXT; CREATE TABLE t (x)")
    connect(path, read_only=True, migrations=newer).close()  # tables were only added
    connect(path, read_only=False, migrations=newer).close()
    raw = sqlite3.connect(path)
    assert raw.execute("PRAGMA user_version").fetchone() == (len(newer),)
    assert raw.execute("SELECT name, note FROM camera").fetchall() == [("a", None)]
    raw.close()
    for opened in (TrajectoryDatabase, TrajectoryReader):
        found = f"schema version {len(newer)}, written by a newer geoorbit"
        with pytest.raises(InputFileError, match=found):
            opened(path)


def test_a_migration_happens_whole_or_not(tmp_path: Path) -> None:
    path = tmp_path / "tracks.db"
    with TrajectoryDatabase(path) as database:
        append_all(database, FRAMES)
    broken = (*MIGRATIONS, "CREATE TABLE t (x); CREATE TABLE camera (x)")
    with pytest.raises(InputFileError, match="already exists"):
        connect(path, read_only=False, migrations=broken)
    with TrajectoryReader(path) as reader:
        assert_same(reader.read("a"), FRAMES)


def test_a_database_in_a_folder_that_cannot_be_written_to_is_read(
    stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Readers share memory in a file beside it, which can't be made there."""
    with TrajectoryReader(stored) as reader:
        expected = reader.cameras()
    alone = tmp_path / "alone.db"
    alone.write_bytes(stored.read_bytes())
    beside = [alone.with_name(alone.name + end) for end in ("-wal", "-shm")]
    monkeypatch.setattr(os, "access", lambda *_: False)
    with TrajectoryReader(alone) as reader:
        assert reader.cameras() == expected
        assert not any(file.exists() for file in beside), "nothing was made"


def test_what_is_no_trajectory_database(tmp_path: Path) -> None:
    (tmp_path / "text.db").write_text("id,time,frame_num\n" * 100)
    other = sqlite3.connect(tmp_path / "other.db")
    other.execute("CREATE TABLE messages (id)")
    other.close()
    (tmp_path / "empty.db").touch()
    for name, found in (("text.db", "not a database"), ("other.db", "another program")):
        content = (tmp_path / name).read_bytes()
        for opened in (TrajectoryDatabase, TrajectoryReader):
            with pytest.raises(InputFileError, match=found):
                opened(tmp_path / name)
        assert (tmp_path / name).read_bytes() == content
    for name, found in (("absent.db", "no such file"), ("empty.db", "empty file")):
        with pytest.raises(InputFileError, match=found):
            TrajectoryReader(tmp_path / name)
    with pytest.raises(InputFileError, match="unable to open"):
        TrajectoryDatabase(tmp_path / "absent" / "tracks.db")


@pytest.mark.parametrize("kind", ["cut off", "overwritten"])
def test_a_damaged_file_is_refused_when_it_is_read(tmp_path: Path, stored: Path, kind: str) -> None:
    content = bytearray(stored.read_bytes())
    path = tmp_path / "tracks.db"
    if kind == "cut off":
        content = content[: len(content) // 2]
    else:
        content[8192:] = bytes(value ^ 0xFF for value in content[8192:])
    path.write_bytes(content)
    sentence = "expected a sound trajectory database"
    with pytest.raises(InputFileError, match=sentence), TrajectoryReader(path) as reader:
        reader.read("a")
