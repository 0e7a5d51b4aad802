"""Reads control points as people write them: used, repaired or left out, and told.

A file is refused only when too few points are left, or when it isn't clear where on Earth they lie.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_facts import read_facts, same_view
from geoorbit_ros.calibration.control_point_table import EXPECTED, PointTable, read_point_table
from geoorbit_ros.calibration.control_points import MAX_EXTENT_M, ControlPoints, check_points
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.projections import (
    FAR_M,
    NEAR_M,
    ground_distance_m,
    named_projection,
    projection_near,
)
from geoorbit_ros.core.errors import CalibrationError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.storage.tracks.csv_text import split_header

Array = NDArray[np.float64]

GEODETIC_BOUND_DEG = 80.0
"""No road leads beyond 80 degrees of latitude: a larger one is a longitude."""
METRES_PER_DEG = 111_320.0
"""Along the equator (WGS 84); along a meridian it is within 0.6 %."""
DEGREES_SPREAD = 1.0
"""Ground coordinates that lie this close together are degrees, not metres: no road fits into a
square metre, and a degree is a hundred kilometres. A single point says nothing."""
NORMALISED = 1.5
"""Pixels that are all below this are shares of the image: no road fits into two pixels."""
OFF_MIDDLE = 0.15
"""Principal points farther from the image's middle, in its width or height, are told. Chosen: half
a percent is usual, two are many; numbers of 1280x720 in an image of 1920x1080 are off by 0.17."""


def read_control_points(
    path: str | Path,
    datum: Datum | None = None,
    *,
    image_size: tuple[int, int] | None = None,
    strict: bool = False,
    few: bool = False,
) -> ControlPoints:
    """Read `pixel_x,pixel_y,latitude,longitude` or `pixel_x,pixel_y,x_m,y_m`.

    Args:
        path: Text with a header line, in any spelling that `csv_text` takes; `NAMES` has the names
            of columns. Others are ignored.
        datum: Origin of the map frame. Default: the mean of the points when they are geodetic,
            None when they are in metres from an origin that nobody names.
        image_size: (width, height) of the camera's images in pixels. Points of a file that says
            another size are scaled to it; pixels in shares of the image are taken times it.
        strict: Whether any fault refuses the file.
        few: Whether points will do that fix no plane.

    Raises:
        InputFileError: No such file, no such columns, or with `strict` any fault.
        CalibrationError: The points can't fix a ground plane (see `check_points`), lie somewhere
            else than the datum, or are of an image that is no larger or smaller one of this view.
    """
    place = str(path)
    table = read_point_table(split_header(Path(path), EXPECTED), place)
    table.keep(np.isfinite(table.values).min(axis=1), "a value that is missing or no number")
    facts = read_facts(table.comments, place, image_size)
    _repair_pixels(table, facts.image_size or image_size)
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
    near = np.linalg.norm(local_m - middle, axis=1) <= MAX_EXTENT_M
    table.keep(near, f"more than {MAX_EXTENT_M / 1000:g} km from the others")
    local_m = local_m[near]
    first = np.unique(np.hstack((table.values[:, :2], local_m)), axis=0, return_index=True)[1]
    once = np.isin(np.arange(len(local_m)), first)
    table.keep(once, "the same point as in an earlier line")
    _note_contradictions(table)
    pixel, local_m = table.values[:, :2], local_m[once]
    sigmas = table.sigma.T if np.isfinite(table.sigma).any() else (None, None)
    points = ControlPoints(
        pixel, local_m, datum, table.line, place, table.report, facts, facts.image_size, *sigmas
    )
    points = points if image_size is None else of_images(points, image_size)
    note_odd_lens(points.report, points.facts.lens, "line '# lens:'")
    if strict:
        points.report.check(strict, EXPECTED)
    if not few:
        check_points(points)
    return points


def note_odd_lens(report: InputReport, lens: Lens | None, place: str) -> None:
    """Say what hardly any lens is, and what numbers of another image size look like.

    Args:
        report: Of the control points.
        lens: Scaled to the image; None: nothing is to be said.
        place: Where it is from, for people.
    """
    if lens is None:
        return
    width, height = lens.image_size
    off = abs(lens.cx / width - 0.5), abs(lens.cy / height - 0.5)
    if max(off) > OFF_MIDDLE:
        text = (
            f"{place}: the principal point ({lens.cx:.0f}, {lens.cy:.0f}) is far from the middle "
            f"of the {width}x{height} image: is the lens that of images of this size?"
        )
        report.note(Treatment.NOTED, text)
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)], dtype=np.float64)
    lost = ~np.isfinite(lens.undistort(corners)).all(axis=1)
    if lost.any():
        text = (
            f"{place}: the lens model ends within the image, {lost.sum()} of its 4 corners lie "
            "beyond: boxes there have no place"
        )
        report.note(Treatment.NOTED, text)


def _repair_pixels(table: PointTable, image_size: tuple[int, int] | None) -> None:
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


def of_images(points: ControlPoints, image_size: tuple[int, int]) -> ControlPoints:
    """Points and facts in pixels of images of a size; told where that isn't the points' own.

    Raises:
        CalibrationError: Images of the two sizes can't show the same view.
    """
    said = points.image_size
    if said is None or said == image_size:
        return points if said else replace(points, image_size=image_size)
    of, to = (f"{size[0]}x{size[1]}" for size in (said, image_size))
    if not same_view(said, image_size):
        raise CalibrationError(
            points.place,
            f"control points of a {of} image, as a comment says",
            f"those of the camera's images, which are {to}: not the same view in another size",
        )
    text = f"the control points are of a {of} image; they are scaled to {to}"
    points.report.note(Treatment.REPAIRED, text)
    scale = np.divide(image_size, said)
    sigma = None if points.sigma_px is None else points.sigma_px * np.sqrt(scale.prod())
    return replace(
        points,
        pixel=points.pixel * scale,
        sigma_px=sigma,
        facts=points.facts.scaled(image_size),
        image_size=image_size,
    )


def _positions(table: PointTable, datum: Datum | None) -> Array | None:
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
    near = len(np.unique(xy, axis=0)) > 1 and np.ptp(xy, axis=0).max() <= DEGREES_SPREAD
    if near and np.abs(xy).max() <= 180.0:
        report.note(Treatment.REPAIRED, f"{names} are degrees: taken as longitude and latitude")
        return xy[:, ::-1]
    return None if datum is None else _from_plane(table, datum)


def _from_plane(table: PointTable, datum: Datum) -> Array | None:
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


def _near_each_other(table: PointTable, position: Array) -> Array:
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


def _note_contradictions(table: PointTable) -> None:
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


def _check_datum(position: Array, datum: Datum, table: PointTable) -> None:
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
