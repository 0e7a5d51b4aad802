"""Files of tracked boxes as people have them: used, repaired or refused, never silently."""

from __future__ import annotations

import bz2
import json
import re
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from geoorbit_ros.core.errors import GeoOrbitError, InputFileError, ParameterError
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.core.tables import FLAG_GROUND_POINT, Frames
from geoorbit_ros.storage.tracks.classes import class_number, class_table
from geoorbit_ros.storage.tracks.cleaning import ReadOptions
from geoorbit_ros.storage.tracks.reader import read_tracks

HEADER = "id,time,frame_num,class,conf,x,y,w,h"
FPS = 10.0
SIZE = (640, 480)
Row = tuple[int, float, int, float, float, float, float, float, float]


def made_rows(frames: int = 12, vehicles: int = 3) -> list[Row]:
    """Vehicles side by side that drive downwards in the image."""
    return [
        (v + 1, k / FPS, k, 2, 0.5 + 0.1 * v, 100.0 + 150 * v, 50.0 + 20 * k, 60.0, 40.0)
        for k in range(frames)
        for v in range(vehicles)
    ]


def csv(rows: Sequence[Sequence[object]], header: str = HEADER) -> str:
    return "\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n"


def changed(at: int, **cells: object) -> str:
    """The CSV file with other cells in row `at`."""
    names = HEADER.split(",")
    rows = [list(row) for row in made_rows()]
    for name, value in cells.items():
        rows[at][names.index(name)] = value  # type: ignore[call-overload]
    return csv([tuple(row) for row in rows])


def each(make: Callable[[dict[str, float]], Sequence[object]], header: str = HEADER) -> str:
    """The CSV file with every row made anew from its cells."""
    names = HEADER.split(",")
    lines = [",".join(map(str, make(dict(zip(names, row, strict=True))))) for row in made_rows()]
    return "\n".join([header, *lines]) + "\n"


def read(folder: Path, content: str | bytes, **options: object) -> tuple[Frames, InputReport]:
    path = folder / "tracks"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_tracks(path, ReadOptions(**options))  # type: ignore[arg-type]


def said(report: InputReport) -> str:
    return "; ".join(report.sentences())


def assert_same(found: Frames, expected: Frames, but: tuple[str, ...] = ()) -> None:
    assert np.array_equal(found.stamp_ns, expected.stamp_ns)
    for k in range(len(expected)):
        a, b = (np.sort(f.frame(k), order="track_id") for f in (found, expected))
        for name in expected.rows.dtype.names or ():
            if name not in but:
                assert a[name] == pytest.approx(b[name], abs=1e-4), name


WHOLE_MARKS = {
    "points": lambda v: f"{v:,}".replace(",", "."),
    "apostrophes": lambda v: f"{v:,}".replace(",", "'"),
    "narrow blanks": lambda v: f"{v:,}".replace(",", "\u202f"),
    "blanks that hold": lambda v: f"{v:,}".replace(",", "\u00a0"),
}


@pytest.mark.parametrize("shape", WHOLE_MARKS.values(), ids=WHOLE_MARKS)
def test_whole_numbers_with_marks_are_whole(tmp_path: Path, shape: Callable[[int], str]) -> None:
    """A file without any decimals: 976 stands beside 1.706."""
    rows = [(row[0], row[2], 2, int(row[5]) + 700, int(row[6]), 60, 40) for row in made_rows()]
    plain, _ = read(tmp_path, csv(rows, "id,frame,class,x,y,w,h"), fps=FPS, image_size=(1920, 1080))
    lines = [";".join([*map(str, r[:3]), shape(r[3]), *map(str, r[4:])]) for r in rows]
    marked = "\n".join(["id;frame;class;x;y;w;h", *lines]) + "\n"
    found, report = read(tmp_path, marked, fps=FPS, image_size=(1920, 1080))
    assert_same(found, plain)
    assert report.left_out == 0


def test_three_decimals_are_decimals(tmp_path: Path) -> None:
    rows = [
        (row[0], f"{row[1] + 1:.3f}", 2, f"{row[5] + 0.125:.3f}", 50, 60, 40) for row in made_rows()
    ]
    frames, report = read(tmp_path, csv(rows, "id,time,class,x,y,w,h"))
    assert "marks" not in said(report)
    assert frames.rows["x"].max() < 500
    assert frames.stamp_ns[0] == 10**9


@pytest.mark.parametrize("word", ["nan", "NaN", "None", "null", "NA", "", "-1"])
def test_what_is_no_id_in_any_language_is_left_out(tmp_path: Path, word: str) -> None:
    frames, report = read(tmp_path, changed(4, id=word), image_size=SIZE)
    assert len(frames.rows) == 35
    assert set(frames.rows["track_id"].tolist()) == {1, 2, 3}
    assert "1 of 36 boxes left out: no id" in said(report)


