"""What is old is so by this computer's clock, camera by camera, and never by a stamp."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest

from geoorbit_ros.core.errors import InputFileError, MessageError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.core.wall_clock import DAY_NS, RetentionClock, refuse_ahead
from geoorbit_ros.storage.database.schema import MIGRATIONS, connect
from geoorbit_ros.storage.database.writer import TrajectoryDatabase, TrajectoryReader

NOW_NS = 1_800_000_000 * 10**9  # January 2027
SECOND_NS = 10**9
ROW = np.zeros(1, TRACK_DTYPE)


def frames_of(database: TrajectoryReader) -> dict[str, int]:
    return {content.camera_id: content.frames for content in database.cameras()}


class Clocks:
    """A wall clock that can be put wrong, and the time that really passes."""

    def __init__(self) -> None:
        self.wall_ns, self.steady_ns = NOW_NS, 0

    def pass_time(self, duration_ns: int) -> None:
        self.wall_ns += duration_ns
        self.steady_ns += duration_ns

    def retention(self, days: float, newest_ns: int | None = None) -> RetentionClock:
        return RetentionClock(days, newest_ns, lambda: self.wall_ns, lambda: self.steady_ns)


def test_a_stamp_deletes_nothing_and_the_clock_deletes_one_camera(tmp_path: Path) -> None:
    clocks = Clocks()
    with TrajectoryDatabase(tmp_path / "t.db", wall_ns=lambda: clocks.wall_ns) as database:
        for camera_id in ("north", "south"):
            for k in range(200):  # a recording of last year, played today
                database.append(camera_id, NOW_NS - 400 * DAY_NS + k * SECOND_NS // 10, ROW)
            database.append(camera_id, NOW_NS + 400 * DAY_NS, ROW)
            database.append_lanes(camera_id, NOW_NS + 400 * DAY_NS, "{}")
        database.flush()
        assert database.prune("north", NOW_NS) == 0
        clocks.pass_time(30 * DAY_NS)
        assert database.prune("north", clocks.wall_ns - 29 * DAY_NS) > 0
        assert frames_of(database) == {"north": 0, "south": 201}
        assert len(database.lane_maps("south")) == 1


def test_what_earlier_versions_stored_ages_by_its_stamps(tmp_path: Path) -> None:
    path = tmp_path / "t.db"
    with TrajectoryDatabase(path, wall_ns=lambda: 0) as database:  # no time of storing
        for stamp_ns in (NOW_NS - 40 * DAY_NS, NOW_NS):
            database.append("north", stamp_ns, ROW)
            database.flush()
    with TrajectoryDatabase(path, wall_ns=lambda: NOW_NS) as database:
        assert database.newest_stored_ns("north") is None
        assert database.prune("north", NOW_NS - 30 * DAY_NS) == 1
        assert frames_of(database) == {"north": 1}


@pytest.mark.parametrize("days", [-3650, -400])
def test_a_clock_that_goes_back_deletes_nothing(days: int) -> None:
    clocks = Clocks()
    retention = clocks.retention(30.0)
    clocks.wall_ns += days * DAY_NS
    cutoff_ns = retention.cutoff_ns()
    assert cutoff_ns is None or cutoff_ns < NOW_NS - 30 * DAY_NS
    assert retention.doubt is None


def test_a_clock_that_leaps_ten_years_deletes_nothing_until_it_has_stayed_there_a_day() -> None:
    clocks = Clocks()
    retention = clocks.retention(30.0)
    assert retention.cutoff_ns() == NOW_NS - 30 * DAY_NS
    clocks.wall_ns += 3650 * DAY_NS
    for _ in range(23):
        assert retention.cutoff_ns() is None
        assert "3650 days" in str(retention.doubt)
        clocks.pass_time(DAY_NS // 24)
    clocks.wall_ns -= 3650 * DAY_NS  # put right in time
    assert retention.cutoff_ns() == clocks.wall_ns - 30 * DAY_NS
    assert retention.doubt is None
    clocks.wall_ns += 3650 * DAY_NS
    assert retention.cutoff_ns() is None
    clocks.pass_time(DAY_NS)
    assert retention.cutoff_ns() == clocks.wall_ns - 30 * DAY_NS


def test_a_clock_that_is_ten_years_ahead_at_the_start_is_no_better() -> None:
    clocks = Clocks()
    retention = clocks.retention(30.0, newest_ns=NOW_NS - 3650 * DAY_NS)
    assert retention.cutoff_ns() is None
    clocks.pass_time(DAY_NS)
    assert retention.cutoff_ns() == clocks.wall_ns - 30 * DAY_NS
    assert clocks.retention(0.0).cutoff_ns() is None


def test_a_clock_that_is_not_set_judges_nothing() -> None:
    clocks = Clocks()
    clocks.wall_ns = 5 * SECOND_NS
    assert clocks.retention(30.0).cutoff_ns() is None
    refuse_ahead(NOW_NS, "tracks", now_ns=clocks.wall_ns)


def test_stamps_of_the_future_are_refused_and_those_of_the_past_are_not() -> None:
    for stamp_ns in (0, NOW_NS, NOW_NS + DAY_NS):
        refuse_ahead(stamp_ns, "tracks", NOW_NS)
    with pytest.raises(MessageError, match=r"tracks: found stamp .* 400 days after"):
        refuse_ahead(NOW_NS + 400 * DAY_NS, "tracks", NOW_NS)


def test_one_wrong_stamp_stops_no_recording_not_even_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "t.db"
    good = [NOW_NS + k * SECOND_NS // 30 for k in range(300)]
    with TrajectoryDatabase(path) as database:
        for k, stamp_ns in enumerate(good[:150]):
            if k == 40:
                database.append("north", NOW_NS + 3650 * DAY_NS, ROW)
            database.append("north", stamp_ns, ROW)
    with TrajectoryDatabase(path) as database:
        for stamp_ns in good[150:]:
            database.append("north", stamp_ns, ROW)
        for stamp_ns in good:  # and the same recording again is no second one
            with pytest.raises(MessageError, match="one later than"):
                database.append("north", stamp_ns, ROW)
        database.flush()
        assert database.read("north").stamp_ns.tolist() == [*good, NOW_NS + 3650 * DAY_NS]


def test_one_writer_for_each_camera_under_whatever_name_the_file_has(tmp_path: Path) -> None:
    path, link = tmp_path / "t.db", tmp_path / "other.db"
    with TrajectoryDatabase(path) as first:
        link.symlink_to(path)
        first.claim("a/b")
        with TrajectoryDatabase(link) as second:
            second.claim("a.b")  # another camera
            second.claim("a/b", "traffic")
            with pytest.raises(InputFileError, match=r"t\.db, camera a/b: found in use by process"):
                second.claim("a/b")
    with TrajectoryDatabase(link) as second:
        second.claim("a/b")


@pytest.mark.parametrize("version", range(1, len(MIGRATIONS)))
def test_a_file_of_every_version_is_read_and_brought_up_to_date(
    tmp_path: Path, version: int
) -> None:
    path = tmp_path / "t.db"
    old = connect(path, read_only=False, migrations=MIGRATIONS[:version])
    with TrajectoryDatabase(tmp_path / "new.db") as database:
        database.append("north", NOW_NS, ROW)
        database.flush()
        columns = "camera, start_ns, end_ns, frames, row_count, data"
        row = database._connection.execute(f"SELECT {columns} FROM track_batch").fetchone()
    old.execute("INSERT INTO camera (id, name) VALUES (1, 'north')")
    old.execute(f"INSERT INTO track_batch ({columns}) VALUES (?, ?, ?, ?, ?, ?)", row)
    old.execute("INSERT INTO lane_map (camera, stamp_ns, geojson) VALUES (1, 5, x'00')")
    old.close()
    with TrajectoryReader(path) as reader:
        assert frames_of(reader) == {"north": 1}
    with TrajectoryDatabase(path, wall_ns=lambda: NOW_NS) as database:
        database.append("north", NOW_NS + 1, ROW)
        database.flush()
        assert database.read("north").stamp_ns.tolist() == [NOW_NS, NOW_NS + 1]
        assert database.prune("north", NOW_NS) == 1  # the lane map of 1970
    raw = sqlite3.connect(path)
    fresh = sqlite3.connect(tmp_path / "new.db")
    names = "SELECT name FROM sqlite_master WHERE name NOT LIKE 'sqlite_%' ORDER BY name"
    assert raw.execute(names).fetchall() == fresh.execute(names).fetchall()
    raw.close()
    fresh.close()
