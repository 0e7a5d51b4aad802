"""Control points as people have them: used, repaired, left out or refused, and never silently."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cameras import Camera
from pyproj import Transformer

from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.plausibility import calibration_report
from geoorbit_ros.core.errors import CalibrationError, GeoOrbitError, InputFileError

DATUM = Datum(51.6, -1.2)
TRUE = Camera().control_points()
DEGREES = DATUM.to_geodetic(TRUE.local_m)
HEADER = "pixel_x,pixel_y,latitude,longitude"
COUNT = len(TRUE)


def rows() -> list[list[str]]:
    return [
        [f"{u:.2f}", f"{v:.2f}", f"{lat:.9f}", f"{lon:.9f}"]
        for (u, v), (lat, lon) in zip(TRUE.pixel, DEGREES, strict=True)
    ]


def text(
    change: Callable[[list[str]], Sequence[str]] = lambda row: row,
    header: str = HEADER,
    between: str = ",",
) -> str:
    """The file, with every row made anew from its cells."""
    return "\n".join([header, *(between.join(change(row)) for row in rows())]) + "\n"


def changed(at: int, **cells: str) -> str:
    """The file with other cells in row `at`, which is line `at` + 2."""
    names, all_rows = HEADER.split(","), rows()
    for name, cell in cells.items():
        all_rows[at][names.index(name)] = cell
    return "\n".join([HEADER, *(",".join(row) for row in all_rows)]) + "\n"


def plane(epsg: int, header: str = "pixel_x,pixel_y,x_m,y_m", *, exchanged: bool = False) -> str:
    """The file with the coordinates of a map projection."""
    to_plane = Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)

    def projected(row: list[str]) -> list[str]:
        x, y = to_plane.transform(float(row[3]), float(row[2]))
        return [*row[:2], *([f"{y:.4f}", f"{x:.4f}"] if exchanged else [f"{x:.4f}", f"{y:.4f}"])]

    return text(projected, header)


def read(
    folder: Path, content: str | bytes, datum: Datum | None = DATUM, **options: object
) -> ControlPoints:
    path = folder / "calibration.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_control_points(path, datum, **options)  # type: ignore[arg-type]


def said(points: ControlPoints) -> str:
    return " | ".join(points.report.sentences())


def assert_same(points: ControlPoints, tolerance_m: float = 0.01) -> None:
    np.testing.assert_allclose(points.pixel, TRUE.pixel, atol=0.01)
    np.testing.assert_allclose(points.local_m, TRUE.local_m, atol=tolerance_m)


def with_blanks(degrees: float, *, seconds: bool) -> str:
    """`-89 20 38.5`, or `-89 20.6417`."""
    whole, minutes = divmod(abs(degrees) * 60.0, 60.0)
    sign = "-" if degrees < 0.0 else ""
    if not seconds:
        return f"{sign}{whole:.0f} {minutes:.10f}"
    return f"{sign}{whole:.0f} {int(minutes)} {(minutes % 1.0) * 60.0:.9f}"


def degrees_minutes(value: float, letters: str) -> str:
    minutes, seconds = divmod(3600.0 * abs(value), 60.0)
    degrees, minutes = divmod(minutes, 60.0)
    return f"{degrees:.0f}°{minutes:02.0f}'{seconds:.5f}\"{letters[int(value < 0)]}"


SPELLINGS: dict[str, str | bytes] = {
    "as documented": text(),
    "a byte order mark": b"\xef\xbb\xbf" + text().encode(),
    "UTF-16": text().encode("utf-16"),
    "UTF-16 without a mark": text().encode("utf-16-le"),
    "line ends of Windows": text().replace("\n", "\r\n"),
    "line ends of old Macs": text().replace("\n", "\r"),
    "semicolons and decimal commas": text(
        lambda row: [cell.replace(".", ",") for cell in row], HEADER.replace(",", ";"), ";"
    ),
    "Excel's first line": "sep=;\n" + text(header=HEADER.replace(",", ";"), between=";"),
    "tabs": text(header=HEADER.replace(",", "\t"), between="\t"),
    "blanks": text(header=HEADER.replace(",", "  "), between="  "),
    "blanks around values": text(lambda row: [f" {cell} " for cell in row]),
    "blank lines": text().replace("\n", "\n\n"),
    "lines of commas": text().replace("\n", "\n,,,\n", 2),
    "comments": "# made in QGIS\n" + text().replace("\n", "\n# next\n", 1),
    "commas at the end": text(lambda row: [*row, ""]),
    "commas at the end, header too": text(lambda row: [*row, ""], HEADER + ","),
    "quotes": text(lambda row: [f'"{cell}"' for cell in row]),
    "no line end at the end": text().rstrip(),
    "columns in another order": text(lambda row: row[::-1], ",".join(HEADER.split(",")[::-1])),
    "other columns": text(lambda row: ["a", *row, "7"], f"name,{HEADER},height"),
    "remarks on some lines only": text(header=HEADER + ",remark").replace("\n", ",curb, left\n", 2)
    .replace(",curb, left", "", 1),
    "u, v": text(header="u,v,lat,lon"),
    "px, py": text(header="px,py,LAT,LNG"),
    "x_px, y_px": text(header="x_px,y_px,Latitude,Longitude"),
    "units in the header": text(header="Pixel X [px],Pixel Y [px],Latitude (°),Longitude (°)"),
    "x, y beside degrees": text(header="x,y,lat_deg,lon_deg"),
    "degrees, minutes and seconds": text(
        lambda row: [
            *row[:2], degrees_minutes(float(row[2]), "NS"), degrees_minutes(float(row[3]), "EW")
        ]
    ),
    "degrees and minutes with blanks": text(
        lambda row: [*row[:2], *(with_blanks(float(cell), seconds=False) for cell in row[2:])]
    ),
    "degrees, minutes and seconds with blanks": text(
        lambda row: [*row[:2], *(with_blanks(float(cell), seconds=True) for cell in row[2:])]
    ),
    "letters for north and west": text(
        lambda row: [*row[:2], f"{row[2]} N", f"{row[3].lstrip('-')}° W"]
    ),
    "exponents": text(lambda row: [*row[:2], f"{float(row[2]):.12e}", f"{float(row[3]):.12e}"]),
}  # fmt: skip


EXCHANGED = str.maketrans(",.", ".,")
GROUPED = {
    "points between thousands, decimal commas": text(
        lambda row: [
            f"{float(row[0]):,.1f}".translate(EXCHANGED),
            *(cell.replace(".", ",") for cell in row[1:]),
        ],
        HEADER.replace(",", ";"),
        ";",
    ),
    "commas between thousands, in quotes": text(lambda row: [f'"{float(row[0]):,.1f}"', *row[1:]]),
}


@pytest.mark.parametrize("content", GROUPED.values(), ids=GROUPED)
def test_marks_between_thousands_are_no_decimals(tmp_path: Path, content: str) -> None:
    points = read(tmp_path, content)
    assert_same(points)
    assert "numbers have marks between thousands: 1" in said(points)


@pytest.mark.parametrize("content", SPELLINGS.values(), ids=SPELLINGS)
def test_any_spelling_of_the_same_points_gives_the_same_points(
    tmp_path: Path, content: str | bytes
) -> None:
    points = read(tmp_path, content)
    assert_same(points)
    assert said(points) == ""
    read(tmp_path, content, strict=True)


LOCAL_ROWS = [
    [*row[:2], f"{x:.4f}", f"{y:.4f}"] for row, (x, y) in zip(rows(), TRUE.local_m, strict=True)
]
LOCAL = "\n".join(["pixel_x,pixel_y,x_m,y_m", *(",".join(row) for row in LOCAL_ROWS)]) + "\n"
QGIS = text(
    lambda row: [row[3], row[2], row[0], f"-{row[1]}", "1", "0", "0"],
    "mapX,mapY,pixelX,pixelY,enable,dX,dY",
)
ELSEWHERE: dict[str, tuple[str, str]] = {
    "metres from the datum": (LOCAL, ""),
    "east and north": (LOCAL.replace("x_m,y_m", "east_m,north_m"), ""),
    "small and capital letters": (LOCAL.replace("pixel_x,pixel_y,x_m,y_m", "x,y,X,Y"), ""),
    "u, v, x, y": (LOCAL.replace("pixel_x,pixel_y,x_m,y_m", "u,v,x,y"), ""),
    "UTM": (plane(32630), "UTM zone 30N (EPSG:32630), by their size"),
    "UTM, as surveyors call it": (plane(32630, "u,v,Easting,Northing"), "UTM zone 30N"),
    "UTM of the neighbouring zone": (plane(32631), "UTM zone 31N"),
    "ETRS89, which is the same": (plane(25830), "UTM zone 30N"),
    "UTM with the northing first": (plane(32630, exchanged=True), "with the northing first"),
    "Web Mercator": (plane(3857), "Pseudo-Mercator (EPSG:3857)"),
    "a national grid": (plane(27700), "British National Grid (EPSG:27700)"),
    "a projection by its number": ("# CRS: EPSG:27700\n" + plane(27700), "as a comment says"),
    "a projection by its definition": (
        "#CRS: +proj=utm +zone=30 +datum=WGS84 +units=m\n" + plane(32630), "as a comment says"
    ),
    "QGIS in degrees": ("#CRS: EPSG:4326\n" + QGIS, "pixels count upwards"),
    "degrees as x and y": (
        text(lambda row: [*row[:2], row[3], row[2]], "u,v,x,y"), "are degrees: taken as longitude"
    ),
    "latitude and longitude exchanged in a row": (
        changed(3, latitude=rows()[3][3], longitude=rows()[3][2]), "1 of 20 control points repaired"
    ),
    "longitudes from 0 to 360": (
        text(lambda row: [*row[:3], f"{float(row[3]) + 360.0:.9f}"]), ""
    ),
    "shares of the image": (
        text(
            lambda row: [
                f"{float(row[0]) / 1920:.8f}", f"{float(row[1]) / 1080:.8f}", *row[2:]
            ]
        ),
        "shares of the image (0 to 1); they are taken times 1920x1080",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("content", "remark"), ELSEWHERE.values(), ids=ELSEWHERE)
def test_the_ground_in_any_coordinates_is_the_same_ground(
    tmp_path: Path, content: str, remark: str
) -> None:
    points = read(tmp_path, content, image_size=(1920, 1080))
    assert_same(points, tolerance_m=3.0 if "27700" in content or "British" in remark else 0.01)
    np.testing.assert_allclose(  # a grid's datum may shift all points, but not one against another
        points.local_m - points.local_m[0], TRUE.local_m - TRUE.local_m[0], atol=0.01
    )
    assert remark in said(points)
    assert bool(remark) == bool(said(points))


def test_a_named_projection_needs_no_datum(tmp_path: Path) -> None:
    points = read(tmp_path, "# CRS: EPSG:32630\n" + plane(32630), None)
    assert points.datum is not None
    assert np.hypot(*points.local_m.mean(axis=0)) < 0.01
    apart = TRUE.local_m - TRUE.local_m.mean(axis=0)
    np.testing.assert_allclose(points.local_m - points.local_m.mean(axis=0), apart, atol=0.01)


def test_a_file_that_is_exchanged_throughout_is_put_right_where_that_is_plain(
    tmp_path: Path,
) -> None:
    there = Datum(43.04, -89.34)
    cells = there.to_geodetic(TRUE.local_m)
    lines = [f"{u},{v},{lon},{lat}" for (u, v), (lat, lon) in zip(TRUE.pixel, cells, strict=True)]
    points = read(tmp_path, "\n".join([HEADER, *lines]), there)
    np.testing.assert_allclose(points.local_m, TRUE.local_m, atol=0.01)
    assert "exchanged; they are put right (first: line 2" in said(points)


LEFT_OUT: dict[str, tuple[str, int, str]] = {
    "a word": (changed(1, pixel_y="abc"), 1, "no number (first: line 3: "),
    "NaN": (changed(1, latitude="nan"), 1, "no number (first: line 3: "),
    "infinite": (changed(2, longitude="inf"), 1, "no number (first: line 4: "),
    "empty": (changed(2, longitude=""), 1, "no number (first: line 4: "),
    "a line cut short": (text().rstrip().rsplit(",", 1)[0] + "\n", 1, "line 21"),
    "kilometres away": (changed(4, latitude="51.7"), 1, "more than 5 km from the others"),
    "zeros": (changed(4, latitude="0", longitude="0"), 1, "more than 5 km from the others"),
    "the same line twice": (text() + ",".join(rows()[3]) + "\n", 0, "the same point"),
    "a comma in a number": (changed(1, pixel_x="1,5"), 1, "no number (first: line 3: "),
}  # fmt: skip


@pytest.mark.parametrize(("content", "lost", "remark"), LEFT_OUT.values(), ids=LEFT_OUT)
def test_a_bad_line_is_left_out_counted_and_named(
    tmp_path: Path, content: str, lost: int, remark: str
) -> None:
    points = read(tmp_path, content)
    assert len(points) == COUNT - lost
    assert "1 of 2" in said(points)
    assert "left out" in said(points)
    assert remark in said(points)
    with pytest.raises(InputFileError, match="--strict"):
        read(tmp_path, content, strict=True)


def test_switched_off_points_are_not_used_and_no_fault(tmp_path: Path) -> None:
    for header, off, on in (("enable", "0", "1"), ("excluded", "TRUE", "")):
        content = text(lambda row, on=on: [*row, on], f"{HEADER},{header}")  # type: ignore[misc]
        lines = content.splitlines()
        lines[5] = lines[5].removesuffix(on) + off
        points = read(tmp_path, "\n".join(lines), strict=True)
        assert len(points) == COUNT - 1
        assert f"switched off in column '{header}'" in said(points)


def test_two_positions_of_one_pixel_are_both_taken_and_the_fit_decides(tmp_path: Path) -> None:
    wrong = [*rows()[3][:2], *rows()[12][2:]]
    points = read(tmp_path, text() + ",".join(wrong) + "\n")
    assert "another position than in an earlier line" in said(points)
    homography = fit_homography(points)
    assert homography.residual.inlier.tolist() == [True] * COUNT + [False]
    (sentence,) = (s for s in calibration_report(homography).sentences() if "disagree" in s)
    assert sentence.startswith("1 of 21 control points left out: they disagree with the others")
    assert "line 22: " in sentence


def test_points_outside_the_image_are_used_and_told(tmp_path: Path) -> None:
    homography = fit_homography(read(tmp_path, text()))
    report = calibration_report(homography, (1920, 1000))
    assert homography.residual.inlier.all()
    assert "outside the image of 1920x1000, used all the same" in " ".join(report.sentences())
    assert not report.doubtful
    other = calibration_report(homography, (960, 540))
    assert "the image is 960x540, but the control points reach pixel (1728, 1026)" in " ".join(
        other.sentences()
    )
    assert other.doubtful


REFUSED: dict[str, tuple[str | bytes, tuple[str, ...]]] = {
    "an empty file": ("", ("an empty file",)),
    "only a header": (HEADER + "\n", ("no row below the header",)),
    "a column missing": (text(header="pixel_x,pixel_y,latitude,height"), ("line 1", "longitude")),
    "no header": (text().partition("\n")[2], ("line 1", "the columns pixel_x,pixel_y")),
    "binary data": (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0", ("binary data",)),
    "three points": ("\n".join(text().split("\n")[:4]), ("3 control points", "at least 4")),
    "three good points": (
        "\n".join(changed(1, latitude="north").split("\n")[:5]),
        ("3 control points", "1 of 4 rows left out", "line 3", "north"),
    ),
    "one pixel for all": (
        text(lambda row: ["5", "5", *row[2:]]),
        ("1 control points", "line 3 has the pixel position of line 2 again"),
    ),
    "on one line in the image": (
        text(lambda row: [row[0], "500", *row[2:]]), ("pixel positions lie on one line",)
    ),
    "UTM of another continent": (plane(32654), ("km from the datum", "# CRS: EPSG:")),
    "degrees of another continent": (
        text(lambda row: [*row[:2], f"{float(row[2]) - 80}", row[3]]), ("km from the datum",)
    ),
    "an unknown projection": ("# CRS: EPSG:99999\n" + plane(32630), ("EPSG:99999",)),
    "pixels in shares without a size": (
        text(lambda row: [f"{float(row[0]) / 1920}", f"{float(row[1]) / 1080}", *row[2:]]),
        ("shares of the image",),
    ),
}  # fmt: skip


@pytest.mark.parametrize(("content", "words"), REFUSED.values(), ids=REFUSED)
def test_what_fixes_no_plane_is_refused_in_one_sentence(
    tmp_path: Path, content: str | bytes, words: tuple[str, ...]
) -> None:
    with pytest.raises(GeoOrbitError) as error:
        read(tmp_path, content)
    for word in ("calibration.csv", *words):
        assert word in str(error.value)
    assert "\n" not in str(error.value)


def test_no_file_and_a_folder(tmp_path: Path) -> None:
    for path, words in ((tmp_path / "nowhere.csv", "no such file"), (tmp_path, "directory")):
        with pytest.raises(InputFileError, match=words):
            read_control_points(path)


def test_a_datum_that_is_exchanged_is_asked_about(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"exchanged in one of them\?"):
        read(tmp_path, text(), Datum(DATUM.longitude_deg, DATUM.latitude_deg))


def test_a_datum_of_the_next_town_is_told(tmp_path: Path) -> None:
    points = read(tmp_path, text(), Datum(51.9, -1.2))
    assert "the points lie 33 km from the datum" in said(points)
    assert not points.report.doubtful


def test_projections_that_could_be_meant_as_well_are_named(tmp_path: Path) -> None:
    berlin = Datum(52.5, 13.4)
    degrees = berlin.to_geodetic(TRUE.local_m)
    to_plane = Transformer.from_crs("EPSG:4326", "EPSG:31468", always_xy=True)
    xy = zip(*to_plane.transform(degrees[:, 1], degrees[:, 0]), strict=True)
    lines = [f"{u},{v},{x},{y}" for (u, v), (x, y) in zip(TRUE.pixel, xy, strict=True)]
    content = "\n".join(["pixel_x,pixel_y,x_m,y_m", *lines])
    with pytest.raises(CalibrationError, match=r"DHDN .* or of Pulkovo .*# CRS: EPSG:"):
        read(tmp_path, content, berlin)
    points = read(tmp_path, "# CRS: EPSG:31468\n" + content, berlin)
    np.testing.assert_allclose(
        points.local_m - points.local_m[0], TRUE.local_m - TRUE.local_m[0], atol=0.01
    )


def test_metres_without_a_datum_stay_as_they_are_and_say_how_far_away_they_are(
    tmp_path: Path,
) -> None:
    points = read(tmp_path, LOCAL, None)
    assert points.datum is None
    np.testing.assert_allclose(points.local_m, TRUE.local_m, atol=1e-3)
    with pytest.raises(InputFileError, match="control points in metres, expected --datum"):
        points.need_datum("--datum")
    far = replace(points, local_m=points.local_m + np.array([624e3, 5718e3]))
    with pytest.raises(InputFileError, match=r"5752 km from \(0, 0\) as in a map projection"):
        far.need_datum("--datum")
