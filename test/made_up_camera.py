"""A made-up camera: its calibration, its bag, and what is really on the road."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geoorbit_ros.core.tables import (
    FLAG_GROUND_POINT,
    PIXEL_TRACK_DTYPE,
    Frames,
    frames_from_rows,
)
from geoorbit_ros.storage.track_bag import write_track_bag

CAMERA_ID = "north"
IMAGE_SIZE = (1920, 1080)
START_NS = 1_700_000_000_000_000_000
FRAME_NS = 100_000_000
SPEED_M_S = 20.0
ROAD_M = 120.0
LANE_X_M = (-3.6, 0.0, 3.6)
VEHICLES_PER_LANE = 12
HEADWAY_S = 1.5

# A camera 10 m up looking north: u = 960 + f x / y, v = 100 + f h / y, y from 20 m on.
FOCAL_PX, HEIGHT_M, NEAREST_M = 1400.0, 10.0, 20.0


def to_pixel(x_m: Any, y_m: Any) -> tuple[Any, Any]:
    depth = y_m + NEAREST_M
    return 960.0 + FOCAL_PX * x_m / depth, 100.0 + FOCAL_PX * HEIGHT_M / depth


@dataclass(frozen=True)
class MadeUpCamera:
    camera_id: str
    calibration: Path
    bag: Path
    frames: Frames
    image_size: tuple[int, int]


def made_up_frames() -> Frames:
    """Three lanes northwards, ground points, ten frames a second."""
    stamps, tables = [], []
    for lane, lane_x_m in enumerate(LANE_X_M):
        for k in range(VEHICLES_PER_LANE):
            enters_s = HEADWAY_S * k + 0.5 * lane
            steps = np.arange(int(ROAD_M / SPEED_M_S * 1e9 / FRAME_NS))
            y_m = SPEED_M_S * steps * FRAME_NS / 1e9
            x_m = lane_x_m + 0.15 * np.sin(1.7 * k + lane + y_m / 40)
            rows = np.zeros(len(steps), PIXEL_TRACK_DTYPE)
            rows["x"], rows["y"] = to_pixel(x_m, y_m)
            rows["score"], rows["class_id"], rows["flags"] = 0.9, 2, FLAG_GROUND_POINT
            rows["track_id"] = 1 + lane * VEHICLES_PER_LANE + k
            stamps.append(START_NS + (round(enters_s * 1e9 / FRAME_NS) + steps) * FRAME_NS)
            tables.append(rows)
    return frames_from_rows(np.concatenate(stamps), np.concatenate(tables))


def make_camera(folder: Path) -> MadeUpCamera:
    """Write calibration and bag into a folder."""
    calibration = folder / "calibration.csv"
    lines = ["pixel_x,pixel_y,latitude,longitude"]
    latitude, longitude = 43.05, -89.35
    for x_m in (-8.0, 8.0):
        for y_m in (0.0, 30.0, 70.0, 120.0):
            u, v = to_pixel(x_m, y_m)
            # Degrees of a sphere are good to 0.5 %: the homography takes up the difference.
            lat = latitude + y_m / 111_195
            lon = longitude + x_m / (111_195 * np.cos(np.radians(latitude)))
            lines.append(f"{u:.4f},{v:.4f},{lat:.9f},{lon:.9f}")
    calibration.write_text("\n".join(lines) + "\n")
    frames = made_up_frames()
    bag = folder / "bag"
    write_track_bag(bag, CAMERA_ID, frames)
    return MadeUpCamera(CAMERA_ID, calibration, bag, frames, IMAGE_SIZE)
