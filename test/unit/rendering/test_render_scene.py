"""Rendered scenes: the traffic of `simulate`, the files of a full test camera, the command."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from made_scenes import FAULTLESS, changed, run_of

from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.cli.main import main
from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE
from geoorbit_ros.lanes.geojson import read_lane_file
from geoorbit_ros.rendering.rendered_scene import (
    RenderedFrame,
    RenderedScene,
    render_scene,
)
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import START_NS, simulate
from geoorbit_ros.storage.frames.video_writer import new_video
from geoorbit_ros.storage.mot_text import read_mot_tracks
from geoorbit_ros.storage.track_csv import read_track_csv

SIZE = (640, 360)
NAMES = ["calibration.csv", "tracks.csv", "tracks.txt", "truth.geojson", "video.mp4"]


def rendered(name: str = "s_curve", seed: int = 4, duration_s: float = 2.0) -> RenderedScene:
    return render_scene(load_scene(name), duration_s, seed, fps=10.0, image_size=SIZE)


@pytest.fixture(scope="module")
def frames() -> list[RenderedFrame]:
    return list(rendered())


def test_vehicles_are_where_simulate_has_them() -> None:
    scene = changed(load_scene("s_curve"), detector=FAULTLESS)
    run = simulate(scene, 2.0, 4)
    images = render_scene(scene, 2.0, 4, image_size=(640, 360))
    matched = 0
    for k, frame in enumerate(images):
        assert frame.stamp_ns == run.frames.stamp_ns[k]
        exact = {int(row["track_id"]): row for row in run.boxes.frame(k)}
        for row in frame.boxes:
            twin = exact.get(int(row["track_id"]))
            if twin is None or twin["flags"] or row["flags"]:
                continue
            assert row["class_id"] == twin["class_id"]
            # Half the size of the scene's own image; a solid lies in its upright box.
            assert abs(2 * row["x"] - twin["x"]) <= 0.06 * twin["width"] + 0.1
            assert 0.8 * twin["height"] <= 2 * row["height"] <= twin["height"] + 0.01
            matched += 1
    assert matched > 100
    assert k + 1 == len(run.frames) == images.frame_count


def test_the_truth_is_that_of_the_scene() -> None:
    scene = rendered("straight_3x3", 1, 10.0)
    for _ in scene:
        pass
    run = run_of("straight_3x3")
    assert len(scene.truth) == len(run.truth) == 6
    for a, b in zip(scene.truth, run.truth, strict=True):
        assert a.width_m == b.width_m
        # A third of the pixels: the camera sees less far, along the same line.
        ends = a.centerline_m[[0, -1]]
        assert np.min(np.hypot(*(b.centerline_m[:, None] - ends).T), axis=1).max() < 1.0
        assert a.length_m <= b.length_m + 1.0
        assert abs(a.vehicles - b.vehicles) <= 4
    assert sum(lane.vehicles for lane in scene.truth) > 10
    # Control points belong to the images that are rendered.
    plane = fit_homography(scene.control_points)
    assert plane.residual.inlier.all()
    assert np.all(scene.control_points.pixel < np.array(SIZE) + 5.0)


def test_the_same_seed_gives_the_same_frames_and_another_does_not(
    frames: list[RenderedFrame],
) -> None:
    first, again, other = frames[0], next(rendered()), next(rendered(seed=5))
    assert np.array_equal(first.image, again.image)
    assert first.boxes.tobytes() == again.boxes.tobytes()
    assert not np.array_equal(first.image, other.image)
    assert first.boxes.tobytes() != other.boxes.tobytes()


def test_frames_come_at_the_rate_asked_for_and_end(frames: list[RenderedFrame]) -> None:
    assert [f.stamp_ns for f in frames] == [START_NS + k * 100_000_000 for k in range(20)]
    assert all(f.image.shape == (360, 640, 3) and f.image.dtype == np.uint8 for f in frames)
    assert all(f.boxes.dtype == PIXEL_TRACK_DTYPE for f in frames)


@pytest.mark.parametrize(
    ("kind", "value"),
    [("fps", 0.5), ("fps", float("nan")), ("image_size", (20, 720)), ("duration_s", 0.1)],
)
def test_what_cannot_be_rendered_is_refused(kind: str, value: object) -> None:
    settings: dict[str, object] = {"duration_s": 1.0, "seed": 1, kind: value}
    with pytest.raises(ParameterError):
        render_scene(load_scene("s_curve"), **settings)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rendered") / "camera"
    assert main([*command(2), "--out", str(folder)]) == 0
    return folder


def command(duration_s: int) -> list[str]:
    words = ["scene", "render", "s_curve", "--duration", str(duration_s), "--seed", "4"]
    return [*words, "--fps", "10", "--size", "640x360"]


def test_the_command_writes_a_full_test_camera(out: Path, frames: list[RenderedFrame]) -> None:
    assert sorted(path.name for path in out.iterdir()) == NAMES
    tracks = read_track_csv(out / "tracks.csv", SIZE)
    assert tracks.stamp_ns.tolist() == [frame.stamp_ns for frame in frames]
    for name in ("x", "y", "width", "height", "score", "class_id", "track_id"):
        expected = np.concatenate([frame.boxes[name] for frame in frames])
        assert np.array_equal(tracks.rows[name], expected), name
    mot = dict(read_mot_tracks(out / "tracks.txt"))
    for k, frame in enumerate(frames):
        assert np.array_equal(mot[k + 1]["track_id"], frame.boxes["track_id"])
        assert np.allclose(mot[k + 1]["x"], frame.boxes["x"], atol=2e-3)
        assert np.allclose(mot[k + 1]["score"], frame.boxes["score"], atol=1e-5)
    truth = read_lane_file(out / "truth.geojson")
    assert len(truth.lane_map.lanes) == 2
    points = read_control_points(out / "calibration.csv", truth.datum)
    assert fit_homography(points).residual.inlier.all()


def test_the_video_shows_the_frames(out: Path, frames: list[RenderedFrame]) -> None:
    video = cv2.VideoCapture(str(out / "video.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10.0)
    for frame in frames:
        there, image = video.read()
        assert there
        difference = np.abs(image.astype(float) - frame.image)
        assert difference.mean() < 6.0, "compressed, but the same"
    assert not video.read()[0]


def test_a_name_in_avi_gives_a_jpeg_per_frame(tmp_path: Path, frames: list[RenderedFrame]) -> None:
    path = tmp_path / "deep" / "film.avi"
    with new_video(path, 10.0, SIZE) as film:
        for frame in frames[:5]:
            film.write(frame.image)
    video = cv2.VideoCapture(str(path))
    for frame in frames[:5]:
        there, image = video.read()
        assert there
        assert np.abs(image.astype(float) - frame.image).mean() < 6.0
    assert not video.read()[0]
    assert [p.name for p in path.parent.iterdir()] == ["film.avi"]


def test_a_film_that_fails_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="lens cap"), new_video(tmp_path / "a.mp4", 10.0, SIZE):
        raise ValueError("lens cap")
    with (
        pytest.raises(InputFileError, match=r"found '.mkv', expected a name in .mp4 or .avi"),
        new_video(tmp_path / "a.mkv", 10.0, SIZE),
    ):
        raise AssertionError("opened")
    assert list(tmp_path.iterdir()) == []


def test_a_film_alone_is_the_same_film(out: Path, tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    assert main([*command(2), "--out", str(path)]) == 0
    films = [cv2.VideoCapture(str(p)) for p in (path, out / "video.mp4")]
    for _ in range(20):
        (there, image), (_, other) = (film.read() for film in films)
        assert there
        assert np.array_equal(image, other)
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nowhere"], "geoorbit: scene 'nowhere': found no such scene"),
        (["s_curve", "--size", "big"], "geoorbit: size: found 'big', expected width x height"),
        (["s_curve", "--size", "64x36"], "geoorbit: image width: found 64 px, expected 160 to"),
        (["s_curve", "--fps", "0"], "geoorbit: fps: found 0 frames/s, expected 1 to 120 frames/s"),
        (["s_curve", "--clouds", "2"], "geoorbit: clouds: found 2, expected 0 to 0.5"),
        (["s_curve", "--duration", "0"], "geoorbit: duration: found 0 s, expected 1 to 21600 s"),
    ],
)
def test_wrong_input_gets_one_sentence_and_leaves_nothing(
    words: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["scene", "render", *words, "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert told.startswith(sentence)
    assert told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_not_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("rendered")

    monkeypatch.setattr("geoorbit_ros.rendering.rendered_scene.render_scene", never)
    (tmp_path / "mine").touch()
    assert main([*command(1), "--out", str(tmp_path)]) == 2
    assert "found a folder with content" in capsys.readouterr().err
    assert main([*command(1), "--out", str(tmp_path / "film.mov")]) == 2
    assert "found '.mov', expected a name in .mp4 or .avi" in capsys.readouterr().err
