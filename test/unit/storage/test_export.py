from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest
from made_frames import steady_frames
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames
from geoorbit_ros.storage.database.export import COLUMNS, PLACE_COLUMNS, SCHEMA, export_tracks
from geoorbit_ros.storage.database.writer import TrajectoryDatabase, TrajectoryReader

START_NS = 1_700_000_000_123_456_789
FRAMES = steady_frames(100, 4, TRACK_DTYPE, START_NS)
FRAMES.rows["heading"][::2] = np.nan
FRAMES.rows["flags"] = 2**32 - 1


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("db") / "tracks.db"
    with TrajectoryDatabase(path) as database:
        for camera_id in ("b", "a, the first"):
            for k, stamp_ns in enumerate(FRAMES.stamp_ns.tolist()):
                database.append(camera_id, stamp_ns, FRAMES.frame(k))
    return path


def read(path: Path) -> pa.Table:
    if path.suffix == ".parquet":
        return pq.read_table(path)
    types = pacsv.ConvertOptions(column_types=SCHEMA, strings_can_be_null=False)
    return pacsv.read_csv(path, convert_options=types)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_an_export_holds_every_row_to_the_bit(tmp_path: Path, database: Path, suffix: str) -> None:
    out = tmp_path / f"tracks{suffix}"
    with TrajectoryReader(database) as reader:
        assert export_tracks(reader, out) == 2 * len(FRAMES.rows)
    table = read(out)
    assert table.schema.equals(SCHEMA)
    assert table["camera_id"].unique().to_pylist() == ["a, the first", "b"]
    for camera_id in ("a, the first", "b"):
        part = table.filter(pa.compute.equal(table["camera_id"], camera_id))
        np.testing.assert_array_equal(part["stamp_ns"].to_numpy(), FRAMES.row_stamp_ns())
        np.testing.assert_array_equal(part["track_id"].to_numpy(), FRAMES.rows["track_id"])
        for name, field in COLUMNS.items():
            found = part[name].to_numpy()
            np.testing.assert_array_equal(found, FRAMES.rows[field])
            assert found.dtype == FRAMES.rows[field].dtype
        assert part["heading_rad"].null_count == len(FRAMES.rows) // 2


def test_every_field_of_a_track_is_exported() -> None:
    assert {*COLUMNS.values(), "track_id"} == set(TRACK_DTYPE.names or ())


def test_a_part_of_the_cameras_and_of_the_time(tmp_path: Path, database: Path) -> None:
    start_ns, end_ns = int(FRAMES.stamp_ns[10]), int(FRAMES.stamp_ns[13])
    out = tmp_path / "part.parquet"
    with TrajectoryReader(database) as reader:
        export_tracks(reader, out, ["b"], start_ns, end_ns)
    table = read(out)
    assert table["camera_id"].unique().to_pylist() == ["b"]
    assert table["stamp_ns"].unique().to_pylist() == FRAMES.stamp_ns[10:13].tolist()


def test_nothing_stored_gives_an_empty_table(tmp_path: Path) -> None:
    with TrajectoryDatabase(tmp_path / "tracks.db") as database:
        assert export_tracks(database, tmp_path / "none.csv") == 0
    assert (tmp_path / "none.csv").read_text().startswith("camera_id,stamp_ns,track_id,x_m,y_m,")


def test_a_refused_export_leaves_nothing(tmp_path: Path, database: Path) -> None:
    with TrajectoryReader(database) as reader:
        with pytest.raises(ParameterError, match=r"'tracks\.xlsx', expected a name in"):
            export_tracks(reader, tmp_path / "tracks.xlsx")
        with pytest.raises(ParameterError, match="'c'"):
            export_tracks(reader, tmp_path / "tracks.csv", ["b", "c"])
    damaged = tmp_path / "damaged.db"
    content = database.read_bytes()
    damaged.write_bytes(content[:8192] + bytes(len(content) - 8192))
    with (
        pytest.raises(InputFileError, match="damaged"),
        TrajectoryReader(damaged) as reader,
    ):
        export_tracks(reader, tmp_path / "tracks.csv")
    assert [path.name for path in tmp_path.iterdir() if "damaged.db" not in path.name] == []


PEAK = """
import resource, sys
from geoorbit_ros.storage.database.writer import TrajectoryReader
from geoorbit_ros.storage.database.export import export_tracks
with TrajectoryReader(sys.argv[1]) as reader:
    export_tracks(reader, sys.argv[2])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def test_memory_does_not_grow_with_the_database(tmp_path: Path) -> None:
    """Eight times the rows (84 MB more in memory), not even 40 MB more."""
    peak_kb = []
    frames = steady_frames(250, 1000, TRACK_DTYPE)
    path = tmp_path / "tracks.db"
    stored = 0
    for parts in (1, 8):
        with TrajectoryDatabase(path) as database:
            for k in range(stored, parts):
                shifted = Frames(frames.stamp_ns + k * 10**10, frames.offset, frames.rows)
                for j, stamp_ns in enumerate(shifted.stamp_ns.tolist()):
                    database.append("a", stamp_ns, shifted.frame(j))
        stored = parts
        command = [sys.executable, "-c", PEAK, str(path), str(tmp_path / "out.parquet")]
        done = subprocess.run(
            command,
            check=True,
            capture_output=True,
            text=True,
            timeout=60,
            cwd=Path(__file__).parents[3],
        )
        peak_kb.append(int(done.stdout))
    assert peak_kb[1] - peak_kb[0] < 40_000


def test_local_times_are_those_of_the_zone(tmp_path: Path, database: Path) -> None:
    start_ns = int(FRAMES.stamp_ns[0])
    texts = {}
    for zone in ("UTC", "Europe/Berlin", "America/Chicago"):
        out = tmp_path / f"{zone.replace('/', '_')}.csv"
        with TrajectoryReader(database) as reader:
            export_tracks(reader, out, ["b"], start_ns, start_ns + 1, timezone=zone)
        texts[zone] = read(out)["local_time"][0].as_py()
    assert texts == {
        "UTC": "2023-11-14T22:13:20.123+00:00",
        "Europe/Berlin": "2023-11-14T23:13:20.123+01:00",
        "America/Chicago": "2023-11-14T16:13:20.123-06:00",
    }


def test_what_a_lane_map_says_is_exported(tmp_path: Path, database: Path) -> None:
    def describe(camera_id: str, frames: Frames) -> dict[str, NDArray[np.float64]]:
        assert camera_id == "b"
        known = np.where(frames.rows["track_id"] % 2, 1.0, np.nan)
        return dict(zip(PLACE_COLUMNS, (48.0 * known, 11.0 * known, 3 * known, known), strict=True))

    out = tmp_path / "tracks.csv"
    with TrajectoryReader(database) as reader:
        export_tracks(reader, out, ["b"], describe=describe)
    table = read(out)
    odd = table.filter(pa.compute.equal(pa.compute.bit_wise_and(table["track_id"], 1), 1))
    assert 0 < len(odd) < len(table)
    for name, value in zip(PLACE_COLUMNS, (48.0, 11.0, 3, 1), strict=True):
        assert odd[name].unique().to_pylist() == [value]
        assert table[name].null_count == len(table) - len(odd)