@pytest.mark.parametrize("score", ["85", "8.5", "5000", "-1", "1.7e22"])
def test_one_odd_score_says_nothing_of_the_scale(tmp_path: Path, clean: Frames, score: str) -> None:
    frames, report = read(tmp_path, changed(4, conf=score), image_size=SIZE)
    assert_same(frames, clean, but=("score",))
    assert np.sum(np.abs(frames.rows["score"] - clean.rows["score"]) > 1e-6) == 1
    assert "1 of 36 boxes repaired: a score outside of 0 to 1" in said(report)


def test_times_of_json_count(tmp_path: Path, clean: Frames) -> None:
    rows = json.loads(SUPERVISION_JSON)
    timed = [row | {"time": row["frame_index"] / FPS} for row in rows]
    for content in (timed, [{k: v for k, v in r.items() if k != "frame_index"} for r in timed]):
        frames, report = read(tmp_path, json.dumps(content), fps=99.0, image_size=SIZE)
        assert_same(frames, clean)
        assert "--fps is not used" in said(report)


def test_a_time_that_can_not_be_read_is_shown_and_frame_numbers_count(
    tmp_path: Path, clean: Frames
) -> None:
    coded = each(lambda d: [d["id"], f"00:00:0{int(d['frame_num'])}:0x", *list(d.values())[2:]])
    with pytest.raises(InputFileError, match=r"a time that can't be read .'00:00:00:0x'"):
        read(tmp_path, coded, image_size=SIZE)
    frames, report = read(tmp_path, coded, fps=FPS, image_size=SIZE)
    assert_same(frames, clean)
    assert "no time can be read; the frame numbers and the rate count" in said(report)


@pytest.mark.parametrize(("between", "marks"), [(";", str.maketrans(",.", ".,")), (",", {})])
def test_marks_between_thousands_are_no_decimals(
    tmp_path: Path, between: str, marks: dict[int, int]
) -> None:
    """1.275 is 1275 where decimals have commas; 1,275 in quotes where they have points."""
    rows = [[*row[:5], row[5] + 900, *row[6:]] for row in made_rows()]
    plain, _ = read(tmp_path, csv(rows), image_size=(1920, 1080))
    grouped = [
        [*(str(v).translate(marks) for v in row[:5]), f'"{row[5]:,.0f}"'.translate(marks)]
        + [str(v).translate(marks) for v in row[6:]]
        for row in rows
    ]
    lines = [HEADER.replace(",", between), *(between.join(row) for row in grouped)]
    found, report = read(tmp_path, "\n".join(lines) + "\n", image_size=(1920, 1080))
    assert_same(found, plain)
    assert "numbers have marks between thousands: 1" in said(report)


@pytest.fixture
def clean(tmp_path: Path) -> Frames:
    frames, report = read(tmp_path, csv(made_rows()), image_size=SIZE)
    assert said(report) == ""
    assert len(frames.rows) == 36
    return frames


SPELLINGS: dict[str, str | bytes] = {
    "blank lines": csv(made_rows()).replace("\n", "\n\n"),
    "lines of blanks": csv(made_rows()).replace("\n", "\n   \n"),
    "commas at the end of lines": csv(made_rows()).replace("\n", ",\n"),
    "commas at the end of rows": HEADER + csv(made_rows())[len(HEADER) :].replace("\n", ",\n")[1:],
    "Windows lines": csv(made_rows()).replace("\n", "\r\n"),
    "old Mac lines in the header": "\ufeff" + csv(made_rows()),
    "UTF-16": csv(made_rows()).encode("utf-16"),
    "UTF-16 without a mark": csv(made_rows()).encode("utf-16-le"),
    "UTF-16, big end first": csv(made_rows()).encode("utf-16-be"),
    "tabs": csv(made_rows()).replace(",", "\t"),
    "semicolons": csv(made_rows()).replace(",", ";"),
    "decimal commas": csv(made_rows()).replace(",", ";").replace(".", ","),
    "a comment before the header": "# by a tracker\n" + csv(made_rows()),
    "comments between rows": csv(made_rows()).replace("\n2,", "\n# pause\n2,", 1),
    "blanks around values": csv(made_rows()).replace(",", " , "),
    "quotes": each(lambda d: [f'"{v}"' for v in d.values()]),
    "columns in another order": each(
        lambda d: list(d.values())[::-1], ",".join(HEADER.split(",")[::-1])
    ),
    "more columns": each(lambda d: [*d.values(), "note"], HEADER + ",remark"),
    "capitals in the header": csv(made_rows(), HEADER.upper()),
    "units in the header": each(
        lambda d: list(d.values()), "id,time [s],frame_num,class,conf,x (px),y (px),w (px),h (px)"
    ),
    "a line for Excel above the header": "sep=,\n" + csv(made_rows()),
    "blanks between the values": csv(made_rows()).replace(",", "  "),
    "line ends of old Macs": csv(made_rows()).replace("\n", "\r"),
    "a comment of two lines in quotes": each(
        lambda d: [*d.values(), '"seen\nat noon"'], HEADER + ",remark"
    ),
    "ids as floats": each(lambda d: [f"{d['id']:.1f}", *list(d.values())[1:]]),
    "no frame numbers": each(
        lambda d: [v for k, v in d.items() if k != "frame_num"], "id,time,class,conf,x,y,w,h"
    ),
    "corners": each(
        lambda d: [
            d["id"], d["time"], d["class"], d["conf"], d["x"] - d["w"] / 2, d["y"] - d["h"] / 2,
            d["x"] + d["w"] / 2, d["y"] + d["h"] / 2,
        ],
        "track_id,timestamp,class_id,score,x1,y1,x2,y2",
    ),
    "upper left corner and size": each(
        lambda d: [
            d["id"], d["time"], d["class"], d["conf"],
            d["x"] - d["w"] / 2, d["y"] - d["h"] / 2, d["w"], d["h"],
        ],
        "id,time,class,conf,left,top,width,height",
    ),
}  # fmt: skip


