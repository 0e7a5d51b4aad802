"""`geoorbit db`: what is stored, and out of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from made_traffic_days import (
    CLOCK,
    LANES,
    MOVED,
    SCHEME,
    STOPPED_LANE,
    SUMMER_ENDS_NS,
    day,
    with_events,
)

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.cli.console import format_size, format_time, parse_time
from geoorbit_ros.cli.main import main
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.lanes.geojson import dumps_lanes, parse_lane_file
from geoorbit_ros.storage.database.traffic import TrafficDatabase
from geoorbit_ros.storage.database.writer import TrajectoryDatabase
from geoorbit_ros.traffic.follower import TrafficFollower
from geoorbit_ros.traffic.lane_maps import StampedLanes

NOON_NS = 1_777_636_800 * 10**9  # 2026-05-01 12:00 UTC


@pytest.fixture
def database(tmp_path: Path) -> Path:
    path = tmp_path / "tracks.db"
    with TrajectoryDatabase(path) as database:
        for camera_id in ("north", "south"):
            for k in range(10):
                database.append(camera_id, NOON_NS + k * 10**9, np.zeros(2, TRACK_DTYPE))
        database.append_lanes("north", NOON_NS, "{}")
    return path


def test_info(database: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["db", "info", str(database)]) == 0
    shown = capsys.readouterr().out
    assert "2 cameras" in shown
    (north,) = (line.split() for line in shown.splitlines() if "north" in line)
    assert north == ["north", "2026-05-01", "12:00:00", "2026-05-01", "12:00:09", "10", "20", "1"]


def test_export_of_a_part(
    database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "part.parquet"
    options = ["--camera-id", "south", "--from", "2026-05-01T14:00:02+02:00", "--to"]
    assert main(["db", "export", str(database), "--out", str(out), *options, "1777636805"]) == 0
    table = pq.read_table(out)
    assert set(table["camera_id"].to_pylist()) == {"south"}
    assert table["stamp_ns"].unique().to_pylist() == [NOON_NS + k * 10**9 for k in (2, 3, 4)]
    assert "6 rows" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--out", "x.csv", "--camera-id", "east"], "found 'east', expected a camera in"),
        (["--out", "x.csv", "--from", "noon"], "option --from: found 'noon'"),
        (["--out", "x.json"], "found 'x.json', expected a name in .csv or .parquet"),
    ],
)
def test_wrong_options_get_one_sentence(
    database: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    sentence: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["db", "export", str(database), *options]) == 2
    shown = capsys.readouterr()
    assert sentence in shown.err
    assert shown.err.count("\n") == 1
    assert not list(tmp_path.glob("x.*"))


@pytest.mark.parametrize("command", [["info"], ["export", "--out", "out.csv"]])
def test_no_database_is_not_made(
    tmp_path: Path, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["db", *command, str(tmp_path / "absent.db")]) == 2
    assert "absent.db: found no such file" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_times_and_sizes() -> None:
    assert parse_time("12.5", "t") == 12_500_000_000
    assert parse_time("2026-05-01T12:00:00Z", "t") == NOON_NS
    assert parse_time("2026-05-01T12", "t") == NOON_NS
    assert parse_time("2026-05-01", "t") == NOON_NS - 43_200 * 10**9
    for text in ("", "nan", "inf", "tomorrow"):
        with pytest.raises(ParameterError):
            parse_time(text, "t")
    assert format_time(NOON_NS) == "2026-05-01 12:00:00 UTC"
    assert format_time(1_500_000_000) == "1.500 s"
    assert [format_size(n) for n in (999, 1000, 1_550_000, 2 * 10**9)] == [
        "999 bytes",
        "1.0 kB",
        "1.6 MB",
        "2.0 GB",
    ]


def test_traffic_beside_the_tracks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is exported is what the offline command computes from the same tracks and lane maps.

    The map changes in the fourth minute: lanes move, and one is there no more.
    """
    monkeypatch.setenv("COLUMNS", "160")
    path, frames = tmp_path / "t.db", with_events(day(SUMMER_ENDS_NS, 6, vehicles=6))
    road = LaneMap(SUMMER_ENDS_NS, (*LANES, STOPPED_LANE))
    text = dumps_lanes(road, Datum(50.0, 8.0), camera_id="north")
    with TrafficDatabase(path) as database:
        database.append_lanes("north", SUMMER_ENDS_NS, text)
        for k, stamp_ns in enumerate(frames.stamp_ns.tolist()):
            database.append("north", stamp_ns, frames.frame(k))
        database.flush()
        later = dumps_lanes(LaneMap(0, tuple(MOVED[:2])), Datum(50.0, 8.0), camera_id="north")
        database.append_lanes("north", SUMMER_ENDS_NS + 230 * 10**9, later)
        follower = TrafficFollower(
            database, "north", SCHEME, CLOCK,
            lambda text: StampedLanes(0, parse_lane_file(text, "text").lane_map.lanes),
        )  # fmt: skip
        while follower.step().batches:
            pass
    options = ["--interval", "60s", "--timezone", CLOCK.zone, "--out", str(tmp_path / "offline")]
    assert main(["traffic", "--database", str(path), *options]) == 0
    capsys.readouterr()
    for name, least in (("intervals", 30), ("vehicles", 30), ("movements", 20), ("events", 2)):
        out = tmp_path / f"{name}.csv"
        assert main(["db", "export", str(path), "--table", name, "--out", str(out)]) == 0
        lines = [line.removeprefix('"north",') for line in out.read_text().splitlines()[1:]]
        expected = (tmp_path / "offline" / f"{name}.csv").read_text().splitlines()[1:]
        assert len(lines) >= least
        assert lines == expected[: len(lines)]
        assert len(expected) - len(lines) <= 16  # those of the last interval, which is not finished
    capsys.readouterr()
    assert main(["db", "info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "Traffic" in shown
    assert "coco" in shown
    few = ["db", "export", str(path), "--table", "intervals", "--out", str(tmp_path / "a.parquet")]
    assert main([*few, "--from", f"{SUMMER_ENDS_NS / 1e9 + 60}", "--to", "1792890120"]) == 0
    table = pq.read_table(tmp_path / "a.parquet")
    assert set(table["interval_start"].to_pylist()) == {"2026-10-25T02:01:00+01:00"}
    assert main([*few, "--camera-id", "south"]) == 2
    assert "'south'" in capsys.readouterr().err
    _delete_backup_restore(path, tmp_path, capsys)


def _delete_backup_restore(path: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A minute of a day goes, traffic included; the backup from before has it still."""
    saved, again = folder / "saved.db", folder / "again.db"
    assert main(["db", "backup", str(path), "--out", str(saved)]) == 0
    begin = SUMMER_ENDS_NS / 1e9 + 60
    part = ["--camera", "north", "--from", f"{begin}", "--to", f"{begin + 60}"]
    assert main(["db", "delete", str(path), *part, "--yes"]) == 0
    capsys.readouterr()
    out = folder / "rest.csv"

    def rows(database: Path, table: str, *options: str) -> int:
        given = [str(database), "--table", table, "--out", str(out), *options]
        assert main(["db", "export", *given]) == 0
        return len(out.read_text().splitlines()) - 1

    for table in ("tracks", "intervals", "movements"):
        assert rows(path, table, *part[2:]) == 0
        assert rows(saved, table, *part[2:]) > 0
        left = rows(path, table)
        assert left == rows(saved, table) - rows(saved, table, *part[2:]) > 0
    assert 0 < rows(path, "vehicles") < rows(saved, "vehicles")
    assert main(["db", "restore", str(saved), str(path)]) == 2
    assert main(["db", "restore", str(saved), str(again)]) == 0
    assert rows(again, "tracks") == rows(saved, "tracks")
    wrong = ["--camera", "north", "--from", "10", "--to", "5", "--yes"]
    assert main(["db", "delete", str(path), *wrong]) == 2
    assert "a time that lasts" in capsys.readouterr().err
