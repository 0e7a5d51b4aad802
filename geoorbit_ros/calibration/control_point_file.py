"""Reads control points as people write them: used, repaired or left out, and told.

A file is refused only when too few points are left, or when it isn't clear where on Earth they lie.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_points import (
    GEODETIC_COLUMNS,
    LOCAL_COLUMNS,
    MAX_EXTENT_M,
    PIXEL_COLUMNS,
    ControlPoints,
    check_points,
)
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.projections import (
    FAR_M,
    NEAR_M,
    ground_distance_m,
    named_projection,
    projection_near,
)
from geoorbit_ros.core.errors import CalibrationError, InputFileError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.storage.tracks.csv_text import CsvBody, split_header

Array = NDArray[np.float64]

NAMES: dict[str, tuple[str, ...]] = {
    "pixel_x": (
        "pixel_x", "px", "u", "x_px", "x_pixel", "pixelx", "x_image", "image_x", "img_x", "x_img",
        "source_x", "sourcex", "column", "col", "px_x", "pix_x",
    ),
    "pixel_y": (
        "pixel_y", "py", "v", "y_px", "y_pixel", "pixely", "y_image", "image_y", "img_y", "y_img",
        "source_y", "sourcey", "row", "px_y", "pix_y",
    ),
    "latitude": ("latitude", "lat", "latitude_wgs84", "lat_wgs84", "breitengrad", "breite"),
    "longitude": ("longitude", "lon", "lng", "long", "longitude_wgs84", "lon_wgs84", "längengrad"),
    "x_m": (
        "x_m", "easting", "east", "east_m", "e", "x_world", "world_x", "xw", "x_ground",
        "ground_x", "map_x", "mapx", "x_map", "x_utm", "utm_x", "utm_e", "x_local", "local_x",
        "rechtswert",
    ),
    "y_m": (
        "y_m", "northing", "north", "north_m", "n", "y_world", "world_y", "yw", "y_ground",
        "ground_y", "map_y", "mapy", "y_map", "y_utm", "utm_y", "utm_n", "y_local", "local_y",
        "hochwert",
    ),
    "enable": ("enable", "enabled", "use", "used", "active"),
    "excluded": ("excluded", "exclude", "skip", "disabled"),
}  # fmt: skip
"""Names of columns by what they mean; case, blanks, brackets and units don't count."""
EXPECTED = "a CSV file with the columns pixel_x,pixel_y,latitude,longitude (or x_m,y_m)"
GEODETIC_BOUND_DEG = 80.0
"""No road leads beyond 80 degrees of latitude: a larger one is a longitude."""
METRES_PER_DEG = 111_320.0
"""Along the equator (WGS 84); along a meridian it is within 0.6 %."""
DEGREES_SPREAD = 1.0
"""Ground coordinates that lie this close together are degrees, not metres: no road fits into a
square metre, and a degree is a hundred kilometres."""
NORMALISED = 1.5
"""Pixels that are all below this are shares of the image: no road fits into two pixels."""
_NO = {"0", "0.0", "false", "no", "n"}
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_UNIT = re.compile(r"_(px|pixels?|m|met(er|re)s?|deg|degrees|dd|decimal_degrees)$")
_ANGLE = re.compile(
    r"(?P<before>[NSEW]?) *(?P<sign>[+-]?)(?P<d>\d+(\.\d+)?) *[°d]? *"
    r"((?P<m>\d+(\.\d+)?) *['′m] *)?((?P<s>\d+(\.\d+)?) *([\"″s]|'') *)?(?P<after>[NSEW]?)"
)
"""Degrees, minutes and seconds as maps show them: 43°02'38.5"N."""
_BLANKS = re.compile(r"([NSEW]? *[+-]?)(\d+) +(\d+(?:\.\d+)?)(?: +(\d+(?:\.\d+)?))? *([NSEW]?)")
"""The same with blanks alone: 43 02 38.5."""


