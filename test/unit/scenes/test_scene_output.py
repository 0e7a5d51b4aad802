"""The files of a run: what the other commands read, and nothing when something fails."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_scenes import run_of

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.cli.main import main
from geoorbit_ros.core.errors import InputFileError, NoTrafficError, ParameterError
from geoorbit_ros.core.tables import FLAG_GROUND_POINT, Frames
from geoorbit_ros.lanes.geojson import read_lane_file
from geoorbit_ros.scenes.output import SceneFiles, write_scene_run
from geoorbit_ros.scenes.simulate import SceneRun
from geoorbit_ros.storage.track_bag import read_track_bag
from geoorbit_ros.storage.track_csv import read_track_csv

NAMES = [
    "bag",
    "calibration.csv",
    "clean_calibration.csv",
    "clean_tracks.csv",
    "network.net.xml",
    "tracks.csv",
    "truth.geojson",
]


@pytest.fixture(scope="module")
def run() -> SceneRun:
    return run_of("straight_3x3")


@pytest.fixture(scope="module")
def files(run: SceneRun, tmp_path_factory: pytest.TempPathFactory) -> SceneFiles:
    return write_scene_run(run, tmp_path_factory.mktemp("out") / "new" / "straight")


def same(frames: Frames, expected: Frames) -> bool:
    return (
        np.array_equal(frames.stamp_ns, expected.stamp_ns)
        and frames.rows.tobytes() == expected.rows.tobytes()
    )


def test_all_files_are_there_and_nothing_else(files: SceneFiles) -> None:
    assert sorted(path.name for path in files.tracks.parent.iterdir()) == NAMES
    assert [path.name for path in files.tracks.parent.parent.iterdir()] == ["straight"]


def test_bag_and_csv_hold_the_frames(run: SceneRun, files: SceneFiles) -> None:
    bag = read_track_bag(files.bag)
    assert bag.camera_id == "straight_3x3"
    assert same(bag.frames, run.frames)
    # The scene has a false track in every frame, so the CSV loses no empty one.
    assert same(read_track_csv(files.tracks, run.image_size), run.frames)


def test_the_truth_comes_back_within_a_millimetre(run: SceneRun, files: SceneFiles) -> None:
    read = read_lane_file(files.truth)
    assert read.datum == run.datum
    assert len(read.lane_map.lanes) == len(run.truth) == 6
    for a, b in zip(read.lane_map.lanes, run.truth, strict=True):
        assert (a.lane_id, a.vehicles) == (b.lane_id, b.vehicles)
        assert a.width_m == pytest.approx(b.width_m, abs=1e-3)
        for role in ("centerline_m", "left_m", "right_m"):
            assert np.allclose(getattr(a, role), getattr(b, role), atol=1e-3)


def test_control_points_come_back_within_a_millimetre(run: SceneRun, files: SceneFiles) -> None:
    points = read_control_points(files.calibration, run.datum)
    assert np.allclose(points.pixel, run.control_points.pixel, atol=1e-5)
    assert np.allclose(points.local_m, run.control_points.local_m, atol=1e-3)
    assert fit_homography(points).residual.inlier.all()


def test_clean_tracks_come_back_to_the_true_ground_points(run: SceneRun, files: SceneFiles) -> None:
    plane = fit_homography(read_control_points(files.clean_calibration, run.datum))
    frames = read_track_csv(files.clean_tracks, run.image_size)
    assert np.all(frames.rows["flags"] == FLAG_GROUND_POINT)
    assert len(frames.rows) > 0.95 * len(run.clean.rows)
    true = {
        (int(stamp), int(row["track_id"])): (float(row["x"]), float(row["y"]))
        for stamp, row in zip(run.clean.row_stamp_ns(), run.clean.rows, strict=True)
    }
    projector = BoxProjector(plane, run.image_size)
    for k, stamp in enumerate(frames.stamp_ns.tolist()):
        for row in projector.project(stamp, frames.frame(k)):
            x, y = true[stamp, int(row["track_id"])]
            assert np.hypot(row["x"] - x, row["y"] - y) < 0.02


def test_a_failed_write_leaves_nothing(run: SceneRun, tmp_path: Path) -> None:
    with pytest.raises(ParameterError):
        write_scene_run(run, tmp_path / "deep" / "out", "no name")
    broken = replace(run, truth=(None, *run.truth))  # type: ignore[arg-type]
    with pytest.raises(AttributeError):  # the truth is written after all tracks
        write_scene_run(broken, tmp_path / "deep" / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_run_without_vehicles_is_no_run(run: SceneRun, tmp_path: Path) -> None:
    nothing = replace(
        run, clean=Frames(run.clean.stamp_ns, 0 * run.clean.offset, run.clean.rows[:0])
    )
    with pytest.raises(NoTrafficError, match="'straight_3x3': found no vehicle in 150 frames"):
        write_scene_run(nothing, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_never_replaced(run: SceneRun, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.write_text("mine")
    for there in (tmp_path, kept):
        with pytest.raises(InputFileError, match="expected a path that does not exist yet"):
            write_scene_run(run, there)
    assert kept.read_text() == "mine"


def test_the_command_writes_the_same_files_every_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a", "b"):
        words = ["scene", "run", "s_curve", "--duration", "6", "--seed", "4"]
        assert main([*words, "--out", str(tmp_path / name)]) == 0
    shown = capsys.readouterr().out
    assert "True lanes of s_curve" in shown
    assert "120 frames of 1280x720" in shown
    for name in NAMES[1:]:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    bags = [read_track_bag(tmp_path / name / "bag").frames for name in ("a", "b")]
    assert same(*bags)


def test_the_command_reads_what_it_wrote(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = ["scene", "run", "straight_3x3", "--duration", "15", "--camera-id", "pole_9"]
    assert main([*words, "--out", str(out)]) == 0
    lanes = ["--calibration", str(out / "clean_calibration.csv"), "--out", str(out / "l.geojson")]
    assert main(["lanes", "--tracks", str(out / "clean_tracks.csv"), *lanes]) == 0
    assert main(["score", str(out / "l.geojson"), str(out / "truth.geojson")]) == 0
    assert main(["bag", "info", str(out / "bag")]) == 0
    assert "/pole_9/tracks_px" in capsys.readouterr().out


def test_the_list_names_every_scene(capsys: pytest.CaptureFixture[str]) -> None:
    from geoorbit_ros.scenes.scene import shipped_scenes

    assert main(["scene", "list"]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in shipped_scenes())


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nowhere"], "geoorbit: scene 'nowhere': found no such scene, expected a file, or one of"),
        (["nowhere.yaml"], "geoorbit: nowhere.yaml: found no such file"),
        (["s_curve", "--duration", "0"], "geoorbit: duration: found 0 s, expected 1 to 21600 s"),
        (["s_curve", "--seed", "-1"], "geoorbit: seed: found -1, expected 0 to 2147483647"),
        (["s_curve", "--duration", "1", "--camera-id", "7"], "geoorbit: camera id: found '7'"),
    ],
)
def test_wrong_input_gets_one_sentence_and_leaves_nothing(
    words: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["scene", "run", *words, "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert told.startswith(sentence)
    assert told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_content_is_refused_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("simulated")

    monkeypatch.setattr("geoorbit_ros.scenes.simulate.simulate", never)
    (tmp_path / "mine").touch()
    assert main(["scene", "run", "s_curve", "--out", str(tmp_path)]) == 2
    assert "found a folder with content" in capsys.readouterr().err
