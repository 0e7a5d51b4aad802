"""The rows of a control point file as numbers, whatever its columns are called."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_points import (
    GEODETIC_COLUMNS,
    LOCAL_COLUMNS,
    PIXEL_COLUMNS,
    SIGMA_COLUMNS,
)
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.storage.tracks.csv_text import CsvBody

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
SIGMA_BOUNDS = ((0.01, 0.001), (1e4, 1e3))
"""Least and largest 1-sigma, pixels and metres. Chosen: nobody clicks to a hundredth of a pixel, or
surveys a road to a millimetre; smaller lets one point decide alone, larger says as little."""
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
class PointTable:
    """The rows of a file while they are being checked.

    Attributes:
        names: Of the two ground columns as the file has them.
        geodetic: These are latitude and longitude.
        values: (N, 4) numbers, pixel and ground; NaN where there is none.
        text: The cells as they are written.
        line: (N,) where each row stands.
        report: What was done.
        comments: Above the header and below it.
        sigma: (N, 2) 1-sigma of each point in pixels and in metres; NaN where it isn't said.
    """

    names: tuple[str, ...]
    geodetic: bool
    values: Array
    text: list[tuple[str, ...]]
    line: NDArray[np.int64]
    report: InputReport
    comments: tuple[str, ...]
    sigma: Array

    def keep(self, good: NDArray[np.bool_], text: str, how: Treatment = Treatment.LEFT_OUT) -> None:
        """Take out the rows that are not `good`."""
        if not good.all():
            bad = np.flatnonzero(~good)
            self.report.add(how, len(bad), text, self.shown(int(bad[0])))
            self.values, self.line = self.values[good], self.line[good]
            self.sigma = self.sigma[good]
            self.text = [cells for cells, kept in zip(self.text, good, strict=True) if kept]

    def shown(self, k: int) -> str:
        """Row `k` with its place."""
        return f"line {self.line[k]}: {', '.join(self.text[k])}"


def read_point_table(found: CsvBody, place: str) -> PointTable:
    """The rows below the header.

    Raises:
        InputFileError: No such columns, or no CSV at all.
    """
    at, sigma_at, geodetic = _columns(found, place)
    count, cells, lines, sigmas = len(found.names), [], [], []
    reader = csv.reader(io.StringIO(found.body), delimiter=found.delimiter)
    try:
        for row in reader:
            if not any(cell.strip() for cell in row) or row[0].lstrip().startswith("#"):
                continue
            # A remark in the last column may have commas; elsewhere they move the values.
            last = max([*at[:4], *(k for k in sigma_at if k is not None)])
            moved = any(cell.strip() for cell in row[count:]) and last == count - 1
            cells.append(tuple(row[k].strip() if not moved and k < len(row) else "" for k in at))
            lines.append(found.header_line + reader.line_num)
            sigmas.append(["" if k is None or k >= len(row) else row[k].strip() for k in sigma_at])
    except csv.Error as error:
        raise InputFileError(place, str(error), EXPECTED) from error
    numbers = [
        [_angle(cell) if geodetic and k > 1 else _number(cell) for k, cell in enumerate(row[:4])]
        for row in cells
    ]
    table = PointTable(
        tuple(found.names[k] for k in at[2:4]),
        geodetic,
        np.array(numbers, dtype=np.float64).reshape(-1, 4),
        [row[:4] for row in cells],
        np.array(lines, dtype=np.int64),
        InputReport(place, "control points", len(cells)),
        all_comments(found),
        np.array([[_number(cell) for cell in row] for row in sigmas]).reshape(-1, 2),
    )
    _check_sigmas(table, sigmas)
    if found.repaired:
        table.report.note(Treatment.REPAIRED, found.repaired)
    if len(at) > 4:
        switch = found.names[at[4]]
        said_no = np.array([row[4].lower() in _NO for row in cells], dtype=np.bool_)
        if _plain(switch) in NAMES["excluded"]:
            said_no = ~said_no & np.array([bool(row[4]) for row in cells], dtype=np.bool_)
        table.keep(~said_no, f"switched off in column '{switch}'", Treatment.NOTED)
    return table


def _check_sigmas(table: PointTable, cells: list[list[str]]) -> None:
    """NaN for sigmas that are none, and those that nobody has put at `SIGMA_BOUNDS`; told."""
    odd = np.array([any(row) for row in cells], dtype=np.bool_)
    odd &= ~((table.sigma > 0.0) | [[not cell for cell in row] for row in cells]).all(axis=1)
    if odd.any():
        k = int(np.argmax(odd))
        text = "a sigma that is no positive number; the usual one is taken"
        table.report.add(Treatment.REPAIRED, int(odd.sum()), text, table.shown(k))
    table.sigma[~(table.sigma > 0.0)] = np.nan
    bounded = np.clip(table.sigma, *SIGMA_BOUNDS)
    beyond = ((bounded != table.sigma) & np.isfinite(table.sigma)).any(axis=1)
    if beyond.any():
        k = int(np.argmax(beyond))
        (least_px, least_m), (most_px, most_m) = SIGMA_BOUNDS
        text = f"a sigma beyond {least_px:g} to {most_px:g} px, {least_m:g} to {most_m:g} m; "
        text += "the bound is taken"
        table.report.add(Treatment.REPAIRED, int(beyond.sum()), text, table.shown(k))
    table.sigma = bounded


def all_comments(found: CsvBody) -> tuple[str, ...]:
    """Comment lines above the header and below it."""
    below = (line.strip() for line in found.body.splitlines() if line.lstrip().startswith("#"))
    return (*found.comments, *below)


def _columns(found: CsvBody, place: str) -> tuple[list[int], list[int | None], bool]:
    """Where pixel x and y, the ground and a switch stand; the sigmas; whether it is geodetic."""
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
    sigma = [plain.index(name) if name in plain else None for name in SIGMA_COLUMNS]
    return [*pixel, *(geodetic or plane), *switch], sigma, bool(geodetic)


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
