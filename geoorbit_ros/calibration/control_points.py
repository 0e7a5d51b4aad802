"""The ground control points that tie a camera's pixels to the road."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_facts import NO_FACTS, CameraFacts
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import CalibrationError, InputFileError
from geoorbit_ros.core.input_report import InputReport, Treatment

PIXEL_COLUMNS = ("pixel_x", "pixel_y")
GEODETIC_COLUMNS = ("latitude", "longitude")
LOCAL_COLUMNS = ("x_m", "y_m")
SIGMA_COLUMNS = ("sigma_px", "sigma_m")

MIN_POINTS = 4
"""A homography has eight degrees of freedom, a point fixes two."""
MAX_EXTENT_M = 5000.0
"""No roadside camera resolves a vehicle this far away: a point beyond is a typing error."""
MIN_BREADTH = 0.005
"""Minor over major axis of the point cloud. Below it the points are one line within survey error:
0.5 m across on 100 m."""


def _no_report() -> InputReport:
    return InputReport("control points", "control points")


@dataclass(frozen=True, slots=True)
class ControlPoints:
    """Points on the road surface whose pixel and position are both known.

    Attributes:
        pixel: (N, 2) float64, image x to the right and y down, pixels.
        local_m: (N, 2) float64, metres east and north in the map frame.
        datum: Where the map frame's origin is; None when the file has metres and none was given.
        line_number: (N,) int64, line of each point in its file, for messages.
        place: The file's name, for messages.
        report: What was done with the rows of the file.
        facts: What is said about the camera: its lens, a common error of the scale.
        image_size: (width, height) of the image that `pixel` is of; None: nobody says.
        sigma_px: (N,) 1-sigma of each pixel coordinate, NaN where it isn't known; None: nowhere.
        sigma_m: (N,) 1-sigma of each ground coordinate in metres, likewise.
    """

    pixel: NDArray[np.float64]
    local_m: NDArray[np.float64]
    datum: Datum | None
    line_number: NDArray[np.int64]
    place: str = "control points"
    report: InputReport = field(default_factory=_no_report, compare=False)
    facts: CameraFacts = NO_FACTS
    image_size: tuple[int, int] | None = None
    sigma_px: NDArray[np.float64] | None = None
    sigma_m: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.pixel)

    def need_datum(self, expected: str) -> Datum:
        """The datum, where nothing can be done without.

        Args:
            expected: What would give one, for the error.

        Raises:
            InputFileError: The points are in metres, and nobody said from where.
        """
        if self.datum is not None:
            return self.datum
        away_km = float(np.hypot(*np.median(self.local_m, axis=0))) / 1000.0
        found = "control points in metres"
        if away_km > MAX_EXTENT_M / 1000.0:
            found += f", {away_km:.0f} km from (0, 0) as in a map projection"
            expected += ", or a line '# CRS: EPSG:…' above the header"
        raise InputFileError(self.place, found, expected)


def check_points(points: ControlPoints) -> None:
    """Refuse points that can't fix a plane, whatever method fits it.

    Raises:
        CalibrationError: Fewer than four points, values that aren't finite, points kilometres
            apart, or all points on one line.
    """
    for name, xy in (("pixel", points.pixel), ("ground", points.local_m)):
        _, first, group = np.unique(xy, axis=0, return_index=True, return_inverse=True)
        if len(first) >= MIN_POINTS:
            continue
        found = f"{len(first)} control points"
        if len(first) < len(xy):
            k = int(np.setdiff1d(np.arange(len(xy)), first)[0])
            again, before = points.line_number[[k, first[group.ravel()[k]]]]
            found += f" (line {again} has the {name} position of line {before} again)"
        lost = [r for r in points.report.remarks if r.treatment is Treatment.LEFT_OUT]
        if lost:
            found += f" ({lost[0].sentence(points.report.total, 'rows')})"
        raise CalibrationError(points.place, found, f"at least {MIN_POINTS}")
    for xy in (points.pixel, points.local_m):
        finite = np.isfinite(xy).all(axis=1)
        if not finite.all():
            k = int(np.argmin(finite))
            raise CalibrationError(
                f"{points.place}, line {points.line_number[k]}", xy[k].tolist(), "finite numbers"
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
