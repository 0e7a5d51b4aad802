"""`geoorbit traffic` end to end, and what wrong input gets."""

from __future__ import annotations

import csv
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from camera_files import CameraFiles, to_pixel
from page_checker import check_page

from geoorbit_ros.cli.camera_input import load_camera
from geoorbit_ros.cli.main import main
from geoorbit_ros.storage.database.writer import TrajectoryDatabase

TABLES = ("vehicles", "intervals", "movements")
SECTIONS = re.compile(r"<h2>Traffic per lane</h2>.*(?=<h2>How this was made)")


def traffic(camera: CameraFiles, out: Path, *more: object) -> int:
    words = ("--tracks", camera.tracks, "--calibration", camera.calibration, "--out", out)
    return main([str(word) for word in ("traffic", *words, *more)])


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def found(camera: CameraFiles, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("traffic") / "out"
    assert traffic(camera, out, "--interval", "10s", "--lanes", camera.truth) == 0
    return out


def test_every_vehicle_has_a_row_in_its_lane_with_its_speed(found: Path) -> None:
    vehicles = rows(found / "vehicles.csv")
    assert len(vehicles) == 30
    for row in vehicles:
        assert int(row["lane_id"]) == int(row["track_id"]) % 10
        assert float(row["speed_kmh"]) == pytest.approx(54.0, abs=1.0)
        assert 0.0 < float(row["speed_sigma_kmh"]) < 1.5
        assert row["length_m"] == ""  # points on the ground have none
        assert (row["from_lane"], row["to_lane"]) == ("", "")
        assert float(row["time_last_s"]) > float(row["time_first_s"])


def test_volumes_of_intervals_add_up_to_the_vehicles(found: Path) -> None:
    intervals = rows(found / "intervals.csv")
    volume = Counter[tuple[str, str]]()
    for row in intervals:
        volume[row["lane_id"], row["class"]] += int(row["volume"])
    assert volume["1", "all"] == volume["1", "car"] == 15
    assert volume["2", "all"] == 15
    assert volume["", "all"] == 30
    starts = [float(row["interval_start"]) for row in intervals]
    assert starts == sorted(starts)
    assert {s % 10 for s in starts} == {0.0}
    assert sum(int(row["volume"]) for row in rows(found / "movements.csv")) == 2 * 30


@pytest.mark.parametrize("name", TABLES)
def test_parquet_says_the_same_as_csv(found: Path, name: str) -> None:
    table = pq.read_table(found / f"{name}.parquet").to_pylist()
    written = rows(found / f"{name}.csv")
    assert len(table) == len(written) > 0
    for a, b in zip(table, written, strict=True):
        assert list(a) == list(b)
        for key, value in a.items():
            shown = "" if value is None else value
            assert b[key] == shown or float(b[key]) == pytest.approx(float(value), abs=1e-9)


def test_a_vehicle_that_drives_against_its_lane_is_an_event(
    camera: CameraFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    x_m = np.arange(100.0, 10.0, -1.5)
    pixel = to_pixel(np.column_stack((x_m, np.full_like(x_m, -3.5))))
    wrong = tmp_path / "tracks.csv"
    extra = [
        f"999,{40.0 + k / 10:.1f},{400 + k},2,0.9,{u:.2f},{v:.2f},0,0"
        for k, (u, v) in enumerate(pixel)
    ]
    wrong.write_text(camera.tracks.read_text() + "\n".join(extra) + "\n")
    out = tmp_path / "out"
    words = ("--tracks", wrong, "--calibration", camera.calibration, "--lanes", camera.truth)
    assert main([str(w) for w in ("traffic", *words, "--out", out)]) == 0
    (event,) = rows(out / "events.csv")
    assert (event["kind"], event["track_id"], event["lane_id"]) == ("wrong_way", "999", "2")
    assert float(event["speed_kmh"]) == pytest.approx(54.0, abs=3.0)
    assert "against the direction of lane 2" in capsys.readouterr().out
    assert "against the direction of lane 2" in (out / "report.html").read_text(encoding="utf-8")


def test_stations_are_told_and_can_be_chosen(
    camera: CameraFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--lanes", camera.truth, "--force", "--station")
    out = tmp_path / "out"
    assert traffic(camera, out, *words, "25") == 0
    said = capsys.readouterr().out
    (place,) = set(re.findall(r"Station 1 is at (\S+,\S+), 25 m along lane", said))
    assert traffic(camera, out, *words, place) == 0
    assert f"Station 1 is at {place}, 25 m along" in capsys.readouterr().out
    for wrong, told in (("0,0", "beside a lane"), ("900", "beside a lane"), ("here", "metres")):
        assert traffic(camera, out, *words, wrong) == 2
        error = capsys.readouterr().err
        assert "option --station" in error
        assert told in error


def test_the_lanes_are_found_where_none_are_given(
    camera: CameraFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert traffic(camera, tmp_path / "out") == 0
    assert "30" in capsys.readouterr().out
    assert len(rows(tmp_path / "out" / "vehicles.csv")) == 30
    assert (tmp_path / "out" / "lanes.geojson").is_file()


def test_a_database_gives_the_same_bytes_as_the_tracks(
    camera: CameraFiles, found: Path, tmp_path: Path
) -> None:
    read = load_camera(
        camera.tracks, None, camera.calibration, None, None, None, tmp_path / "none.geojson"
    )
    path = tmp_path / "tracks.db"
    with TrajectoryDatabase(path) as database:
        for block in read.ground_tracks():
            for k, stamp_ns in enumerate(block.stamp_ns.tolist()):
                database.append("pole_7", stamp_ns, block.frame(k))
        text = (found / "lanes.geojson").read_text(encoding="utf-8")
        database.append_lanes("pole_7", 0, text)
    out = tmp_path / "out"
    words = ["--database", path, "--calibration", camera.calibration, "--interval", "10s"]
    assert main([str(w) for w in ("traffic", *words, "--out", out)]) == 0
    for name in TABLES:
        assert (out / f"{name}.csv").read_bytes() == (found / f"{name}.csv").read_bytes(), name
    pictures = [
        SECTIONS.findall((k / "report.html").read_text(encoding="utf-8")) for k in (out, found)
    ]
    assert pictures[0] == pictures[1] != []


def test_a_scheme_of_ones_own_and_the_schemes_of_agencies_class_the_vehicles(
    camera: CameraFiles, tmp_path: Path
) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("rules: [{category: light, classes: [car]}]\nheavy: []\n")
    for scheme, name in ((own, "light"), ("fhwa3", "short"), ("tls5+1", "car")):
        out = tmp_path / name
        assert traffic(camera, out, "--class-scheme", scheme) == 0
        assert {row["class"] for row in rows(out / "vehicles.csv")} == {name}


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--interval", "7min"], "found 420 s, expected 1 s to 1 day, a length that divides a day"),
        (["--interval", "soon"], "option --interval: found 'soon', expected 30s, 15min, 1h or 1d"),
        (["--timezone", "Mars/Base"], "option --timezone: found 'Mars/Base'"),
        (["--class-scheme", "euro6"], "expected coco, fhwa3, tls5+1, or a YAML file"),
        (["--database", "x.db"], "options --tracks, --bag and --database: found two"),
    ],
)
def test_wrong_options_get_one_sentence(
    camera: CameraFiles,
    tmp_path: Path,
    options: list[str],
    sentence: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert traffic(camera, tmp_path / "out", *options) == 2
    shown = " ".join(capsys.readouterr().err.split())
    assert sentence in shown
    assert not (tmp_path / "out").exists()


def test_missing_sources_get_one_sentence(
    camera: CameraFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "out")
    assert main(["traffic", "--tracks", str(camera.tracks), "--out", out]) == 2
    assert "option --calibration: found nothing" in capsys.readouterr().err
    assert main(["traffic", "--calibration", str(camera.calibration), "--out", out]) == 2
    assert "found neither, expected exactly one of them" in capsys.readouterr().err
    path = tmp_path / "two.db"
    with TrajectoryDatabase(path) as database:
        for name in ("north", "south"):
            database.append_lanes(name, 0, "{}")
    assert main(["traffic", "--database", str(path), "--out", out]) == 2
    assert "expected one of north, south" in capsys.readouterr().err


def test_the_page_has_the_numbers_of_the_tables_and_the_lane_report_shows_them_too(
    camera: CameraFiles, found: Path, tmp_path: Path
) -> None:
    page = (found / "report.html").read_text(encoding="utf-8")
    check_page(page)
    assert "30 vehicles drove towards" in page
    report = tmp_path / "report.html"
    words = ("--tracks", camera.tracks, "--calibration", camera.calibration, "--out", report)
    assert main([str(w) for w in ("report", *words, "--lanes", camera.truth)]) == 0
    both = report.read_text(encoding="utf-8")
    check_page(both)
    table = re.compile(r"<h2>Traffic per lane</h2>.*?</section>")
    assert table.findall(page) == table.findall(both) != []
