"""MOTChallenge text: what is written is read back; what can't be used is named by its line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geoorbit_ros.core.errors import InputFileError, ParameterError, TableError
from geoorbit_ros.core.tables import DETECTION_DTYPE, PIXEL_TRACK_DTYPE
from geoorbit_ros.storage.mot_text import read_mot_detections, read_mot_tracks, write_mot

pixels = st.floats(-1e4, 1e4, width=32)
sizes = st.floats(0.0078125, 5e3, width=32)
scores = st.floats(0.0, 1.0, width=32)


@st.composite
def detection_frames(draw: st.DrawFn) -> list[tuple[int, np.ndarray]]:
    numbers = sorted(draw(st.sets(st.integers(1, 10**6), min_size=1, max_size=5)))
    box = st.tuples(pixels, pixels, sizes, sizes, scores, st.integers(-1, 90))
    tables = st.lists(box, min_size=1, max_size=4)
    return [(n, np.array(draw(tables), DETECTION_DTYPE)) for n in numbers]


@settings(deadline=None, max_examples=50)
@given(detection_frames())
def test_reading_undoes_writing(
    tmp_path_factory: pytest.TempPathFactory, frames: list[tuple[int, np.ndarray]]
) -> None:
    path = tmp_path_factory.mktemp("mot") / "det.txt"
    assert write_mot(path, frames) == sum(len(rows) for _, rows in frames)
    table = read_mot_detections(path)
    assert table.frame.tolist() == [number for number, _ in frames]
    for (number, rows), (_, expected) in zip(table, frames, strict=True):
        assert number in table.frame
        for name in ("x", "y", "width", "height"):
            assert rows[name] == pytest.approx(expected[name], abs=2e-3)
        assert rows["score"] == pytest.approx(expected["score"], rel=1e-5)
        assert rows["class_id"].tolist() == expected["class_id"].tolist()


def test_a_track_file_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "tracks.txt"
    rows = np.zeros(1, PIXEL_TRACK_DTYPE)
    rows[0] = (100.0, 50.0, 20.0, 10.0, 0.5, 7, 12, 0)
    write_mot(path, [(3, rows), (4, rows[:0]), (9, rows)])
    line = "12,90.000,45.000,20.000,10.000,0.5,7,-1,-1"
    assert path.read_text() == f"3,{line}\n9,{line}\n"
    table = read_mot_tracks(path)
    assert table.rows.tolist() == [rows[0].tolist()] * 2
    assert table.frames(25.0).stamp_ns.tolist() == [80_000_000, 320_000_000]


def test_ground_truth_sorted_by_id_is_read_by_frame(tmp_path: Path) -> None:
    path = tmp_path / "gt.txt"
    path.write_text("1,1,0,0,2,2,1\n3,1,4,0,2,2,1\n1,2,9,9,2,2,1\n")
    table = read_mot_tracks(path)
    assert table.frame.tolist() == [1, 3]
    assert table.rows["track_id"].tolist() == [1, 2, 1]
    assert table.rows["class_id"].tolist() == [-1] * 3


GOOD = "1,-1,10,10,5,5,0.9,2,-1,-1\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ("no line with a box",)),
        ("\n \n", ("no line with a box",)),
        ("a\0b", ("binary",)),
        ("frame,id\n", ("line 1", "2 values", "7 to 10")),
        (GOOD + "2,-1,10,10\n", ("line 2", "4 values", "10 as in the first line")),
        (GOOD + "2,-1,10,nan,5,5,0.9,2,-1,-1\n", ("line 2", "'y'", "'nan'", "finite")),
        (GOOD + "2,-1,10,ten,5,5,0.9,2,-1,-1\n", ("line 2", "'y'", "'ten'", "finite")),
        (GOOD + "\n0,-1,10,10,5,5,0.9,2,-1,-1\n", ("line 3", "'frame'", "'0'", "from 1")),
        (GOOD + "1.5,-1,10,10,5,5,0.9,2,-1,-1\n", ("line 2", "'frame'", "whole number")),
        (GOOD + "2,-1,10,10,0,5,0.9,2,-1,-1\n", ("line 2", "'w'", "above 0")),
        (GOOD + "2,-1,1e9,10,5,5,0.9,2,-1,-1\n", ("line 2", "'x'", "pixels")),
        (GOOD + "2,-1,10,10,5,5,37.5,2,-1,-1\n", ("line 2", "'conf'", "'37.5'", "0 to 1")),
        (GOOD + "2,-1,10,10,5,5,0.9,2.5,-1,-1\n", ("line 2", "'class'", "class number")),
    ],
)
def test_bad_input_is_one_sentence(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    path = tmp_path / "det.txt"
    path.write_text(text)
    with pytest.raises(InputFileError) as caught:
        read_mot_detections(path)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in ("det.txt", *words)), str(caught.value)


def test_tracks_need_ids_that_are_unique_in_a_frame(tmp_path: Path) -> None:
    path = tmp_path / "tracks.txt"
    path.write_text("1,4,10,10,5,5,0.9,2,-1,-1\n1,4,30,10,5,5,0.9,2,-1,-1\n")
    with pytest.raises(InputFileError, match=r"line 2, column 'id': .*once in a frame"):
        read_mot_tracks(path)
    path.write_text(GOOD)
    with pytest.raises(InputFileError, match=r"line 1, column 'id': .*not negative"):
        read_mot_tracks(path)


def test_a_missing_file_and_an_impossible_rate_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="no such file"):
        read_mot_detections(tmp_path / "nowhere.txt")
    path = tmp_path / "det.txt"
    path.write_text(GOOD)
    for fps in (0.0, -1.0, float("nan"), 1e6):
        with pytest.raises(ParameterError, match="frame rate"):
            read_mot_detections(path).frames(fps)


def test_a_failed_write_leaves_no_file(tmp_path: Path) -> None:
    path = tmp_path / "det.txt"
    good = np.zeros(1, DETECTION_DTYPE)
    good["width"] = good["height"] = 1.0
    bad = good.copy()
    bad["x"] = np.nan
    for frames in ([(1, good), (2, bad)], [(2, good), (2, good)], [(0, good)]):
        with pytest.raises(TableError):
            write_mot(path, frames)
        assert list(tmp_path.iterdir()) == []
