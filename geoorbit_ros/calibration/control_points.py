"""Reads the ground control points that tie a camera's pixels to the road."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import CalibrationError, InputFileError

PIXEL_COLUMNS = ("pixel_x", "pixel_y")
GEODETIC_COLUMNS = ("latitude", "longitude")
GEODETIC_BOUNDS_DEG = (80.0, 180.0)
"""No road leads beyond 80 degrees of latitude: a larger one is a longitude."""
LOCAL_COLUMNS = ("x_m", "y_m")

MIN_POINTS = 4
"""A homography has eight degrees of freedom, a point fixes two."""
MAX_EXTENT_M = 5000.0
"""No roadside camera resolves a vehicle this far away: a point beyond is a typing error."""
MIN_BREADTH = 0.005
"""Minor over major axis of the point cloud. Below it the points are one line within survey error:
0.5 m across on 100 m."""


@dataclass(frozen=True, slots=True)
class ControlPoints:
    """Points on the road surface whose pixel and position are both known.

    Attributes:
        pixel: (N, 2) float64, image x to the right and y down, pixels.
        local_m: (N, 2) float64, metres east and north in the map frame.
        datum: Where the map frame's origin is; None when the file has metres and none was given.
        line_number: (N,) int64, line of each point in its file, for messages.
        place: The file's name, for messages.
    """

    pixel: NDArray[np.float64]
    local_m: NDArray[np.float64]
    datum: Datum | None
    line_number: NDArray[np.int64]
    place: str = "control points"

    def __len__(self) -> int:
        return len(self.pixel)


def read_control_points(path: str | Path, datum: Datum | None = None) -> ControlPoints:
    """Read `pixel_x,pixel_y,latitude,longitude` or `pixel_x,pixel_y,x_m,y_m`.

    Args:
        path: CSV file, UTF-8, one header line. Other columns are ignored, as are blank lines.
        datum: Origin of the map frame. Default: the mean of the points when they are geodetic,
            None when they are already in metres.

    Raises:
        InputFileError: The file, a column or a value can't be read.
        CalibrationError: The points can't fix a ground plane (see `check_points`).
    """
    place = str(path)
    columns, cells, line_number = _read_cells(Path(path), place)
    values = np.array(cells, dtype=np.float64).reshape(-1, len(columns))
    if columns[2:] == GEODETIC_COLUMNS:
        limits = zip(GEODETIC_COLUMNS, GEODETIC_BOUNDS_DEG, strict=True)
        for k, (column, bound) in enumerate(limits):
            bad = np.flatnonzero(np.abs(values[:, 2 + k]) > bound)
            if len(bad):
                raise InputFileError(
                    f"{place}, line {line_number[bad[0]]}, column '{column}'",
                    f"{values[bad[0], 2 + k]:g}",
                    f"degrees from {-bound:g} to {bound:g} (latitude and longitude swapped?)",
                )
        if datum is None and len(values):
            datum = Datum(*(float(mean) for mean in values[:, 2:].mean(axis=0)))
        local_m = np.empty((0, 2)) if datum is None else datum.to_local(values[:, 2], values[:, 3])
    else:
        local_m = values[:, 2:]
    points = ControlPoints(
        values[:, :2], local_m, datum, np.array(line_number, dtype=np.int64), place
    )
    check_points(points)
    return points


def check_points(points: ControlPoints) -> None:
    """Refuse points that can't fix a plane, whatever method fits it.

    Raises:
        CalibrationError: Fewer than four points, values that aren't finite, two points on one
            spot, points kilometres apart, or all points on one line.
    """
    if len(points) < MIN_POINTS:
        raise CalibrationError(
            points.place, f"{len(points)} control points", f"at least {MIN_POINTS}"
        )
    for name, xy in (("pixel", points.pixel), ("ground", points.local_m)):
        finite = np.isfinite(xy).all(axis=1)
        if not finite.all():
            k = int(np.argmin(finite))
            raise CalibrationError(
                f"{points.place}, line {points.line_number[k]}", xy[k].tolist(), "finite numbers"
            )
        _, first, group = np.unique(xy, axis=0, return_index=True, return_inverse=True)
        repeated = np.flatnonzero(first[group.ravel()] != np.arange(len(xy)))
        if len(repeated):
            k = int(repeated[0])
            raise CalibrationError(
                f"{points.place}, line {points.line_number[k]}",
                f"the {name} position of line {points.line_number[first[group.ravel()[k]]]} again",
                "every control point once",
            )
    distance = np.hypot(*(points.local_m - np.median(points.local_m, axis=0)).T)
    if distance.max() > MAX_EXTENT_M:
        k = int(np.argmax(distance))
        raise CalibrationError(
            f"{points.place}, line {points.line_number[k]}",
            f"a point {distance[k] / 1000:.1f} km from the others",
            f"points within {MAX_EXTENT_M / 1000:g} km",
        )
    for name, xy in (("pixel", points.pixel), ("ground", points.local_m)):
        axis = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
        if axis[1] < MIN_BREADTH * axis[0]:
            raise CalibrationError(
                points.place,
                f"{len(points)} points whose {name} positions lie on one line",
                "points spread over the road in both directions",
            )


def _read_cells(path: Path, place: str) -> tuple[tuple[str, ...], list[list[float]], list[int]]:
    """Numbers of the four columns, line by line."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            header = [name.strip() for name in next(reader, [])]
            columns = _columns(header, place)
            index = [header.index(name) for name in columns]
            cells, line_number = [], []
            for row in reader:
                if not any(cell.strip() for cell in row):
                    continue
                here = f"{place}, line {reader.line_num}"
                if len(row) < len(header):
                    raise InputFileError(here, f"{len(row)} values", f"{len(header)}, as above")
                cells.append(
                    [
                        _number(row[k], f"{here}, column '{c}'")
                        for k, c in zip(index, columns, strict=True)
                    ]
                )
                line_number.append(reader.line_num)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputFileError(place, reason, "a readable UTF-8 CSV file") from error
    return columns, cells, line_number


def _columns(header: list[str], place: str) -> tuple[str, ...]:
    for ground in (GEODETIC_COLUMNS, LOCAL_COLUMNS):
        if set(PIXEL_COLUMNS + ground) <= set(header):
            return PIXEL_COLUMNS + ground
    expected = " or ".join(
        f"'{','.join(PIXEL_COLUMNS + ground)}'" for ground in (GEODETIC_COLUMNS, LOCAL_COLUMNS)
    )
    raise InputFileError(
        f"{place}, line 1",
        f"columns '{','.join(header)}'" if header else "an empty file",
        f"the columns {expected}",
    )


def _number(cell: str, place: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputFileError(place, f"'{cell}'", "a finite number")
    return value
