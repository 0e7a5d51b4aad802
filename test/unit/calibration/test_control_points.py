"""What a calibration file may hold, and the sentence for everything else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geoorbit_ros.calibration.control_points import read_control_points
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import CalibrationError, InputFileError

GEODETIC = """pixel_x,pixel_y,latitude,longitude
100,200,43.0400,-89.3400
1800,220,43.0410,-89.3401
150,900,43.0401,-89.3390
1700,950,43.0409,-89.3391
"""
LOCAL = """pixel_x,pixel_y,x_m,y_m
100,200,-30,120
1800,220,40,118
150,900,-8,20
1700,950,9,18
"""


def file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "calibration.csv"
    path.write_text(text, encoding="utf-8")
    return path


def line(text: str, number: int, new: str) -> str:
    lines = text.splitlines()
    lines[number - 1] = new
    return "\n".join(lines) + "\n"


def test_geodetic_points_are_metres_round_their_mean(tmp_path: Path) -> None:
    points = read_control_points(file(tmp_path, GEODETIC))
    assert points.datum is not None
    assert points.datum.latitude_deg == pytest.approx(43.0405)
    assert np.hypot(*points.local_m.mean(axis=0)) < 0.01
    assert points.line_number.tolist() == [2, 3, 4, 5]
    np.testing.assert_array_equal(points.pixel[1], [1800, 220])
    assert points.local_m[1, 1] - points.local_m[0, 1] == pytest.approx(111.1, abs=0.1)


def test_a_given_datum_is_the_origin(tmp_path: Path) -> None:
    datum = Datum(43.04, -89.34)
    points = read_control_points(file(tmp_path, GEODETIC), datum)
    assert points.datum == datum
    np.testing.assert_allclose(points.local_m[0], [0, 0], atol=1e-6)


def test_metres_stay_as_they_are(tmp_path: Path) -> None:
    points = read_control_points(file(tmp_path, LOCAL))
    assert points.datum is None
    np.testing.assert_array_equal(points.local_m[0], [-30, 120])


def test_column_order_spare_columns_blank_lines_and_a_byte_order_mark(tmp_path: Path) -> None:
    text = (
        "\ufefflongitude, name,latitude,pixel_y,pixel_x\n-89.34,a,43.04,200,100\n\n"
        "-89.3401,b,43.041,220,1800\n-89.339,c,43.0401,900,150\n-89.3391,d,43.0409,950,1700\n"
    )
    points = read_control_points(file(tmp_path, text))
    np.testing.assert_array_equal(points.pixel[0], [100, 200])
    assert points.line_number.tolist() == [2, 4, 5, 6]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["line 1", "empty file", "pixel_x,pixel_y,latitude,longitude"]),
        ("pixel_x,pixel_y,latitude\n1,2,3\n", ["line 1", "'pixel_x,pixel_y,latitude'", "x_m"]),
        (line(GEODETIC, 3, "1800,abc,43.0410,-89.3401"), ["line 3", "'pixel_y'", "'abc'"]),
        (line(GEODETIC, 3, "1800,220,nan,-89.3401"), ["line 3", "'latitude'", "'nan'"]),
        (line(GEODETIC, 4, "150,900,43.0401,inf"), ["line 4", "'longitude'", "'inf'"]),
        (line(GEODETIC, 4, "150,900,43.0401,"), ["line 4", "'longitude'", "''"]),
        (line(GEODETIC, 4, "150,900"), ["line 4", "2 values", "4"]),
        (line(GEODETIC, 2, "100,200,-93.4,43.04"), ["line 2", "-93.4", "swapped"]),
        (line(GEODETIC, 2, "100,200,-89.34,43.04"), ["line 2", "-89.34", "swapped"]),
    ],
)
def test_unreadable_values_are_named(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(InputFileError) as error:
        read_control_points(file(tmp_path, text))
    for word in ["calibration.csv", *words]:
        assert word in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match=r"nowhere\.csv: found No such file"):
        read_control_points(tmp_path / "nowhere.csv")


def test_a_binary_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "calibration.csv"
    path.write_bytes(b"\xff\xfe\x00pixel")
    with pytest.raises(InputFileError, match="UTF-8"):
        read_control_points(path)


ON_A_LINE = LOCAL.replace("-30,120", "0,40").replace("40,118", "1,30")
ON_A_LINE = ON_A_LINE.replace("-8,20", "2,20").replace("9,18", "3,10")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("".join(GEODETIC.splitlines(keepends=True)[:4]), ["3 control points", "at least 4"]),
        (GEODETIC.splitlines()[0] + "\n", ["0 control points", "at least 4"]),
        (ON_A_LINE, ["ground positions", "one line"]),
        (
            line(line(LOCAL, 3, "200,300,40,118"), 4, "150,250,-8,20").replace(
                "1700,950", "400,500"
            ),
            ["pixel positions", "one line"],
        ),
        (line(LOCAL, 5, "1700,950,9,18000"), ["line 5", "km"]),
        (line(LOCAL, 5, "1800,220,9,18"), ["line 5", "line 3", "once"]),
        (line(LOCAL, 5, "1700,950,40,118"), ["line 5", "line 3", "ground"]),
    ],
)
def test_points_that_fix_no_plane_are_refused(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(CalibrationError) as error:
        read_control_points(file(tmp_path, text))
    for word in ["calibration.csv", *words]:
        assert word in str(error.value)
