from __future__ import annotations

import csv
import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from made_frames import assert_same, pixel_frames, steady_frames

from geoorbit_ros.core.errors import InputFileError, TableError
from geoorbit_ros.core.tables import (
    FLAG_GROUND_POINT,
    PIXEL_TRACK_DTYPE,
    TRACK_DTYPE,
    Frames,
)
from geoorbit_ros.storage.track_csv import read_track_csv, write_track_csv

HEADER = "id,time,frame_num,class,conf,x,y,w,h"
REAL_DATA = os.environ.get("GEOORBIT_REAL_DATA")
CAMERAS = sorted(Path(REAL_DATA, "us12").glob("*/trajectory.csv")) if REAL_DATA else []


def write(path: Path, *lines: str, header: str = HEADER) -> Path:
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    return path


@settings(deadline=None, max_examples=50)
@given(pixel_frames(min_rows=1))
def test_reading_undoes_writing(tmp_path_factory: pytest.TempPathFactory, frames: Frames) -> None:
    # Boxes of a pixel in the corner would be taken for shares of the image.
    assume(max(np.abs(frames.rows[name]).max() for name in ("x", "y", "width", "height")) > 2.0)
    path = tmp_path_factory.mktemp("csv") / "tracks.csv"
    write_track_csv(path, frames)
    assert_same(read_track_csv(path), frames)


def test_a_small_file_by_hand(tmp_path: Path) -> None:
    path = write(
        tmp_path / "tracks.csv",
        "7,0.0,0,2.0,0.5,100,200,30,40",
        "9,0.0,0,7,0.25,1.5,2.5,0,0",
        "7,0.03336680976,1,2.0,0.5,101,201,30,40",
    )
    frames = read_track_csv(path)
    assert frames.stamp_ns.tolist() == [0, 33_366_810]
    assert frames.offset.tolist() == [0, 2, 3]
    assert frames.rows.tolist() == [
        (100, 200, 30, 40, 0.5, 2, 7, 0),
        (1.5, 2.5, 0, 0, 0.25, 7, 9, FLAG_GROUND_POINT),
        (101, 201, 30, 40, 0.5, 2, 7, 0),
    ]


@settings(deadline=None, max_examples=50)
@given(st.permutations(HEADER.split(",")), st.booleans(), st.sampled_from(("\n", "\r\n")))
def test_layout_of_the_file_does_not_matter(
    tmp_path_factory: pytest.TempPathFactory, order: list[str], marked: bool, end: str
) -> None:
    """Order of columns, further columns, spaces in the header, byte order mark, blank lines."""
    folder = tmp_path_factory.mktemp("csv")
    frames = steady_frames(3, 2, PIXEL_TRACK_DTYPE)
    write_track_csv(folder / "plain.csv", frames)
    with (folder / "plain.csv").open() as file:
        table = list(csv.DictReader(file))
    lines = [", ".join(["note", *order])]
    lines += [",".join(["seen", *(row[name] for name in order)]) + end for row in table]
    mark = "\ufeff" if marked else ""
    (folder / "other.csv").write_bytes((mark + end.join(lines) + end).encode())
    assert_same(read_track_csv(folder / "other.csv"), frames)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**31 - 1), st.integers(0, 10**9 - 1))
def test_times_since_1970_are_exact(
    tmp_path_factory: pytest.TempPathFactory, second: int, nanosecond: int
) -> None:
    """A float64 of seconds is not: it is 200 ns off."""
    path = tmp_path_factory.mktemp("csv") / "tracks.csv"
    write(path, f"1,{second}.{nanosecond:09d},0,2,0.5,1,2,3,4")
    assert read_track_csv(path).stamp_ns.tolist() == [second * 10**9 + nanosecond]


def test_late_times_with_more_digits_than_a_decimal_holds_are_rounded(tmp_path: Path) -> None:
    text = "1700000000.123456789499999999999999999"
    frames = read_track_csv(write(tmp_path / "t.csv", f"1,{text},0,2,0.5,1,2,3,4"))
    assert abs(int(frames.stamp_ns[0]) - Fraction(text) * 10**9) < 240