@dataclass(slots=True)
class _Table:
    """The rows of a file while they are being checked.

    Attributes:
        names: Of the two ground columns as the file has them.
        geodetic: These are latitude and longitude.
        values: (N, 4) numbers, pixel and ground; NaN where there is none.
        text: The cells as they are written.
        line: (N,) where each row stands.
        report: What was done.
        comments: Above the header.
    """

    names: tuple[str, ...]
    geodetic: bool
    values: Array
    text: list[tuple[str, ...]]
    line: NDArray[np.int64]
    report: InputReport
    comments: tuple[str, ...]

    def keep(self, good: NDArray[np.bool_], text: str, how: Treatment = Treatment.LEFT_OUT) -> None:
        """Take out the rows that are not `good`."""
        if not good.all():
            bad = np.flatnonzero(~good)
            self.report.add(how, len(bad), text, self.shown(int(bad[0])))
            self.values, self.line = self.values[good], self.line[good]
            self.text = [cells for cells, kept in zip(self.text, good, strict=True) if kept]

    def shown(self, k: int) -> str:
        """Row `k` with its place."""
        return f"line {self.line[k]}: {', '.join(self.text[k])}"


def read_control_points(
    path: str | Path,
    datum: Datum | None = None,
    *,
    image_size: tuple[int, int] | None = None,
    strict: bool = False,
) -> ControlPoints:
    """Read `pixel_x,pixel_y,latitude,longitude` or `pixel_x,pixel_y,x_m,y_m`.

    Args:
        path: Text with a header line, in any spelling that `csv_text` takes; `NAMES` has the names
            of columns. Others are ignored.
        datum: Origin of the map frame. Default: the mean of the points when they are geodetic,
            None when they are in metres from an origin that nobody names.
        image_size: (width, height) of the image in pixels, for pixels in shares of it.
        strict: Whether any fault refuses the file.

    Raises:
        InputFileError: No such file, no such columns, or with `strict` any fault.
        CalibrationError: The points can't fix a ground plane (see `check_points`), or lie
            somewhere else than the datum.
    """
    place = str(path)
    table = _read_table(split_header(Path(path), EXPECTED), place)
    known = np.asarray(np.isfinite(table.values).all(axis=1))
    table.keep(known, "a value that is missing or no number")
    _repair_pixels(table, image_size)
    position = _positions(table, datum)
    if position is None:
        local_m = table.values[:, 2:]
    else:
        position = _near_each_other(table, position)
        if len(position):
            datum = datum or Datum(*(float(mean) for mean in position.mean(axis=0)))
            _check_datum(position, datum, table)
        local_m = datum.to_local(*position.T) if datum and len(position) else np.empty((0, 2))
    middle = np.median(local_m, axis=0) if len(local_m) else np.zeros(2)
    near = np.asarray(np.linalg.norm(local_m - middle, axis=1) <= MAX_EXTENT_M)
    table.keep(near, f"more than {MAX_EXTENT_M / 1000:g} km from the others")
    local_m = local_m[near]
    _, first = np.unique(np.hstack((table.values[:, :2], local_m)), axis=0, return_index=True)
    once = np.isin(np.arange(len(local_m)), first)
    table.keep(once, "the same point as in an earlier line")
    _note_contradictions(table)
    if strict:
        table.report.check(strict, EXPECTED)
    pixel, local_m = table.values[:, :2], local_m[once]
    points = ControlPoints(pixel, local_m, datum, table.line, place, table.report)
    check_points(points)
    return points


def _read_table(found: CsvBody, place: str) -> _Table:
    """The rows below the header."""
    at, geodetic = _columns(found, place)
    count, cells, lines = len(found.names), [], []
    reader = csv.reader(io.StringIO(found.body), delimiter=found.delimiter)
    try:
        for row in reader:
            if not any(cell.strip() for cell in row) or row[0].lstrip().startswith("#"):
                continue
            # A remark in the last column may have commas; elsewhere they move the values.
            moved = any(cell.strip() for cell in row[count:]) and max(at[:4]) == count - 1
            cells.append(tuple(row[k].strip() if not moved and k < len(row) else "" for k in at))
            lines.append(found.header_line + reader.line_num)
    except csv.Error as error:
        raise InputFileError(place, str(error), EXPECTED) from error
    numbers = [
        [_angle(cell) if geodetic and k > 1 else _number(cell) for k, cell in enumerate(row[:4])]
        for row in cells
    ]
    table = _Table(
        tuple(found.names[k] for k in at[2:4]),
        geodetic,
        np.array(numbers, dtype=np.float64).reshape(-1, 4),
        [row[:4] for row in cells],
        np.array(lines, dtype=np.int64),
        InputReport(place, "control points", len(cells)),
        found.comments,
    )
    if found.repaired:
        table.report.note(Treatment.REPAIRED, found.repaired)
    if len(at) > 4:
        switch = found.names[at[4]]
        said_no = np.array([row[4].lower() in _NO for row in cells], dtype=np.bool_)
        if _plain(switch) in NAMES["excluded"]:
            said_no = ~said_no & np.array([bool(row[4]) for row in cells], dtype=np.bool_)
        table.keep(~said_no, f"switched off in column '{switch}'", Treatment.NOTED)
    return table