@pytest.mark.parametrize("content", SPELLINGS.values(), ids=SPELLINGS)
def test_any_spelling_of_the_same_rows_gives_the_same_boxes(
    tmp_path: Path, clean: Frames, content: str | bytes
) -> None:
    frames, report = read(tmp_path, content, image_size=SIZE)
    assert_same(frames, clean)
    assert said(report) == ""


START = datetime(2024, 5, 1, 8, 0, tzinfo=UTC)
TIMES: dict[str, tuple[Callable[[float], object], float, str]] = {
    "milliseconds": (lambda t: round(1000 * t), 0.0, "in milliseconds"),
    "milliseconds with decimals": (
        lambda t: f"{1000 * t + 33.366809:.6f}",
        0.033366809,
        "in milliseconds",
    ),
    "microseconds": (lambda t: f"{1e6 * t:.1f}", 0.0, "in microseconds"),
    "nanoseconds": (lambda t: round(1e9 * t), 0.0, "in nanoseconds"),
    "milliseconds since 1970": (lambda t: round(1000 * (1.7e9 + t)), 1.7e9, "in milliseconds"),
    "microseconds since 1970": (lambda t: round(1e6 * (1.7e9 + t)), 1.7e9, "in microseconds"),
    "nanoseconds since 1970": (lambda t: round(1e9 * t) + 17 * 10**17, 1.7e9, "in nanoseconds"),
    "seconds since 1970": (lambda t: f"{1.7e9 + t:.1f}", 1.7e9, ""),
    "ISO 8601": (lambda t: (START + timedelta(seconds=t)).isoformat(), START.timestamp(), ""),
    "ISO 8601 with Z": (
        lambda t: (START + timedelta(seconds=t)).isoformat().replace("+00:00", "Z"),
        START.timestamp(),
        "",
    ),
    "a date without a zone": (
        lambda t: (START + timedelta(seconds=t)).strftime("%Y-%m-%d %H:%M:%S.%f"),
        START.timestamp(),
        "as UTC",
    ),
    "a date of a spreadsheet": (
        lambda t: (START + timedelta(seconds=t)).strftime("%d.%m.%Y %H:%M:%S.%f"),
        START.timestamp(),
        "as UTC",
    ),
    "a date and a time of twelve hours": (
        lambda t: (START + timedelta(seconds=t)).strftime("%m/%d/%Y %I:%M:%S.%f %p"),
        START.timestamp(),
        "as UTC",
    ),
    "a time of day": (lambda t: f"08:59:{58.0 + t:06.3f}", 32_398.0, "no date"),
    "times around midnight": (
        lambda t: (datetime(2026, 1, 1, 23, 59, 59, 600_000) + timedelta(seconds=t)).strftime(
            "%H:%M:%S.%f"
        ),
        86_399.6,
        "no date",
    ),
    "minutes and seconds around the hour": (
        lambda t: f"{int(59 + (59.0 + t) // 60) % 60}:{(59.0 + t) % 60:04.1f}", 3599.0, "no date"),
    "minutes and seconds": (lambda t: f"3:{7.0 + t:04.1f}", 187.0, "no date"),
    "before zero": (lambda t: t - 5.0, 0.0, "begin at -5 s"),
}  # fmt: skip


@pytest.mark.parametrize(("write", "start_s", "remark"), TIMES.values(), ids=TIMES)
def test_times_in_any_unit_are_the_same_times(
    tmp_path: Path, clean: Frames, write: Callable[[float], object], start_s: float, remark: str
) -> None:
    content = each(lambda d: [d["id"], write(d["time"]), *list(d.values())[2:]])
    frames, report = read(tmp_path, content)
    assert frames.stamp_ns - round(start_s * 1e9) == pytest.approx(clean.stamp_ns, abs=1)
    assert remark in said(report)
    assert bool(remark) == bool(said(report))


def test_two_recordings_in_one_file_are_doubted_and_rows_written_twice_are_not(
    tmp_path: Path,
) -> None:
    header = "id,time,class,conf,x,y,w,h"

    def recording(shift: int) -> list[tuple[float, ...]]:
        return [
            (k, 0.1 * n, 2, 0.9, 100 + 30 * n + 200 * ((k + shift) % 5), 60 + 90 * k, 20, 20)
            for n in range(30)
            for k in range(5)
        ]

    both = csv([*recording(0), *recording(2)], header)
    assert "several recordings" in said(read(tmp_path, both)[1])
    twice = csv([*recording(0), *recording(0)], header)
    assert "several recordings" not in said(read(tmp_path, twice)[1])


