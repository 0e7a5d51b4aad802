"""`geoorbit process`: everything from images, or one sentence and nothing."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_files import CameraFiles
from mjpeg_server import MjpegServer, grey_image

from geoorbit_ros.cli.main import EXIT_BAD_INPUT, main
from geoorbit_ros.storage.frames import open_source

IMAGE_SIZE = 1920, 1080


def write_images(folder: Path, sizes: list[tuple[int, int]]) -> Path:
    folder.mkdir()
    for k, size in enumerate(sizes):
        assert cv2.imwrite(str(folder / f"{k}.jpg"), grey_image(90, size))
    return folder


def refused(
    capsys: pytest.CaptureFixture[str], camera: CameraFiles, out: Path, *arguments: str
) -> str:
    """The one sentence of a command that must fail and leave nothing behind."""
    words = ["process", *arguments, "--out", str(out), "--calibration", str(camera.calibration)]
    before = sorted(out.parent.iterdir())
    assert main(words) == EXIT_BAD_INPUT
    error = capsys.readouterr().err.strip()
    assert error.startswith("geoorbit: ")
    assert sorted(out.parent.iterdir()) == before, "nothing is left behind"
    return error


def test_a_missing_or_corrupt_video_is_one_sentence(
    capsys: pytest.CaptureFixture[str], camera: CameraFiles, tmp_path: Path
) -> None:
    noise, out = tmp_path / "noise.mp4", tmp_path / "out"
    noise.write_bytes(np.random.default_rng(2).bytes(3000))
    for source, words in (
        (tmp_path / "absent.mp4", "no such file"),
        (noise, "3000 bytes that are no video"),
        (camera.tracks, "bytes that are no video"),
    ):
        sentence = refused(capsys, camera, out, str(source))
        assert words in sentence
        assert "\n" not in sentence


def test_strictly_taken_frames_that_change_size_end_it(
    capsys: pytest.CaptureFixture[str], camera: CameraFiles, tmp_path: Path
) -> None:
    images = write_images(tmp_path / "images", [IMAGE_SIZE] * 2 + [(1280, 720)])
    sentence = refused(capsys, camera, tmp_path / "out", str(images), "--fps", "10", "--strict")
    assert "2.jpg: found a frame of 1280x720 pixels, expected 1920x1080 as before" in sentence


def empty(capsys: pytest.CaptureFixture[str], camera: CameraFiles, out: Path, images: Path) -> str:
    """What the command says of images without traffic; all files are there nevertheless."""
    words = ["process", str(images), "--fps", "10", "--out", str(out), "--calibration"]
    assert main([*words, str(camera.calibration)]) == 0
    assert {file.name for file in out.iterdir()} == {
        *("detections.txt", "tracks.txt", "tracks.csv", "lanes.geojson", "road.png", "report.html"),
    }
    assert json.loads((out / "lanes.geojson").read_text())["features"] == []
    assert "data:image/jpeg" in (out / "report.html").read_text()
    said = " ".join(capsys.readouterr().out.split())
    assert "0 lanes confirmed" in said
    return said


def test_control_points_of_a_larger_image_are_told(
    capsys: pytest.CaptureFixture[str], camera: CameraFiles, tmp_path: Path
) -> None:
    images = write_images(tmp_path / "images", [(160, 120)])
    said = empty(capsys, camera, tmp_path / "out", images)
    assert "the image is 160x120, but the control points reach pixel" in said


def test_blank_images_have_no_lanes_and_all_files(
    capsys: pytest.CaptureFixture[str], camera: CameraFiles, tmp_path: Path
) -> None:
    images = write_images(tmp_path / "images", [IMAGE_SIZE] * 3)
    said = empty(capsys, camera, tmp_path / "out", images)
    assert "no lane: 3 images that show nothing: dark, covered or blank" in said


def test_a_stream_needs_a_duration_and_is_given_up_in_one_sentence(
    capsys: pytest.CaptureFixture[str],
    camera: CameraFiles,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "out"
    assert "--duration" in refused(capsys, camera, out, "rtsp://127.0.0.1:9/stream")
    monkeypatch.setattr(open_source, "FIRST_WAIT_S", 40.0)
    with MjpegServer() as server:
        sentence = refused(capsys, camera, out, server.address, "--duration", "5")
    assert f"{server.address}: found no answer" in sentence


def test_a_folder_with_content_and_a_file_are_not_written_over(
    capsys: pytest.CaptureFixture[str], camera: CameraFiles, tmp_path: Path
) -> None:
    images = write_images(tmp_path / "images", [IMAGE_SIZE])
    file = tmp_path / "file"
    file.write_text("mine")
    assert "a file" in refused(capsys, camera, file, str(images))
    assert "with content" in refused(capsys, camera, images, str(images))
    assert file.read_text() == "mine"
