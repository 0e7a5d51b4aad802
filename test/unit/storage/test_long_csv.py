"""Long CSV files are read piece by piece, to the same boxes and remarks as at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geoorbit_ros.core.frame_spool import FrameSpool
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.storage.tracks import long_csv
from geoorbit_ros.storage.tracks.cleaning import ReadOptions
from geoorbit_ros.storage.tracks.long_csv import read_clean, spool_tracks
from geoorbit_ros.storage.tracks.reader import read_tracks

HEADER = "id,time,frame_num,class,conf,x,y,w,h"
OPTIONS = ReadOptions(default_size=(1920, 1080))


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small files are long ones, and every frame is cut by the pieces somewhere."""
    monkeypatch.setattr(long_csv, "LEAST_BYTES", 0)
    monkeypatch.setattr(long_csv, "PIECE_BYTES", 1000)
    monkeypatch.setattr(long_csv, "SPOOLED_ROWS", 10)


def lines(start_s: float = 0.0) -> list[str]:
    random = np.random.default_rng(7)
    found = []
    for frame in range(120):
        for track in random.permutation(6)[: random.integers(1, 6)]:
            x, y = random.uniform(100, 900, 2)
            size = (0, 0) if track == 5 else random.uniform(20, 60, 2)
            found.append(
                f"{track},{start_s + frame / 30:.9f},{frame},{(2, 7, 0)[track % 3]},"
                f"{random.random():.4f},{x:.2f},{y:.3f},{size[0]},{size[1]}"
            )
    return found


def written(path: Path, rows: list[str], header: str = HEADER) -> Path:
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def same(a: Frames | FrameSpool, b: Frames) -> bool:
    a = a if isinstance(a, Frames) else a.part(0, len(a))
    return (
        a.rows.tobytes() == b.rows.tobytes()
        and a.stamp_ns.tolist() == b.stamp_ns.tolist()
        and a.offset.tolist() == b.offset.tolist()
    )


@pytest.mark.parametrize("start_s", [0.0, 1.75e9])
def test_a_clean_file_gives_the_same_boxes_from_pieces(tmp_path: Path, start_s: float) -> None:
    path = written(tmp_path / "tracks.csv", lines(start_s))
    found = read_clean(path, OPTIONS)
    assert found is not None
    frames, report = read_tracks(path, OPTIONS)
    assert same(found[0], frames)
    assert found[1] == report
    assert found[0].row_count == len(lines()) == report.total


def test_numbers_as_other_programs_write_them(tmp_path: Path) -> None:
    rows = [line.split(",") for line in lines()]
    for row in rows:
        row[1] = repr(float(row[1]) / 3)
        row[3] += ".0"
        row[4] = "1"
        row[7:] = [str(round(float(value))) for value in row[7:]]
    path = written(tmp_path / "tracks.csv", [",".join(row) for row in rows])
    found = read_clean(path, OPTIONS)
    assert found is not None
    assert same(found[0], read_tracks(path, OPTIONS)[0])


def changed(column: int, text: str, line: int = 200) -> list[str]:
    rows = lines()
    cells = rows[line].split(",")
    cells[column] = text
    return [*rows[:line], ",".join(cells), *rows[line + 1 :]]


ODD = {
    "no id": changed(0, ""),
    "id of a detection": changed(0, "-1"),
    "id that is a word": changed(0, "car7"),
    "time that is a word": changed(1, "soon"),
    "time before": changed(1, "0.0"),
    "time far ahead": changed(1, "1e6", len(lines()) - 1),
    "frame that is no number": changed(2, "1.5"),
    "frame before": changed(2, "0"),
    "unknown class": changed(3, "spaceship"),
    "class that is no number": changed(3, "nan"),
    "score beyond": changed(4, "1.5"),
    "no score": changed(4, ""),
    "no place": changed(5, "nan"),
    "outside": changed(5, "5000"),
    "flat box": changed(7, "0"),
    "turned box": changed(7, "-20"),
    "a value too few": [*lines()[:50], "1,2,3", *lines()[50:]],
    "a comment": [*lines()[:50], "# here", *lines()[50:]],
    "a row twice": [*lines()[:50], lines()[49], *lines()[49:]],
    "not in order": lines()[::-1],
    "shares of the image": ["1,0.0,0,2,0.5,0.5,0.25,0.1,0.1", "1,0.1,1,2,0.5,0.6,0.25,0.1,0.1"],
    "milliseconds": [
        ",".join([c[0], f"{int(c[2]) * 33}", *c[2:]]) for c in (s.split(",") for s in lines())
    ],
    "marks between thousands": [
        ",".join([*c[:5], "1.706" if k % 9 == 0 else "976", *c[6:]])
        for k, c in enumerate(s.split(",") for s in lines())
    ],
}


@pytest.mark.parametrize("what", ODD)
def test_a_file_with_anything_odd_is_read_at_once(tmp_path: Path, what: str) -> None:
    path = written(tmp_path / "tracks.csv", ODD[what])
    assert read_clean(path, OPTIONS) is None
    frames, report = read_tracks(path, OPTIONS)
    found, said = spool_tracks(path, OPTIONS)
    assert same(found, frames)
    assert said == report


@pytest.mark.parametrize("seed", range(8))
def test_what_is_read_in_pieces_is_what_is_read_at_once(tmp_path: Path, seed: int) -> None:
    """Whatever a row has: it is read to the same boxes and remarks, or left to the other reader."""
    random = np.random.default_rng(seed)
    words = ["", "0", "1", "-1", "0.5", "7", "1.706", "2000", "1e3", " 3 ", "nan", "+4", "0x1f"]
    for k in range(40):
        rows = [row.split(",") for row in lines()]
        for _ in range(random.integers(1, 3)):
            rows[random.integers(len(rows))][random.integers(9)] = str(random.choice(words))
        path = written(tmp_path / f"{k}.csv", [",".join(row) for row in rows])
        found = read_clean(path, OPTIONS)
        if found is not None:
            frames, report = read_tracks(path, OPTIONS)
            assert same(found[0], frames)
            assert found[1] == report


def test_other_columns_and_options_are_for_the_other_reader(tmp_path: Path) -> None:
    path = written(tmp_path / "tracks.csv", lines())
    assert read_clean(path, ReadOptions(fps=30.0)) is None
    assert read_clean(path, ReadOptions(columns={"x": "x"})) is None
    other = written(tmp_path / "other.csv", lines(), HEADER.replace("conf", "score"))
    assert read_clean(other, OPTIONS) is None


@pytest.mark.parametrize("column", [0, 2, 5])
def test_hexadecimal_numbers_are_none_wherever_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, column: int
) -> None:
    monkeypatch.setattr(long_csv, "HEAD_BYTES", 1000)
    rows = [f"{k % 3},{k / 30:.6f},{k},2,0.9,{100 + k},200,40,30" for k in range(200)]
    cells = rows[150].split(",")
    cells[column] = f"0x{int(cells[column]):x}"
    file = written(tmp_path / "tracks.csv", [*rows[:150], ",".join(cells), *rows[151:]])
    assert read_clean(file, OPTIONS) is None
    (frames, report), (plain, expected) = spool_tracks(file, OPTIONS), read_tracks(file, OPTIONS)
    assert same(frames, plain)
    assert list(report.sentences()) == list(expected.sentences())