def test_options_that_say_nothing_here_are_named(tmp_path: Path, clean: Frames) -> None:
    frames, report = read(tmp_path, csv(made_rows()), fps=5.0)
    assert_same(frames, clean)
    assert "--fps is not used: the file has times" in said(report)
    mot = "\n".join(f"{k},1,100,100,40,30,0.9,-1,-1,-1" for k in range(1, 20))
    _, report = read(tmp_path, mot, fps=5.0, columns={"id": "veh"})
    assert "--columns is not used" in said(report)
    assert "--fps" not in said(report)


def test_a_class_named_twice_is_refused() -> None:
    with pytest.raises(ParameterError, match="class 2 twice"):
        class_table("2=car,3=bus,2=truck")


def test_one_wrong_time_is_left_out_and_does_not_stretch_the_recording(
    tmp_path: Path,
) -> None:
    rows = [(k % 7, 0.1 * k, 2, 0.9, 50 + k, 60, 20, 20) for k in range(400)]
    for wrong in (99999.0, 1716537600.0):
        bad = [(*row[:1], wrong, *row[2:]) if k == 100 else row for k, row in enumerate(rows)]
        frames, report = read(tmp_path, csv(bad, "id,time,class,conf,x,y,w,h"))
        assert len(frames) == 399
        assert frames.stamp_ns[-1] == pytest.approx(39.9e9, abs=2)
        assert "1 of 400 boxes left out: a time far from all others" in said(report)


def test_upper_left_corners_go_before_places_in_the_world(tmp_path: Path, clean: Frames) -> None:
    """MOTChallenge's own header has both; another common one has xmin, ymin, width, height."""
    for header in (
        "id,time,frame,class,conf,bb_left,bb_top,bb_width,bb_height,x,y,z",
        "id,time,frame,class,conf,xmin,ymin,width,height,a,b,c",
    ):
        corner = each(
            lambda d: [
                *list(d.values())[:5], d["x"] - d["w"] / 2, d["y"] - d["h"] / 2,
                d["w"], d["h"], -1, -1, -1,
            ],
            header,
        )  # fmt: skip
        assert_same(read(tmp_path, corner, image_size=SIZE)[0], clean)


@pytest.mark.parametrize(
    "text",
    [
        '{"data": {"detections": []}, "metadata": null}',
        '{"data": {"detections": [{"x": 1}]}, "metadata": null}',
        '{"data": {"detections": [{"x": 1}]}, "metadata": {"video": [1]}}',
        '{"data": {"detections": [{"x": 1, "occurrence": 1e300}]}, "metadata": {"vid": {}}}',
        '{"data": {"detections": [{"x": %s}]}, "metadata": {"video": {"width": Infinity}}}'
        % ("9" * 400),
        "[" * 100_000,
    ],
)
def test_json_that_is_odd_inside_is_refused_in_one_sentence(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputFileError):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("name", "per_second"),
    [
        *(("time [ms]", 1e3), ("Time (milliseconds)", 1e3), ("t/ms", 1e3), ("time_us", 1e6)),
        *(("timestamp [ns]", 1e9), ("time (s)", 1.0), ("Time [seconds]", 1.0)),
    ],
)
def test_the_unit_in_a_columns_name_is_read_also_where_the_size_says_another(
    tmp_path: Path, clean: Frames, name: str, per_second: float
) -> None:
    """A hundred times slower, so that the size of the steps says another unit."""
    header = HEADER.replace("time", name).replace(",frame_num", "")
    slow = each(
        lambda d: [
            v * 100 * per_second if k == "time" else v for k, v in d.items() if k != "frame_num"
        ],
        header,
    )
    columns = {"time": name} if name == "t/ms" else {}
    frames, report = read(tmp_path, slow, columns=columns)
    assert frames.stamp_ns == pytest.approx(100 * clean.stamp_ns, abs=1)
    assert "by its size" not in said(report)


@pytest.mark.parametrize("first", [46_356.375, 0.375])
def test_days_of_a_spreadsheet_are_read_as_times(
    tmp_path: Path, clean: Frames, first: float
) -> None:
    """Half past eight in the morning, with a date and without."""
    header = HEADER.replace(",frame_num", "")
    days = each(
        lambda d: [
            f"{first + v / 86_400:.12f}" if k == "time" else v
            for k, v in d.items()
            if k != "frame_num"
        ],
        header,
    )
    frames, report = read(tmp_path, days)
    since = frames.stamp_ns - frames.stamp_ns[0]
    assert since == pytest.approx(clean.stamp_ns - clean.stamp_ns[0], abs=20_000)
    assert "days, as spreadsheets count them" in said(report)


def test_columns_can_be_named_by_any_of_their_usual_names(tmp_path: Path, clean: Frames) -> None:
    content = each(
        lambda d: [1000 * v if k == "time" else v for k, v in d.items()],
        HEADER.replace("time", "when").replace("frame_num", "image"),
    )
    columns = {"time_ms": "when", "frame_num": "image"}
    frames, report = read(tmp_path, content, columns=columns)
    assert_same(frames, clean)
    assert said(report) == ""