def _columns(found: CsvBody, place: str) -> tuple[list[int], bool]:
    """Where pixel x and y, the ground and a switch stand; whether the ground is geodetic."""
    plain = [_plain(name) for name in found.names]
    bare = [_UNIT.sub("", name) for name in plain]

    def find(*roles: str) -> list[int]:
        at = []
        for role in roles:
            known = [names.index(n) for names in (plain, bare) for n in NAMES[role] if n in names]
            at += known[:1]
        return at if len(at) == len(roles) else []

    pixel, geodetic, plane = find(*PIXEL_COLUMNS), find(*GEODETIC_COLUMNS), find(*LOCAL_COLUMNS)
    small = [found.names.index(name) for name in "xy" if name in found.names]
    capital = [found.names.index(name) for name in "XY" if name in found.names]
    either = [pair for pair in (small, capital) if len(pair) == 2]
    if not pixel and either:
        pixel = either.pop(0)
    if not geodetic and not plane and either:
        plane = either.pop()
    if not pixel or not (geodetic or plane):
        raise InputFileError(
            f"{place}, line {found.header_line}",
            f"columns '{','.join(found.names)[:120]}'",
            EXPECTED,
        )
    switch = find("enable") or find("excluded")
    return [*pixel, *(geodetic or plane), *switch], bool(geodetic)


def _plain(name: str) -> str:
    return re.sub(r"[^\w]+", "_", name.strip().lower()).strip("_")


def _number(text: str) -> float:
    """A number, with a decimal point or comma; NaN for what is none."""
    text = text.replace("\N{MINUS SIGN}", "-")
    text = text.replace(",", ".") if text.count(",") == 1 and "." not in text else text
    return float(text) if _NUMBER.fullmatch(text) else float("nan")


def _angle(text: str) -> float:
    """Degrees, with minutes and seconds or without; NaN for what is none."""
    number = _number(text)
    plain = text.replace(",", ".").strip().upper().replace("M", "m")
    if blanks := _BLANKS.fullmatch(plain):
        start, degrees, minutes, seconds, end = blanks.groups()
        plain = f"{start}{degrees}°{minutes}'" + (f'{seconds}"' if seconds else "") + end
    found = _ANGLE.fullmatch(plain)
    if np.isfinite(number) or found is None:
        return number
    parts = [float(found[name] or 0.0) for name in ("d", "m", "s")]
    south_or_west = {found["before"], found["after"]} & {"S", "W"}
    sign = -1.0 if (found["sign"] == "-") != bool(south_or_west) else 1.0
    return sign * (parts[0] + parts[1] / 60.0 + parts[2] / 3600.0)


def _repair_pixels(table: _Table, image_size: tuple[int, int] | None) -> None:
    """Rows counted upwards, and shares of the image, become pixels."""
    pixel = table.values[:, :2]
    if not len(pixel):
        return
    if pixel[:, 1].max() <= 0.0 and pixel[:, 1].min() < 0.0:
        text = "pixels count upwards from 0, as QGIS writes them; their sign is changed"
        table.report.note(Treatment.REPAIRED, text)
        pixel[:, 1] *= -1.0
    if pixel.min() >= 0.0 and pixel.max() <= NORMALISED:
        found = "pixels in shares of the image (0 to 1)"
        if image_size is None:
            raise CalibrationError(table.report.place, found, "pixels")
        table.report.note(
            Treatment.REPAIRED, f"{found}; they are taken times {image_size[0]}x{image_size[1]}"
        )
        pixel *= image_size


def _positions(table: _Table, datum: Datum | None) -> Array | None:
    """(N, 2) latitude and longitude; None for metres from the datum."""
    xy, report = table.values[:, 2:], table.report
    if not len(xy):
        return xy if table.geodetic else None
    if table.geodetic:
        beyond = (xy[:, 1] > 180.0) & (xy[:, 1] <= 360.0)
        xy[beyond, 1] -= 360.0
        return xy
    names = ", ".join(table.names)
    projection = named_projection(table.comments, report.place)
    names = ", ".join(table.names)
    if projection is not None:
        text = f"{names} are coordinates of {projection.name}, as a comment says"
        report.note(Treatment.NOTED, text)
        return projection.to_geodetic(xy)
    if np.ptp(xy, axis=0).max() <= DEGREES_SPREAD and np.abs(xy).max() <= 180.0:
        report.note(Treatment.REPAIRED, f"{names} are degrees: taken as longitude and latitude")
        return xy[:, ::-1]
    return None if datum is None else _from_plane(table, datum)


