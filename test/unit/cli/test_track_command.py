"""`geoorbit track`: the tracker's ids in a file; wrong input gets one sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from geoorbit_ros.cli.main import main
from geoorbit_ros.core.tables import DETECTION_DTYPE, FLAG_PREDICTED
from geoorbit_ros.storage.mot_text import read_mot_detections, read_mot_tracks, write_mot
from geoorbit_ros.storage.track_csv import read_track_csv
from geoorbit_ros.tracking.tracker import Tracker

Run = Callable[..., tuple[int, str, str]]
FPS = 25.0


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run the command in this process: exit code, standard output, standard error."""
    monkeypatch.setenv("COLUMNS", "160")

    def call(*words: object) -> tuple[int, str, str]:
        code = main(["track", *(str(word) for word in words)])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.fixture
def boxes(tmp_path: Path) -> Path:
    """Two vehicles for fifty frames; frame 20 to 29 shows the first one only."""
    path = tmp_path / "det.txt"
    frames = []
    for number in range(1, 51):
        rows = np.zeros(1 if 20 <= number < 30 else 2, DETECTION_DTYPE)
        rows["x"], rows["y"] = np.array([[50.0 + 9.0 * number, 900.0 - 8.0 * number], [200, 300]])[
            :, : len(rows)
        ]
        rows["width"], rows["height"], rows["score"], rows["class_id"] = 80.0, 60.0, 0.8, 2
        frames.append((number, rows))
    write_mot(path, frames)
    return path


def test_the_file_holds_the_observed_boxes_of_the_tracker(
    boxes: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "tracks.txt"
    code, text, err = run("--detections", boxes, "--fps", FPS, "--out", out)
    assert (code, err) == (0, "")
    assert "90 detections in 50 frames became 2 tracks with 90 boxes" in text
    table = read_mot_detections(boxes)
    tracker, expected = Tracker(), []
    for stamp_ns, (number, rows) in zip(table.frames(FPS).stamp_ns.tolist(), table, strict=True):
        tracks = tracker.update(stamp_ns, rows)
        tracks = tracks[(tracks["flags"] & FLAG_PREDICTED) == 0]
        expected += [(number, i) for i in tracks["track_id"].tolist()]
    found = read_mot_tracks(out)
    pairs = [(number, i) for number, rows in found for i in rows["track_id"].tolist()]
    assert pairs == expected
    assert {i for _, i in pairs} == {1, 2}


def test_a_csv_is_what_geoorbit_lanes_reads(boxes: Path, tmp_path: Path, run: Run) -> None:
    text, csv = tmp_path / "tracks.txt", tmp_path / "tracks.csv"
    assert run("--detections", boxes, "--fps", FPS, "--out", text)[0] == 0
    assert run("--detections", boxes, "--fps", FPS, "--out", csv)[0] == 0
    frames, table = read_track_csv(csv), read_mot_tracks(text)
    assert frames.rows["track_id"].tolist() == table.rows["track_id"].tolist()
    assert frames.rows["x"] == pytest.approx(table.rows["x"], abs=2e-3)
    assert frames.stamp_ns.tolist() == table.frames(FPS).stamp_ns.tolist()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--fps", "0"), ("frame rate", "found 0")),
        (("--max-gap-s", "-1"), ("max_gap_s", "-1")),
        (("--min-score", "2"), ("score", "from 0 to 1")),
        (("--image-size", "big"), ("--image-size", "WIDTHxHEIGHT")),
    ],
)
def test_wrong_options_are_one_sentence_and_leave_no_file(
    boxes: Path, tmp_path: Path, run: Run, options: tuple[str, ...], words: tuple[str, ...]
) -> None:
    out = tmp_path / "tracks.txt"
    code, text, err = run("--detections", boxes, "--out", out, *options)
    assert (code, text) == (2, "")
    assert err.count("\n") == 1
    assert all(word in err for word in words), err
    assert not out.exists()


def test_wrong_files_are_named(boxes: Path, tmp_path: Path, run: Run) -> None:
    code, _, err = run("--detections", tmp_path / "nowhere.txt", "--out", tmp_path / "t.txt")
    assert (code, err.count("\n")) == (2, 1)
    assert "nowhere.txt" in err
    code, _, err = run("--detections", boxes, "--out", boxes)
    assert (code, err.count("\n")) == (2, 1)
    assert "the input" in err
    boxes.write_text("1,-1,5,5,5,5,0.9,2,-1,-1\n2,-1,5,5\n")
    code, _, err = run("--detections", boxes, "--out", tmp_path / "t.txt")
    assert (code, err.count("\n")) == (2, 1)
    assert "det.txt, line 2" in err
    assert not (tmp_path / "t.txt").exists()