def test_all_columns_that_are_missing_are_told_at_once(tmp_path: Path) -> None:
    with pytest.raises(InputFileError) as raised:
        read(tmp_path, csv(made_rows(), "a,b,c,d,e,f,g,h,i"))
    for words in ("says when", "ids", "boxes", "time=NAME or frame=NAME", "id=NAME", "x=NAME"):
        assert words in str(raised.value)


def test_times_since_1970_are_exact_to_the_nanosecond(tmp_path: Path) -> None:
    stamps = [f"1700000000.{k:09d}" for k in (1, 123456789, 999999999)]
    rows = [(1, t, k, 2, 0.9, 50, 50, 20, 20) for k, t in enumerate(stamps)]
    frames, _ = read(tmp_path, csv(rows))
    assert (frames.stamp_ns % 10**9).tolist() == [1, 123456789, 999999999]


ONE_ROW: dict[str, tuple[str, str]] = {
    "x is no number": (changed(4, x="nan"), "1 of 36 boxes left out: a position"),
    "y is empty": (changed(4, y=""), "1 of 36 boxes left out: a position"),
    "w is a word": (changed(4, w="wide"), "1 of 36 boxes left out: a position"),
    "h is infinite": (changed(4, h="inf"), "1 of 36 boxes left out: a position"),
    "no width": (changed(4, w=0), "1 of 36 boxes left out: a width or height"),
    "a negative height": (changed(4, h=-3), "1 of 36 boxes left out: a width or height"),
    "no id": (changed(4, id=""), "1 of 36 boxes left out: no id"),
    "a time that is none": (changed(4, time="soon"), "1 of 36 boxes left out: a time"),
    "wholly outside": (changed(4, x=5000), "1 of 36 boxes left out: wholly outside"),
    "a line cut short": (
        csv(made_rows()).replace(",60.0,40.0\n", "\n", 1),
        "1 of 36 boxes left out: not 9 values as in the header (first: line 2)",
    ),
    "a line too long": (
        csv(made_rows()).replace(",60.0,40.0\n", ",60.0,40.0,1,2\n", 1),
        "1 of 36 boxes left out: not 9 values",
    ),
}


@pytest.mark.parametrize(("content", "remark"), ONE_ROW.values(), ids=ONE_ROW)
def test_a_bad_row_is_left_out_counted_and_named(
    tmp_path: Path, clean: Frames, content: str, remark: str
) -> None:
    frames, report = read(tmp_path, content, image_size=SIZE)
    assert len(frames.rows) == len(clean.rows) - 1
    assert remark in said(report)
    assert "line " in said(report)
    with pytest.raises(InputFileError, match="--strict"):
        read(tmp_path, content, image_size=SIZE, strict=True)


def test_rows_in_any_order_give_the_same_frames(tmp_path: Path, clean: Frames) -> None:
    rows = made_rows()
    frames, report = read(
        tmp_path, csv([rows[k] for k in np.random.default_rng(1).permutation(36)])
    )
    assert_same(frames, clean)
    assert "not in the order of time" in said(report)


def test_of_two_boxes_of_one_id_in_a_frame_the_surer_stays(tmp_path: Path, clean: Frames) -> None:
    rows = made_rows()
    twin = (*rows[4][:4], 0.01, 333.0, *rows[4][6:])
    frames, report = read(tmp_path, csv([*rows[:4], twin, *rows[4:]]))
    assert_same(frames, clean)
    assert "1 of 37 boxes repaired: an id twice in a frame" in said(report)


def test_an_id_twice_in_a_frame_is_seen_however_far_apart_ids_are(tmp_path: Path) -> None:
    """Their difference doesn't fit into 32 bits."""
    ids = (0, 1_500_000_000, -1_300_000_000, 0)
    rows = [
        f"{number},{0.1 * k},{k},2,0.9,{100 + 200 * n},200,30,30"
        for k in range(3)
        for n, number in enumerate(ids)
    ]
    frames, report = read(tmp_path, "\n".join([HEADER, *rows]) + "\n")
    assert len(frames.rows) == 9
    assert "an id twice in a frame" in said(report)


@pytest.mark.parametrize("around", ["\n", " ", "\x1c", "\t"])
def test_blanks_around_a_value_are_none_of_it(tmp_path: Path, clean: Frames, around: str) -> None:
    mark = '"' if around in "\n\t" else ""
    content = each(
        lambda d: [f"{mark}{v}{around}{mark}" if k in ("x", "id") else v for k, v in d.items()]
    )
    frames, _ = read(tmp_path, content)
    assert_same(frames, clean)


def test_corners_in_the_wrong_order_are_exchanged(tmp_path: Path, clean: Frames) -> None:
    content = each(
        lambda d: [
            d["id"], d["time"], d["class"], d["conf"],
            d["x"] + 30, d["y"] + 20, d["x"] - 30, d["y"] - 20,
        ],
        "id,time,class,conf,x1,y1,x2,y2",
    )  # fmt: skip
    frames, report = read(tmp_path, content)
    assert_same(frames, clean)
    assert "corners exchanged" in said(report)


