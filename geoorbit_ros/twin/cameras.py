"""What the bridge is told about its cameras, read and checked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_points import read_control_points
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.twin.view import view_polygon


@dataclass(frozen=True, slots=True)
class CameraView:
    """A camera's name, the origin of its map frame, and the ground it sees in that frame."""

    name: str
    datum: Datum
    polygon_m: NDArray[np.float64]


def split_names(text: str, place: str) -> list[str]:
    """Names separated by spaces, each once.

    Raises:
        ParameterError: None, or one twice.
    """
    names = [name.strip("/") for name in text.split()]
    if not names or len(set(names)) < len(names):
        raise ParameterError(place, f"'{text}'", "different names, separated by spaces")
    return names


def read_views(
    cameras: list[str], calibrations: str, image_size: tuple[int, int], place: str
) -> list[CameraView]:
    """The cameras' views by their control point files, none when no file is given.

    Raises:
        GeoOrbitError: A file that can't be used, or not one file per camera.
    """
    files = calibrations.split()
    if files and len(files) != len(cameras):
        found = f"{len(files)} files for {len(cameras)} cameras"
        raise ParameterError(place, found, "one file per camera, in the same order")
    views = []
    for name, file in zip(cameras, files, strict=False):
        points = read_control_points(file, None)
        if points.datum is None:
            raise InputFileError(file, "control points in metres", "latitudes and longitudes")
        polygon = view_polygon(fit_homography(points), image_size)
        views.append(CameraView(name, points.datum, polygon))
    return views
