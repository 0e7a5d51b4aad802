"""`geoorbit bag`: from a CSV to a bag and back, every wrong input one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest
from camera_files import CameraFiles
from made_bags import TRACKS, MadeMcap
from made_up_camera import make_camera

from geoorbit_ros.cli.main import main
from geoorbit_ros.storage.bag_reader import bag_messages
from geoorbit_ros.storage.track_bag import read_track_bag, write_track_bag
from geoorbit_ros.storage.track_csv import read_track_csv


def from_csv(camera: CameraFiles, out: Path, **changed: object) -> int:
    options = {
        "tracks": camera.tracks,
        "calibration": camera.calibration,
        "camera-id": "pole_7",
        "out": out,
    } | changed
    return main(["bag", "from-csv", *(w for k, v in options.items() for w in (f"--{k}", str(v)))])


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_csv_becomes_a_bag_with_the_same_tracks(
    camera: CameraFiles, tmp_path: Path, storage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert from_csv(camera, tmp_path / "bag", storage=storage) == 0
    assert "100% of the boxes have a place on the road" in capsys.readouterr().out
    bag = read_track_bag(tmp_path / "bag")
    expected = read_track_csv(camera.tracks)
    assert bag.camera_id == "pole_7"
    assert bag.frames.rows.tobytes() == expected.rows.tobytes()
    assert bag.frames.stamp_ns.tolist() == expected.stamp_ns.tolist()

    assert main(["bag", "info", str(tmp_path / "bag")]) == 0
    shown = capsys.readouterr().out
    for part in (storage, "/pole_7/tracks_px", "PointCloud2", f"{len(expected)} messages"):
        assert part in shown


def test_a_folder_with_content_is_written_into_on_demand_alone(
    camera: CameraFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = tmp_path / "bag"
    assert from_csv(camera, bag) == 0
    (bag / "notes.txt").write_text("mine")
    assert from_csv(camera, bag) == 2
    assert (
        "a folder with content, expected a path that does not exist yet (or --force)"
        in " ".join(capsys.readouterr().err.split())
    )
    words = ["--tracks", str(camera.tracks), "--calibration", str(camera.calibration)]
    words += ["--camera-id", "south", "--out", str(bag), "--force"]
    assert main(["bag", "from-csv", *words]) == 0
    assert read_track_bag(bag).camera_id == "south"
    assert (bag / "notes.txt").read_text() == "mine"


WRONG: list[tuple[str, str, str, str]] = [
    ("tracks", "", "", "input.csv: found no such file"),
    ("tracks", "id,time,frame_num,class,conf,x,y,w,h", "1,0,0,2,1,nan,2,3,4", "line 2: x nan"),
    ("tracks", "id,time,frame_num,class,conf,x,y,w,h", "1,0,0,2,1,5,-9999,3,4", "the horizon"),
    ("calibration", "pixel_x,pixel_y,x_m,y_m", "1,2,3,4\n4,5,6,7", "found 2 control points"),
    ("camera-id", "", "", "camera id: found 'pole 7'"),
]


@pytest.mark.parametrize(("option", "header", "lines", "sentence"), WRONG)
def test_wrong_input_gets_one_sentence_and_leaves_nothing(
    camera: CameraFiles,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    option: str,
    header: str,
    lines: str,
    sentence: str,
) -> None:
    value = "pole 7" if option == "camera-id" else str(tmp_path / "input.csv")
    if header:
        (tmp_path / "input.csv").write_text(f"{header}\n{lines}\n")
    assert from_csv(camera, tmp_path / "bag", **{option: value}) == 2
    shown = capsys.readouterr()
    assert sentence in shown.err
    assert shown.err.count("\n") == 1
    assert shown.out == ""
    assert not (tmp_path / "bag").exists()


def test_a_bag_that_is_there_is_kept(
    camera: CameraFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert from_csv(camera, tmp_path / "bag") == 0
    before = {f.name: f.read_bytes() for f in (tmp_path / "bag").iterdir()}
    assert from_csv(camera, tmp_path / "bag") == 2
    assert "folder with content" in capsys.readouterr().err
    assert {f.name: f.read_bytes() for f in (tmp_path / "bag").iterdir()} == before


def test_info_on_a_bag_cut_off(
    camera: CameraFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_track_bag(tmp_path / "bag", "pole_7", read_track_csv(camera.tracks))
    data = tmp_path / "bag" / "bag.mcap"
    data.write_bytes(data.read_bytes()[:-100])
    assert main(["bag", "info", str(tmp_path / "bag")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "/pole_7/tracks_px" in shown
    assert "bag.mcap has no end (cut off, or its recorder still runs)" in shown


def as_mcap(bag: Path, made: MadeMcap, by_turns: bool, path: Path) -> Path:
    messages = [
        (1 + k % 2 * by_turns, message.time_ns, message.cdr)
        for k, message in enumerate(bag_messages(bag))
    ]
    return made.write(path, messages)


def lanes(bag: Path, calibration: Path, out: Path, *more: str) -> bytes:
    words = ["lanes", "--bag", bag, "--calibration", calibration, "--out", out, *more]
    assert main([str(word) for word in words]) == 0
    return out.read_bytes()


def test_lanes_of_a_bag_do_not_depend_on_the_program_that_wrote_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One topic on two channels, as after a publisher's restart; no profile."""
    camera = make_camera(tmp_path)
    expected = lanes(camera.bag, camera.calibration, tmp_path / "lanes.geojson")
    assert "lanes confirmed" in " ".join(capsys.readouterr().out.split())
    topic = (f"/{camera.camera_id}/tracks_px", *TRACKS)
    two = as_mcap(camera.bag, MadeMcap({1: topic, 2: topic}), True, tmp_path / "two.mcap")
    none = as_mcap(camera.bag, MadeMcap({1: topic}, profile=""), False, tmp_path / "none.mcap")
    for bag in (two, none):
        for more in ((), ("--camera-id", camera.camera_id), ("--strict",)):
            assert lanes(bag, camera.calibration, tmp_path / "other.geojson", *more) == expected
        assert main(["bag", "info", str(bag)]) == 0
        assert capsys.readouterr().out.count("/tracks_px") == 1


def test_a_bag_with_faults_says_them_in_summary_and_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = make_camera(tmp_path)
    data = camera.bag / "bag.mcap"
    data.write_bytes(data.read_bytes()[:-2000])
    page = tmp_path / "report.html"
    words = ["--report", str(page)]
    lanes(camera.bag, camera.calibration, tmp_path / "lanes.geojson", *words)
    assert "has no end" in " ".join(capsys.readouterr().out.split())
    assert "has no end" in page.read_text()
    out = tmp_path / "strict.geojson"
    options = {"bag": camera.bag, "calibration": camera.calibration, "out": out}
    words = [word for key, value in options.items() for word in (f"--{key}", str(value))]
    assert main(["lanes", *words, "--strict"]) == 2
    assert "not accepted with --strict" in capsys.readouterr().err
    assert not out.exists()