def test_shares_of_the_image_become_pixels(tmp_path: Path, clean: Frames) -> None:
    content = each(
        lambda d: [
            *list(d.values())[:5], d["x"] / 640, d["y"] / 480, d["w"] / 640, d["h"] / 480,
        ]
    )  # fmt: skip
    frames, report = read(tmp_path, content, image_size=SIZE)
    assert_same(frames, clean)
    assert "shares of the image" in said(report)
    with pytest.raises(InputFileError, match="--image-size"):
        read(tmp_path, content)


def test_ground_points_outside_the_image_are_used(tmp_path: Path) -> None:
    content = each(lambda d: [*list(d.values())[:6], d["y"] + 400, 0, 0])
    frames, report = read(tmp_path, content, image_size=SIZE)
    assert len(frames.rows) == 36
    assert ((frames.rows["flags"] & FLAG_GROUND_POINT) != 0).all()
    assert "ground points outside the image of 640x480, used all the same" in said(report)


@pytest.mark.parametrize(
    ("write", "remark"),
    [
        (lambda s: 100 * s, "taken as percent"),
        (lambda s: 20 * s - 12, "logistic"),
        (lambda s: 5 * s - 1, "divided by the largest"),
        (lambda s: 5 * s - 3, "logistic"),
    ],
    ids=["percent", "logits", "0 to 4", "deformable parts, -1 to 4"],
)
def test_scores_of_any_scale_keep_their_order(
    tmp_path: Path, clean: Frames, write: Callable[[float], float], remark: str
) -> None:
    content = each(lambda d: [*list(d.values())[:4], write(d["conf"]), *list(d.values())[5:]])
    frames, report = read(tmp_path, content)
    assert_same(frames, clean, but=("score",))
    assert ((frames.rows["score"] >= 0) & (frames.rows["score"] <= 1)).all()
    assert (np.argsort(frames.frame(0)["score"]) == [0, 1, 2]).all()
    assert remark in said(report)


@pytest.mark.parametrize("write", [lambda i: i + 2**40, lambda i: f"v-{i}", lambda i: i / 2])
def test_ids_of_any_kind_name_the_same_tracks(
    tmp_path: Path, clean: Frames, write: Callable[[int], object]
) -> None:
    content = each(lambda d: [write(int(d["id"])), *list(d.values())[1:]])
    frames, report = read(tmp_path, content)
    assert_same(frames, clean)
    assert len(set(frames.rows["track_id"].tolist())) == 3
    assert "tracks are counted from 1" in said(report)


def test_rounded_times_are_spread_over_their_frames(tmp_path: Path, clean: Frames) -> None:
    content = each(lambda d: [d["id"], f"{np.floor(d['time'] * 5) / 5:.1f}", *list(d.values())[2:]])
    frames, report = read(tmp_path, content)
    assert np.abs(frames.stamp_ns - clean.stamp_ns).max() <= 2e5
    assert "spread evenly" in said(report)


def test_times_that_contradict_frame_numbers_count_and_are_doubted(tmp_path: Path) -> None:
    content = each(lambda d: [d["id"], d["time"], 100 - d["frame_num"], *list(d.values())[3:]])
    frames, report = read(tmp_path, content)
    assert frames.stamp_ns[-1] == 11 * 10**8
    assert report.doubtful


