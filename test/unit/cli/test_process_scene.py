"""From a rendered video to lanes with one command, against the exact truth."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import pytest
from mjpeg_server import MjpegServer

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.cli.main import main
from geoorbit_ros.cli.signals import EXIT_INTERRUPTED
from geoorbit_ros.fleet.fleet_io import load_fleet
from geoorbit_ros.lanes.geojson import read_lane_file, read_lanes
from geoorbit_ros.metrics.score import score_lanes
from geoorbit_ros.rendering.output import write_rendered_scene
from geoorbit_ros.rendering.rendered_scene import render_scene
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.storage.mot_text import read_mot_detections, read_mot_tracks
from geoorbit_ros.storage.track_csv import read_track_csv

SCENE, SEED, DURATION_S, FPS, SIZE = "s_curve", 1, 30.0, 8.0, (960, 540)


@dataclass(frozen=True)
class Processed:
    film: Path
    out: Path
    datum: Datum


@pytest.fixture(scope="module")
def processed(tmp_path_factory: pytest.TempPathFactory) -> Processed:
    folder = tmp_path_factory.mktemp("scene")
    rendered = render_scene(load_scene(SCENE), DURATION_S, SEED, fps=FPS, image_size=SIZE)
    write_rendered_scene(rendered, folder / "film")
    film, out = folder / "film", folder / "out"
    words = ["process", str(film / "video.mp4"), "--calibration", str(film / "calibration.csv")]
    assert main([*words, "--out", str(out), "--video"]) == 0
    return Processed(film, out, rendered.datum)


def assert_right_lanes(out: Path, processed: Processed) -> None:
    truth = read_lanes(processed.film / "truth.geojson", processed.datum).lanes
    found = read_lane_file(out / "lanes.geojson", processed.datum).lane_map.lanes
    score = score_lanes(found, truth)
    assert score.missed() == ()
    assert (score.invented, score.direction_wrong) == ((), ())
    error_m = np.concatenate([row.error_m for row in score.matched])
    assert error_m.mean() <= 0.30


def test_the_lanes_are_those_of_the_scene_and_lead_the_right_way(processed: Processed) -> None:
    assert_right_lanes(processed.out, processed)


def test_two_views_are_told_and_not_mixed(
    processed: Processed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The camera is turned after 20 s: the lanes are those of the first 20 s by themselves."""
    film = cv2.VideoCapture(str(processed.film / "video.mp4"))
    images = [film.read()[1] for _ in range(160)]
    folder = tmp_path / "film"
    folder.mkdir()
    for k, image in enumerate([*images, *(i[::-1] for i in images[:60])]):
        assert cv2.imwrite(str(folder / f"{k:04}.jpg"), image)
    words = ["process", str(folder), "--fps", str(FPS), "--out", str(folder / "out")]
    calibration = str(processed.film / "calibration.csv")
    assert main([*words, "--calibration", calibration, "--min-score", "0.3"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    told = re.search(r"shows another view from (\d+\.\d) s on", said)
    assert told, said
    assert 20.0 <= float(told[1]) <= 20.5
    kept = re.search(r"lanes are from 0\.0 to (\d+\.\d) s", said)
    assert kept, said
    assert 19.0 <= float(kept[1]) <= 20.0
    assert "another view" in (folder / "out" / "report.html").read_text(encoding="utf-8")
    assert_right_lanes(folder / "out", processed)


def test_a_bump_in_the_middle_is_told_and_moves_no_lane(
    processed: Processed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From 15 s on the image lies 12 px to the right and 7 px up, turned by half a degree."""
    film = cv2.VideoCapture(str(processed.film / "video.mp4"))
    motion = np.vstack([cv2.getRotationMatrix2D((479.5, 269.5), 0.5, 1.0), [0.0, 0.0, 1.0]])
    motion[:2, 2] += (12.0, -7.0)
    folder = tmp_path / "film"
    folder.mkdir()
    for k in range(round(DURATION_S * FPS)):
        image = film.read()[1]
        if k >= 120:
            image = cv2.warpPerspective(image, motion, SIZE, borderMode=cv2.BORDER_REFLECT_101)
        assert cv2.imwrite(str(folder / f"{k:04}.jpg"), image)
    words = ["process", str(folder), "--fps", str(FPS), "--out", str(folder / "out")]
    assert main([*words, "--calibration", str(processed.film / "calibration.csv")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    told = re.search(r"the image has moved by (\d+) px \((\d+) px to the right and 7 px up\)", said)
    assert told, said
    assert (int(told[1]), int(told[2])) == (14, 12)
    at = re.search(r"from (\d+\.\d) s on, found again within", said)
    assert at, said
    assert float(at[1]) == pytest.approx(15.0, abs=0.5)
    assert_right_lanes(folder / "out", processed)
    first, second = (
        read_lane_file(out / "lanes.geojson", processed.datum).lane_map.lanes
        for out in (processed.out, folder / "out")
    )
    score = score_lanes(second, first)
    assert (score.missed(), score.invented) == ((), ())
    assert max(row.error_m.mean() for row in score.matched) <= 0.10
    tracks = read_track_csv(folder / "out" / "tracks.csv", SIZE)
    assert len(tracks.rows)


def test_the_tracks_written_give_the_lanes_again(processed: Processed, tmp_path: Path) -> None:
    again = tmp_path / "lanes.geojson"
    words = ["lanes", "--tracks", str(processed.out / "tracks.csv"), "--out", str(again)]
    calibration = ["--calibration", str(processed.film / "calibration.csv")]
    road = ["--image", str(processed.out / "road.png")]
    assert main([*words, *calibration, *road, "--image-size", f"{SIZE[0]}x{SIZE[1]}"]) == 0
    first, second = (
        read_lane_file(path, processed.datum).lane_map.lanes
        for path in (processed.out / "lanes.geojson", again)
    )
    score = score_lanes(second, first)
    assert (score.missed(), score.invented) == ((), ())
    error_m = np.concatenate([row.error_m for row in score.matched])
    assert error_m.mean() <= 0.05, "only images without a vehicle are missing"


def test_boxes_tracks_and_video_belong_to_the_same_images(processed: Processed) -> None:
    detections = read_mot_detections(processed.out / "detections.txt")
    tracks = read_mot_tracks(processed.out / "tracks.txt")
    observed = read_track_csv(processed.out / "tracks.csv", SIZE)
    images = round(DURATION_S * FPS)
    assert 1 <= detections.frame[0] <= detections.frame[-1] <= images
    assert set(observed.rows["track_id"]) <= set(tracks.rows["track_id"])
    assert len(observed.rows) <= len(detections.rows)
    video = cv2.VideoCapture(str(processed.out / "annotated.mp4"))
    plain = cv2.VideoCapture(str(processed.film / "video.mp4"))
    drawn = 0
    for k in range(images):
        (there, annotated), (_, image) = video.read(), plain.read()
        assert there
        if k == images - 1:
            drawn = int(np.count_nonzero(cv2.absdiff(annotated, image).max(axis=2) > 60))
    assert not video.read()[0]
    assert drawn > 1000, "boxes, trails and lanes"
    assert "<svg" in (processed.out / "report.html").read_text()


PLUGIN = """
import os, signal
import numpy as np
from geoorbit_ros.core.tables import DETECTION_DTYPE
from geoorbit_ros.storage.mot_text import read_mot_detections

class Again:
    name = "again"
    def __init__(self):
        self.rows = dict(read_mot_detections({detections!r}))
    def warm_up(self, images):
        pass
    def detect(self, stamp_ns, image):
        number = round((stamp_ns - 10**9) * {fps} / 1e9) + 1
        if number == {at}:
            os.kill(os.getpid(), signal.SIGINT)
        return self.rows.get(number, np.empty(0, DETECTION_DTYPE))
"""


def test_what_was_seen_before_ctrl_c_is_kept_and_gone_on_from(
    processed: Processed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, file = tmp_path / "out", tmp_path / "again.py"
    words = ["process", str(processed.film / "video.mp4"), "--out", str(out), "--calibration"]
    words += [str(processed.film / "calibration.csv"), "--model", f"{file}:Again"]
    values = {"detections": str(processed.out / "detections.txt"), "fps": FPS}
    file.write_text(PLUGIN.format(**values, at=160))
    assert main(words) == EXIT_INTERRUPTED
    assert "--resume goes on from there" in capsys.readouterr().err
    assert {path.name for path in out.iterdir()} == {
        *("detections.txt", "tracks.txt", "tracks.csv", "lanes.geojson", "road.png", "report.html")
    }
    part, whole = ((p / "detections.txt").read_text() for p in (out, processed.out))
    assert 0 < len(part) < len(whole)
    assert whole.startswith(part)
    file.write_text(PLUGIN.format(**values, at=0))
    assert main([*words, "--resume"]) == 0
    assert (out / "detections.txt").read_text() == whole
    found, before = (
        read_lane_file(p / "lanes.geojson", processed.datum).lane_map.lanes
        for p in (out, processed.out)
    )
    assert len(found) == len(before)
    assert "not say when" not in (out / "report.html").read_text()
    assert "doesn&#x27;t say when it was made" in (out / "report.html").read_text()


def test_a_camera_is_checked_and_added_to_a_fleet(processed: Processed, tmp_path: Path) -> None:
    fleet, out = tmp_path / "road.yaml", tmp_path / "check"
    film, calibration = processed.film / "video.mp4", processed.film / "calibration.csv"
    words = ["camera", "add", str(film), "--calibration", str(calibration), "--camera-id", "north"]
    words += ["--fleet", str(fleet), "--out", str(out), "--duration", "12"]
    assert main(words) == 0
    camera = load_fleet(fleet)[0].cameras[0]
    assert (camera.id, camera.image_size) == ("north", SIZE)
    assert camera.calibration is not None
    assert camera.datum is not None
    assert (tmp_path / camera.calibration).resolve() == calibration.resolve()
    assert (tmp_path / camera.source).resolve() == film.resolve()
    image = cv2.imread(str(out / "calibration.png"))
    assert image is not None
    assert image.shape == (SIZE[1], SIZE[0], 3)
    assert {path.name for path in out.iterdir()} == {
        *("calibration.png", "tracks.csv", "lanes.geojson", "road.png", "report.html")
    }
    again = [*words[:-3], str(tmp_path / "twice"), *words[-2:]]
    assert main(again) == 2, "a camera of this name is there"
    moved = camera.datum.model_copy(update={"latitude_deg": camera.datum.latitude_deg + 1e-4})
    text = fleet.read_text().replace(f"{camera.datum.latitude_deg}", f"{moved.latitude_deg}")
    fleet.write_text(text.rstrip("\n") + "  # surveyed\n    enabled: false\n")
    assert main([*again[:-1], "3", "--replace"]) == 0
    replaced = load_fleet(fleet)[0].cameras[0]
    assert (replaced.datum, replaced.enabled) == (moved, False), "its map stays where it is"
    assert "# surveyed" in fleet.read_text()


def test_a_camera_is_added_from_a_stream(processed: Processed, tmp_path: Path) -> None:
    fleet, out = tmp_path / "road.yaml", tmp_path / "check"
    calibration = processed.film / "calibration.csv"
    with MjpegServer(Played(processed.film / "video.mp4")) as server:
        words = ["camera", "add", server.address, "--calibration", str(calibration)]
        words += ["--camera-id", "live", "--fleet", str(fleet), "--out", str(out)]
        assert main([*words, "--duration", "6"]) == 0
        assert server.opened == 1, "one look at the camera is enough"
    camera = load_fleet(fleet)[0].cameras[0]
    assert (camera.source, camera.kind, camera.image_size) == (server.address, "stream", SIZE)
    stamps = read_track_csv(out / "tracks.csv", SIZE).stamp_ns
    assert 3.0 < (stamps[-1] - stamps[0]) / 1e9 < 7.0, "the time that passed, not that of the work"


class Played(Sequence[np.ndarray]):
    """The images of a film at the film's pace, as a network camera sends them.

    Read before: OpenCV opens one thing at a time in a process; the stream would wait for itself.
    """

    def __init__(self, film: Path) -> None:
        video = cv2.VideoCapture(str(film))
        self._images = [video.read()[1] for _ in range(round(DURATION_S * FPS))]

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, index: Any) -> Any:
        return self._images[index]

    def __iter__(self) -> Iterator[np.ndarray]:
        clock, began_s = Event(), time.monotonic()
        for k, image in enumerate(self._images):
            clock.wait(max(began_s + k / FPS - time.monotonic(), 0.0))
            yield image


@pytest.mark.parametrize("option", ["--road-image", "--picture"])
def test_the_image_of_the_road_has_a_new_name_and_an_old_one(
    option: str, processed: Processed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image, boxes = tmp_path / "road.png", tmp_path / "det.txt"
    words = ["detect", str(processed.film / "video.mp4"), "--out", str(boxes), "--duration", "2"]
    assert main([*words, option, str(image)]) == 0
    assert cv2.imread(str(image)) is not None
    assert boxes.exists()
    warned = "--picture is now --road-image" in capsys.readouterr().err
    assert warned == (option == "--picture")