def _from_plane(table: _Table, datum: Datum) -> Array | None:
    """(N, 2) latitude and longitude of points that are not counted from the datum, else None.

    Raises:
        CalibrationError: They are far from the datum, and in no projection near it.
    """
    xy, report = table.values[:, 2:], table.report
    away_m = float(np.hypot(*np.median(xy, axis=0)))
    if away_m <= NEAR_M:
        return None
    projection = projection_near(xy, datum, report.place)
    if projection is not None:
        order = " with the northing first" if projection.exchanged else ""
        text = f"{', '.join(table.names)} are coordinates of {projection.name}{order}"
        report.note(Treatment.REPAIRED, f"{text} ({projection.definition}), by their size")
        return projection.to_geodetic(xy)
    if away_m > FAR_M:
        raise CalibrationError(
            report.place,
            f"control points {away_m / 1000:.0f} km from the datum",
            "metres counted from it, or a line '# CRS: EPSG:…' above the header",
        )
    report.note(Treatment.NOTED, f"the points lie {away_m / 1000:.0f} km from the datum")
    return None


def _near_each_other(table: _Table, position: Array) -> Array:
    """Positions without those that lie elsewhere; exchanged ones are put right."""
    if not len(position):
        return position
    position = position.copy()
    text = "latitude and longitude exchanged; they are put right"
    on_road = np.abs(position[:, 0]) <= GEODETIC_BOUND_DEG
    if not on_road.any():
        table.report.note(Treatment.REPAIRED, text, table.shown(0))
        position = position[:, ::-1]
        on_road = np.abs(position[:, 0]) <= GEODETIC_BOUND_DEG
    if on_road.any():
        middle = np.median(position[on_road], axis=0)
        far = ~on_road | ~(_away_m(position, middle) <= MAX_EXTENT_M)
        turned = far & (_away_m(position[:, ::-1], middle) <= MAX_EXTENT_M)
        if turned.any():
            k = int(np.argmax(turned))
            table.report.add(Treatment.REPAIRED, int(turned.sum()), text, table.shown(k))
            position[turned] = position[turned][:, ::-1]
        on_road = ~far | turned
    table.keep(on_road, f"more than {MAX_EXTENT_M / 1000:g} km from the others")
    return position[on_road]


def _note_contradictions(table: _Table) -> None:
    """Say where one pixel has two positions, or one position two pixels."""
    for own, other in ((slice(0, 2), "position"), (slice(2, 4), "pixel")):
        values = np.unique(table.values[:, own], axis=0, return_index=True)[1]
        again = np.setdiff1d(np.arange(len(table.line)), values)
        if len(again):
            text = f"another {other} than in an earlier line; the fit decides between them"
            shown = table.shown(int(again[0]))
            table.report.add(Treatment.NOTED, len(again), text, shown)


def _away_m(position: Array, middle: Array) -> Array:
    """Metres (N,) between positions in degrees, near enough to tell metres from kilometres."""
    shrink = np.array([1.0, np.cos(np.radians(middle[0]))])
    return np.asarray(METRES_PER_DEG * np.hypot(*((position - middle) * shrink).T))


def _check_datum(position: Array, datum: Datum, table: _Table) -> None:
    """Refuse a datum of another place: one of the two is wrong."""
    middle, origin = np.median(position, axis=0), (datum.latitude_deg, datum.longitude_deg)
    away_m = ground_distance_m(middle, origin)
    if away_m > FAR_M:
        swapped = ground_distance_m(middle[::-1], origin) <= FAR_M
        hint = " (latitude and longitude exchanged in one of them?)" if swapped else ""
        raise CalibrationError(
            table.report.place,
            f"control points {away_m / 1000:.0f} km from the datum {origin[0]:g}, {origin[1]:g}",
            f"points and a datum of one place{hint}",
        )
    if away_m > NEAR_M:
        text = f"the points lie {away_m / 1000:.0f} km from the datum"
        table.report.note(Treatment.NOTED, text)