MOT = "\n".join(
    f"{k + 1},{i},{x - w / 2},{y - h / 2},{w},{h},{s},{int(c)},-1,-1"
    for i, _, k, c, s, x, y, w, h in made_rows()
)
KITTI = "\n".join(
    f"{k} {i} Car 0 0 -1.5 {x - w / 2} {y - h / 2} {x + w / 2} {y + h / 2} 1 1 1 0 0 0 0 {s}"
    for i, _, k, _, s, x, y, w, h in made_rows()
)
DETRAC = "<sequence name='MVI_20011'><ignored_region/>" + "".join(
    f"<frame density='3' num='{k + 1}'><target_list>"
    + "".join(
        f"<target id='{i}'><box left='{x - w / 2}' top='{y - h / 2}' width='{w}' height='{h}'/>"
        "<attribute orientation='18.5' speed='6.8' vehicle_type='car'/></target>"
        for i, _, f, _, _, x, y, w, h in made_rows()
        if f == k
    )
    + "</target_list></frame>"
    for k in range(12)
) + "</sequence>"  # fmt: skip
CVAT = (
    "<?xml version='1.0'?><annotations><version>1.1</version><meta><task><original_size>"
    "<width>640</width><height>480</height></original_size></task></meta>"
    + "".join(
        f"<track id='{v}' label='car'>"
        + "".join(
            f"<box frame='{k}' outside='0' occluded='0' keyframe='1' xtl='{x - w / 2}' "
            f"ytl='{y - h / 2}' xbr='{x + w / 2}' ybr='{y + h / 2}'/>"
            for i, _, k, _, _, x, y, w, h in made_rows()
            if i == v
        )
        + "<box frame='12' outside='1' xtl='1' ytl='1' xbr='9' ybr='9'/></track>"
        for v in (1, 2, 3)
    )
    + "</annotations>"
)
OTVISION = bz2.compress(
    json.dumps(
        {
            "metadata": {
                "otdet_version": "1.2", "ottrk_version": "1.1",
                "video": {"width": 640, "height": 480, "recorded_fps": 10.0},
            },
            "data": {
                "detections": [
                    {
                        "class": "car", "confidence": s, "x": x, "y": y, "w": w, "h": h,
                        "interpolated-detection": False, "track-id": i, "frame": k + 1,
                        "occurrence": 1577836800.0 + t,
                    }
                    for i, t, k, _, s, x, y, w, h in made_rows()
                ]
            },
        }
    ).encode()
)  # fmt: skip
SUPERVISION = each(
    lambda d: [
        d["x"] - d["w"] / 2, d["y"] - d["h"] / 2, d["x"] + d["w"] / 2, d["y"] + d["h"] / 2,
        int(d["class"]), d["conf"], d["id"], d["frame_num"],
    ],
    "x_min,y_min,x_max,y_max,class_id,confidence,tracker_id,frame_index",
)  # fmt: skip
SUPERVISION_JSON = json.dumps(
    [
        {
            "x_min": x - w / 2, "y_min": y - h / 2, "x_max": x + w / 2, "y_max": y + h / 2,
            "class_id": 2, "confidence": s, "tracker_id": i, "class_name": "car", "frame_index": k,
        }
        for i, _, k, _, s, x, y, w, h in made_rows()
    ]
)  # fmt: skip
ULTRALYTICS = [
    [
        {
            "name": "car", "class": 2, "confidence": s, "track_id": i,
            "box": {"x1": x - w / 2, "y1": y - h / 2, "x2": x + w / 2, "y2": y + h / 2},
        }
        for i, _, f, _, s, x, y, w, h in made_rows()
        if f == k
    ]
    for k in range(12)
]  # fmt: skip
MOT_FROM_0 = "\n".join(
    f"{int(frame) - 1},{rest}" for frame, rest in (line.split(",", 1) for line in MOT.split("\n"))
)
COCO: list[dict[str, Any]] = [
    {
        "image_id": k + 1, "category_id": 3, "score": s, "track_id": i, "id": 1000 + 3 * k + i,
        "bbox": [x - w / 2, y - h / 2, w, h],
    }
    for i, _, k, _, s, x, y, w, h in made_rows()
]  # fmt: skip
COCO_DATA = {
    "images": [{"id": k + 101, "file_name": f"{k:06}.jpg", "width": 640, "height": 480}
               for k in range(12)],
    "categories": [{"id": 1, "name": "car"}],
    "annotations": [row | {"image_id": row["image_id"] + 100, "category_id": 1} for row in COCO],
}  # fmt: skip
MOT_WITH_COMMAS = MOT.replace(",", ";").replace(".", ",")
FORMATS: dict[str, tuple[str | bytes, tuple[str, ...]]] = {
    "MOTChallenge": (MOT, ()),
    "MOTChallenge with semicolons and decimal commas": (MOT_WITH_COMMAS, ()),
    "MOTChallenge with tabs and decimal commas": (MOT_WITH_COMMAS.replace(";", "\t"), ()),
    "COCO results": (json.dumps(COCO), ()),
    "a list of tracks per image, a line each": (
        "\n".join(json.dumps({"frame_id": k, "tracks": [
            {"track_id": i, "class": 2, "conf": s,
             "bbox": [x - w / 2, y - h / 2, x + w / 2, y + h / 2]}
            for i, _, f, _, s, x, y, w, h in made_rows() if f == k]}) for k in range(12)), ()),
    "COCO results with detectors' numbers": (
        json.dumps([row | {"category_id": 2} for row in COCO]), ()),
    "COCO data": (json.dumps(COCO_DATA), ()),
    "COCO with empty categories": (
        json.dumps(COCO_DATA | {"categories": [], "annotations": [
            {k: v for k, v in row.items() if k != "track_id"}
            | {"image_id": row["image_id"] + 100, "attributes": {"track_id": row["track_id"]}}
            for row in COCO]}), ()),
    "NumPy's savetxt": (
        re.sub(r"[^,\n]+", lambda found: f"{float(found[0]):.18e}", MOT).replace(",", " "), ()),
    "JSON with corner and size": (
        json.dumps([{"frame": r["image_id"], "class": 2, "conf": r["score"], "id": r["track_id"],
                     "bbox": r["bbox"]} for r in COCO]), ()),
    "MOTChallenge with blanks": (MOT.replace(",", " "), ()),
    "MOTChallenge from frame 0": (MOT_FROM_0, ()),
    "KITTI": (KITTI, ()),
    "UA-DETRAC": (DETRAC, ("score",)),
    "CVAT": (CVAT, ("score",)),
    "CVAT in UTF-16": (CVAT.replace("?>", " encoding='UTF-16'?>", 1).encode("utf-16"), ("score",)),
    "OTVision": (OTVISION, ()),
    "supervision CSV": (SUPERVISION, ()),
    "supervision JSON": (SUPERVISION_JSON, ()),
    "Ultralytics": (json.dumps(ULTRALYTICS), ()),
    "Ultralytics, a line per image": ("\n".join(json.dumps(image) for image in ULTRALYTICS), ()),
}  # fmt: skip