GOOD = "1,0.5,5,2,.5,1,2,3,4"
FAULTS = [
    (["1,0.5,5,2,.5,nan,2,3,4"], "line 2", "no number"),
    ([GOOD, "", "2,0.5,5,2,.5,1,2,,4"], "line 4", "no number"),
    ([GOOD, "2,0.5,5,2,inf,1,2,3,4"], "line 3", "a score that is no number"),
    ([GOOD, "2,0.5,5,2,.5,1,oops,3,4"], "line 3", "no number"),
    ([GOOD, "2,0.5,5,2,.5,1,2,3"], "line 3", "not 9 values"),
    ([GOOD, "2,0.5,5,2,.5,1,2,3,4,5"], "line 3", "not 9 values"),
    ([GOOD, "2,0.5,5,2,.5,1,2,3,-4"], "line 3", "not above 0"),
    ([GOOD, "2,0.5,5,2,.5,1,2,-3,4"], "line 3", "not above 0"),
    ([GOOD, "2,0.5,5,2,.5,1,2,0,4"], "line 3", "not above 0"),
    ([GOOD, "2,0.5,5,2,.5,1,2,3,0"], "line 3", "not above 0"),
    ([GOOD, "2.5,0.5,5,2,.5,1,2,3,4"], "line 3", "no whole numbers of 32 bits"),
    ([GOOD, "3000000000,0.5,5,2,.5,1,2,3,4"], "line 3", "no whole numbers of 32 bits"),
    ([GOOD, "2,0.5,5.5,2,.5,1,2,3,4"], "line 3", "no whole number"),
    ([GOOD, "2,-0.5,4,2,.5,1,2,3,4"], "", "begin at -0.5 s"),
    ([GOOD, GOOD, "2,1700000000000,6,2,.5,1,2,3,4"], "line 4", "a time that can't be read"),
    ([GOOD, "2,2147483649,6,2,.5,1,2,3,4"], "line 3", "a time that can't be read"),
    ([GOOD, GOOD], "line 3", "an id twice in a frame"),
    ([GOOD, "2,0.4,4,2,.5,1,2,3,4"], "line 3", "not in the order of time"),
    ([GOOD, "2,0.4,6,2,.5,1,2,3,4"], "line 2", "contradict"),
    ([GOOD, "2,0.6,5,2,.5,1,2,3,4"], "line 3", "another time than the rest"),
    ([GOOD, "2,0.5,6,2,.5,1,2,3,4"], "", "the time of the frame before"),
    ([GOOD, "2,0.6,4,2,.5,1,2,3,4"], "line 2", "contradict"),
    ([], "", "no row below the header"),
]


@pytest.mark.parametrize(("lines", "place", "found"), FAULTS)
def test_a_fault_is_named_by_file_line_and_value(
    tmp_path: Path, lines: list[str], place: str, found: str
) -> None:
    path = write(tmp_path / "tracks.csv", *lines)
    with pytest.raises(InputFileError) as caught:
        read_track_csv(path)
    assert caught.value.place == str(path)
    assert place in str(caught.value.found)
    assert found in str(caught.value.found)
    assert "\n" not in str(caught.value)


def test_rows_of_a_frame_may_come_in_any_order(tmp_path: Path) -> None:
    lines = [f"{k},0.5,5,2,.5,{k},2,3,4" for k in (3, 1, 2)]
    frames = read_track_csv(write(tmp_path / "tracks.csv", *lines))
    assert frames.rows["track_id"].tolist() == [3, 1, 2]


def test_control_characters_in_a_file_are_not_printed(tmp_path: Path) -> None:
    lines = [f"1,{k},{k},2,.5,1,2,3,4" for k in range(5000)]
    path = write(tmp_path / "tracks.csv", *lines, "2,9000,9000,2,.5,1,2,\0\x1b[2J,4")
    with pytest.raises(InputFileError, match="line 5002") as caught:
        read_track_csv(path)
    assert str(caught.value).isprintable()


def test_no_file_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="no such file"):
        read_track_csv(tmp_path / "absent.csv")
    with pytest.raises(InputFileError, match="directory"):
        read_track_csv(tmp_path)


def test_a_box_outside_of_the_image_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "tracks.csv", "1,0,0,2,.5,1900,500,60,40")
    assert len(read_track_csv(path, (1920, 1080)).rows) == 1
    with pytest.raises(InputFileError, match=r"wholly outside the image of 1280x720"):
        read_track_csv(path, (1280, 720))


def test_what_the_format_cannot_hold_is_not_written(tmp_path: Path) -> None:
    frames = steady_frames(2, 2, PIXEL_TRACK_DTYPE)
    for name, value in (("x", np.nan), ("width", -1), ("height", 0)):
        rows = frames.rows.copy()
        rows[name][3] = value
        with pytest.raises(TableError, match="row 3"):
            write_track_csv(tmp_path / "t.csv", Frames(frames.stamp_ns, frames.offset, rows))
    with pytest.raises(TableError, match="tracks_px"):
        write_track_csv(tmp_path / "t.csv", steady_frames(2, 2, TRACK_DTYPE))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not CAMERAS, reason="GEOORBIT_REAL_DATA names no folder with us12/")
@pytest.mark.parametrize("path", CAMERAS, ids=lambda path: path.parent.name)
def test_real_cameras_read_as_a_plain_reader_does(path: Path, tmp_path: Path) -> None:
    frames = read_track_csv(path, (1920, 1080))
    with path.open() as file:
        table = list(csv.DictReader(file))
    assert len(frames.rows) == len(table)
    stamp_ns = frames.row_stamp_ns()
    for k in range(0, len(table), 97):
        row, cells = frames.rows[k], table[k]
        assert stamp_ns[k] == round(Fraction(cells["time"]) * 10**9)
        assert (row["track_id"], row["class_id"]) == (int(cells["id"]), float(cells["class"]))
        for field, name in (("x", "x"), ("y", "y"), ("width", "w"), ("height", "h")):
            assert row[field] == np.float32(cells[name])
    write_track_csv(tmp_path / "copy.csv", frames)
    assert_same(read_track_csv(tmp_path / "copy.csv"), frames)
