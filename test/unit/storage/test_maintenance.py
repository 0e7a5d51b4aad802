"""Deleting a part leaves the rest as it was; a backup is one moment, also while somebody writes."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_frames import assert_same, steady_frames

from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.storage.database.maintenance import backup, delete, restore
from geoorbit_ros.storage.database.writer import TrajectoryDatabase, TrajectoryReader

START_NS, SECOND_NS = 10**18, 10**9
FRAMES = steady_frames(150, 3, TRACK_DTYPE, start_ns=START_NS)


def recorded(path: Path) -> Path:
    with TrajectoryDatabase(path) as database:
        for camera_id in ("north", "south"):
            for k, stamp_ns in enumerate(FRAMES.stamp_ns.tolist()):
                database.append(camera_id, stamp_ns, FRAMES.frame(k))
            database.append_lanes(camera_id, START_NS + SECOND_NS, "{}")
    return path


@settings(deadline=None, max_examples=25)
@given(st.integers(-3, 155), st.integers(0, 160))
def test_a_part_goes_and_the_rest_stays_to_the_bit(
    tmp_path_factory: pytest.TempPathFactory, first: int, count: int
) -> None:
    path = recorded(tmp_path_factory.mktemp("part") / "t.db")
    begin_ns = START_NS + first * 33_000_000
    end_ns = begin_ns + count * 33_000_000
    gone = delete(path, "north", begin_ns, end_ns)
    inside = (FRAMES.stamp_ns >= begin_ns) & (FRAMES.stamp_ns < end_ns)
    assert gone.frames == inside.sum()
    with TrajectoryReader(path) as reader:
        kept = reader.read("north")
        assert kept.stamp_ns.tolist() == FRAMES.stamp_ns[~inside].tolist()
        rows = np.concatenate([FRAMES.frame(k) for k in range(150) if not inside[k]] or [kept.rows])
        assert kept.rows.tobytes() == rows.tobytes()
        assert_same(reader.read("south"), FRAMES)
        assert len(reader.lane_maps("north")) == (not begin_ns <= START_NS + SECOND_NS < end_ns)
        assert len(reader.lane_maps("south")) == 1


def test_nothing_of_what_was_deleted_is_left_in_the_file(tmp_path: Path) -> None:
    path, secret = tmp_path / "t.db", "a number plate " * 9
    with TrajectoryDatabase(path) as database:
        database.append("north", START_NS, FRAMES.frame(0))
        database._connection.execute("INSERT INTO camera (name) VALUES ('x')")
        database._connection.execute(
            "INSERT INTO lane_map (camera, stamp_ns, geojson) VALUES (1, ?, ?)",
            (START_NS, secret.encode()),
        )
    assert secret.encode() in path.read_bytes()
    delete(path, "north", START_NS, START_NS + 1)
    assert secret.encode() not in path.read_bytes()


def test_a_backup_while_somebody_writes_is_whole_and_can_be_put_back(tmp_path: Path) -> None:
    path, saved = recorded(tmp_path / "t.db"), tmp_path / "saved.db"
    stop, written = threading.Event(), [0]

    def write() -> None:
        with TrajectoryDatabase(path) as database:
            while not stop.is_set():
                stamp_ns = 2 * START_NS + written[0] * SECOND_NS
                database.append("north", stamp_ns, FRAMES.frame(0))
                database.flush()
                written[0] += 1

    writer = threading.Thread(target=write)
    writer.start()
    try:
        backup(path, saved)
    finally:
        stop.set()
        writer.join()
    with TrajectoryReader(saved) as reader, TrajectoryReader(path) as whole:
        stamps = reader.read("north").stamp_ns
        assert stamps.tolist() == whole.read("north").stamp_ns[: len(stamps)].tolist()
        assert_same(reader.read("south"), FRAMES)
    with pytest.raises(InputFileError, match="move the old database"):
        restore(saved, path)
    restore(saved, tmp_path / "again.db")
    with TrajectoryDatabase(tmp_path / "again.db") as database:
        database.append("south", 3 * START_NS, FRAMES.frame(0))
    damaged = tmp_path / "damaged.db"
    content = bytearray(saved.read_bytes())
    content[8192:] = bytes(value ^ 0xFF for value in content[8192:])
    damaged.write_bytes(content)
    with pytest.raises(InputFileError, match=r"damaged\.db"):
        restore(damaged, tmp_path / "other.db")
    assert not (tmp_path / "other.db").exists()


def test_mistakes_are_told(tmp_path: Path) -> None:
    path = recorded(tmp_path / "t.db")
    with pytest.raises(ParameterError, match="'east'"):
        delete(path, "east", 0, 1)
    for act in (
        lambda: delete(tmp_path / "no.db", "a", 0, 1),
        lambda: backup(tmp_path / "no.db", path),
    ):
        with pytest.raises(InputFileError, match="no such file"):
            act()