@pytest.mark.parametrize(("content", "without"), FORMATS.values(), ids=FORMATS)
def test_every_format_gives_the_same_boxes(
    tmp_path: Path, clean: Frames, content: str | bytes, without: tuple[str, ...]
) -> None:
    frames, _ = read(tmp_path, content, fps=FPS, image_size=SIZE)
    shifted = Frames(frames.stamp_ns - frames.stamp_ns[0], frames.offset, frames.rows)
    ids = dict(zip(sorted(set(frames.rows["track_id"].tolist())), (1, 2, 3), strict=True))
    shifted.rows["track_id"] = [ids[i] for i in frames.rows["track_id"].tolist()]
    assert_same(shifted, clean, but=without)


REFUSED: dict[str, tuple[str | bytes, str]] = {
    "nothing": (b"", "an empty file"),
    "blanks": (b"  \n\n", "an empty file"),
    "a header alone": (HEADER + "\n", "no row below the header"),
    "a picture": (bytes(range(256)) * 30, "binary data"),
    "a letter": ("Dear all,\nthe camera is broken.\n", "expected tracked boxes"),
    "no ids": ("time,x,y,w,h\n0,1,2,3,4\n", "no column with the tracks' ids"),
    "no times": ("id,x,y,w,h\n0,1,2,3,4\n", "no column that says when"),
    "no boxes": ("id,time\n0,1\n", "no column with boxes"),
    "frames without a rate": (
        "id,frame,x,y,w,h\n1,1,50,50,20,20\n",
        "--fps: how many images per second",
    ),
    "detections": (re.sub(r"(?m)^(\d+),\d+,", r"\1,-1,", MOT), "detections"),
    "mostly outside": (
        each(lambda d: [*list(d.values())[:5], d["x"] + 9999, *list(d.values())[6:]]),
        "36 of 36 boxes left out: wholly outside",
    ),
    "JSON that breaks off": (SUPERVISION_JSON[:-20], "JSON that breaks off"),
    "JSON without boxes": ("{}", "no boxes"),
    "XML that breaks off": (CVAT[:-30], "XML that can't be read"),
    "CVAT for images": ("<annotations><image id='0'/></annotations>", "for images"),
    "OTVision's detections": (
        bz2.compress(b'{"metadata": {}, "data": {"1": {"detections": []}}}'),
        "no ids",
    ),
    "bzip2 that breaks off": (OTVISION[: len(OTVISION) // 2], "can't be read"),
}  # fmt: skip


@pytest.mark.parametrize(("content", "words"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_file_of_tracks_is_refused_in_one_sentence(
    tmp_path: Path, content: str | bytes, words: str
) -> None:
    with pytest.raises(GeoOrbitError) as caught:
        read(tmp_path, content, image_size=SIZE)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="no such file"):
        read_tracks(tmp_path / "none.csv")
    with pytest.raises(InputFileError, match="directory"):
        read_tracks(tmp_path)


def test_columns_can_be_named(tmp_path: Path, clean: Frames) -> None:
    header = "veh,sec,img,kind,p,mx,my,bw,bh"
    columns = dict(
        zip(
            ("id", "time", "frame", "class", "conf", "x", "y", "w", "h"),
            header.split(","),
            strict=True,
        )
    )
    frames, _ = read(tmp_path, csv(made_rows(), header), columns=columns)
    assert_same(frames, clean)
    with pytest.raises(InputFileError, match="no column 'speed'"):
        read(tmp_path, csv(made_rows()), columns={"x": "speed"})
    with pytest.raises(ParameterError, match="--columns"):
        read(tmp_path, csv(made_rows()), columns={"colour": "x"})


@pytest.mark.parametrize(
    ("text", "name", "number"),
    [
        ("coco", "7", 7),
        ("visdrone", "4", 2),
        ("visdrone", "9", 5),
        ("visdrone", "1", 0x50),
        ("detrac", "3", 2),
        ("0=car,1=truck", "0", 2),
        ("0=car,1=truck", "1", 7),
        ("0=car,1=truck", "5", 5),
        ("coco", "lorry", 7),
        ("coco", "Person", 0),
        ("coco", "traffic_light", 9),
        ("coco", "elephants", 80),
        ("coco", "", -1),
        ("coco", "2.0", 2),
    ],
)
def test_classes_by_number_and_by_name(text: str, name: str, number: int) -> None:
    assert class_number(name, class_table(text)) == number


def test_classes_of_a_yaml_file(tmp_path: Path) -> None:
    path = tmp_path / "data.yaml"
    path.write_text("nc: 2\nnames: [van, bus]\n")
    assert class_table(str(path)) == {"0": "van", "1": "bus"}
    with pytest.raises(ParameterError, match="--classes"):
        class_table("whatever")
