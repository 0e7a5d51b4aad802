"""Converts poses from the map frame (east, north, up; REP-103) to CARLA's (x east, y south, z up).

CARLA's axes are left-handed: yaw is clockwise seen from above, pitch up, roll clockwise seen from
behind; in degrees.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_pose import CameraPose
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import CalibrationError, RoadNetworkError


@dataclass(frozen=True, slots=True)
class CarlaPose:
    """Location in metres and rotation in degrees, as CARLA counts them."""

    x: float
    y: float
    z: float
    pitch_deg: float
    yaw_deg: float
    roll_deg: float


@dataclass(frozen=True, slots=True)
class CarlaCamera:
    """A camera in CARLA's terms: pose, size of its images, horizontal field of view.

    `left_out` says what of the real camera its images don't have; empty for nothing.
    """

    name: str
    pose: CarlaPose
    image_size: tuple[int, int]
    fov_deg: float
    left_out: str = ""


def read_opendrive(path: str | Path) -> tuple[str, Datum]:
    """Read an OpenDRIVE road and its datum.

    Raises:
        RoadNetworkError: No such file, no OpenDRIVE, or no `+proj=tmerc` georeference.
    """
    place = str(path)
    try:
        text = Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        problem = (error.strerror or "no file").lower()
        raise RoadNetworkError(place, problem, "an OpenDRIVE file") from None
    if "<OpenDRIVE" not in text:
        raise RoadNetworkError(place, "no OpenDRIVE", "a road.xodr of geoorbit map build")
    found = re.search(r"<geoReference>(.*?)</geoReference>", text, re.S)
    values = dict(re.findall(r"\+(proj|lat_0|lon_0)=([^\s\]]+)", found[1] if found else ""))
    try:
        if values["proj"] != "tmerc":
            raise KeyError("proj")
        return text, Datum(float(values["lat_0"]), float(values["lon_0"]))
    except (KeyError, ValueError, CalibrationError):
        said = f"georeference '{found[1].strip()[:80]}'" if found else "no georeference"
        raise RoadNetworkError(place, said, "+proj=tmerc with lat_0 and lon_0") from None


def vehicle_pose(x_m: float, y_m: float, heading_rad: float) -> CarlaPose:
    """Pose of a vehicle by the middle of its footprint."""
    return CarlaPose(x_m, -y_m, 0.0, 0.0, -math.degrees(heading_rad), 0.0)


def camera_pose(
    name: str,
    pose: CameraPose,
    image_size: tuple[int, int],
    origin_m: NDArray[np.float64],
) -> CarlaCamera:
    """Pose and field of view of a roadside camera by its calibration.

    Args:
        name: The camera's.
        pose: In the camera's own map frame.
        image_size: Width and height in pixels.
        origin_m: (2,) origin of that frame in the road's.
    """
    right, forward = pose.rotation[0], pose.rotation[2]
    yaw = math.atan2(forward[1], forward[0])
    pitch = math.asin(float(np.clip(forward[2], -1.0, 1.0)))
    # Without roll the right side is level; a roll turns it down, clockwise seen from behind.
    level = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    below = np.cross(forward, level)
    roll = math.atan2(float(right @ below), float(right @ level))
    x, y = pose.position_m[:2] + origin_m
    left_out = ""
    if pose.lens is not None and not pose.lens.straight:
        left_out = (
            f"{name}: CARLA's images are those of a pinhole; the lens (k1 = {pose.lens.k1:.3f}) is "
            "left out, so that pixels differ from the real camera's away from the image's middle"
        )
    return CarlaCamera(
        name,
        CarlaPose(
            float(x),
            -float(y),
            float(pose.position_m[2]),
            math.degrees(pitch),
            -math.degrees(yaw),
            math.degrees(roll),
        ),
        image_size,
        math.degrees(2.0 * math.atan(0.5 * image_size[0] / pose.focal_px)),
        left_out,
    )
