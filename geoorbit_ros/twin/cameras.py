"""Reads and checks what the parameters say about cameras: names, calibrations, image sizes."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_pose import recover_pose
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.roadnet.reference_lanes import view_polygon
from geoorbit_ros.twin.carla.frame import CarlaCamera, camera_pose


@dataclass(frozen=True, slots=True)
class CameraView:
    """The ground that a camera sees, and its calibration.

    Attributes:
        datum: Origin of the polygon's frame: the middle of the control points.
        polygon_m: (V, 2) corners.
        homography: Image to that frame.
        image_size: Width and height in pixels.
    """

    datum: Datum
    polygon_m: NDArray[np.float64]
    homography: Homography
    image_size: tuple[int, int]

    def polygon_in(self, datum: Datum) -> NDArray[np.float64]:
        """The corners in the map frame of another datum: that of the camera's tracks."""
        return datum.to_local(*self.datum.to_geodetic(self.polygon_m).T)


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
    cameras: list[str], calibrations: str, image_sizes: str, place: str
) -> dict[str, CameraView]:
    """The cameras' views by their control point files, none when no file is given.

    Args:
        cameras: Names.
        calibrations: One file per camera, separated by spaces.
        image_sizes: `1920x1080` of all cameras, or one such for each.
        place: For errors.

    Raises:
        GeoOrbitError: A file or size that can't be used, or not one per camera.
    """
    files, sizes = calibrations.split(), _sizes(image_sizes, len(cameras), place)
    if files and len(files) != len(cameras):
        found = f"{len(files)} files for {len(cameras)} cameras"
        raise ParameterError(f"{place}'calibrations'", found, "one file per camera, in their order")
    views = {}
    for name, file, size in zip(cameras, files, sizes, strict=False):
        points = read_control_points(file, None, image_size=size)
        datum = points.need_datum("latitudes and longitudes")
        homography = fit_homography(points)
        polygon = view_polygon(homography, size)
        views[name] = CameraView(datum, polygon, homography, size)
    return views


def read_carla_cameras(
    cameras: list[str], calibrations: str, image_sizes: str, place: str, origin: Datum
) -> list[CarlaCamera]:
    """The cameras in CARLA's terms, in the frame of a road.

    Args:
        cameras: Names.
        calibrations: One file per camera, separated by spaces.
        image_sizes: `1920x1080` of all cameras, or one such for each.
        place: For errors.
        origin: Origin of the road's frame.

    Raises:
        GeoOrbitError: A file or size that can't be used, not one per camera, or control points that
            do not determine the camera's height.
    """
    files, found = calibrations.split(), []
    if len(files) != len(cameras):
        said = f"{len(files)} files for {len(cameras)} cameras"
        raise ParameterError(f"{place}'calibrations'", said, "one file per camera, in their order")
    sizes = _sizes(image_sizes, len(cameras), place) if cameras else []
    for name, file, size in zip(cameras, files, sizes, strict=True):
        points = read_control_points(file, None, image_size=size)
        datum = points.need_datum("latitudes and longitudes")
        pose = recover_pose(fit_homography(points), size)
        at = origin.to_local(datum.latitude_deg, datum.longitude_deg)[0]
        found.append(camera_pose(name, pose, size, at))
    return found


def _sizes(text: str, cameras: int, place: str) -> list[tuple[int, int]]:
    sizes = [re.fullmatch(r"([1-9]\d{1,4})x([1-9]\d{1,4})", word) for word in text.split()]
    found = [(int(size[1]), int(size[2])) for size in sizes if size]
    if len(found) != len(sizes) or len(found) not in (1, cameras):
        expected = "WIDTHxHEIGHT of all cameras, or one for each, separated by spaces"
        raise ParameterError(f"{place}'image_sizes'", f"'{text}'", expected)
    return found * (cameras if len(found) == 1 else 1)
