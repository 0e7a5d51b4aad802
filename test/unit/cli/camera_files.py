"""A small camera on disk: two lanes, thirty vehicles, known truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.lanes.geojson import write_lanes

DATUM = Datum(43.0, -89.0)
LANE_Y_M = {1: 0.0, 2: -3.5}
FPS = 10.0


@dataclass(frozen=True)
class CameraFiles:
    """Paths of one camera's files."""

    folder: Path
    tracks: Path
    calibration: Path
    truth: Path


def to_pixel(local_m: np.ndarray) -> np.ndarray:
    """A pinhole camera at (-20, -30, 12) that looks along the road, f = 1000 px."""
    position = np.array([-20.0, -30.0, 12.0])
    forward = np.array([50.0, 0.0, 0.0]) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    relative = np.column_stack((local_m, np.zeros(len(local_m)))) - position
    axes = np.stack((right, np.cross(forward, right), forward))
    seen = relative @ axes.T
    return np.asarray(1000.0 * seen[:, :2] / seen[:, 2:] + np.array([960.0, 540.0]))


def write_tracks(path: Path, vehicles_per_lane: int = 15) -> None:
    """Vehicles at 15 m/s, one every 2.5 s in each lane, as points on the ground."""
    rng = np.random.default_rng(4)
    rows = []
    for n in range(vehicles_per_lane):
        for lane_id, y_m in LANE_Y_M.items():
            wander = rng.normal(scale=0.2)
            start_s = 2.5 * n + 1.1 * lane_id
            time_s = np.arange(np.ceil(start_s * FPS), (start_s + 8.0) * FPS) / FPS
            x_m = 15.0 * (time_s - start_s)
            pixel = to_pixel(np.column_stack((x_m, np.full_like(x_m, y_m + wander))))
            for t, (u, v) in zip(time_s, pixel, strict=True):
                rows.append((t, round(t * FPS), 10 * n + lane_id, u, v))
    rows.sort()
    lines = ["id,time,frame_num,class,conf,x,y,w,h"]
    lines += [f"{k},{t:.1f},{f},2,0.9,{u:.2f},{v:.2f},0,0" for t, f, k, u, v in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def truth_lane(lane_id: int, y_m: float) -> Lane:
    center = np.column_stack((np.linspace(0.0, 115.0, 30), np.full(30, y_m)))
    sides = offset_line(center, 1.75), offset_line(center, -1.75)
    return Lane(lane_id, center, *sides, 3.5, 0.0, 1.0, "confirmed", 15.0)


def write_camera(folder: Path) -> CameraFiles:
    files = CameraFiles(folder, *(folder / n for n in ("tracks.csv", "gcp.csv", "truth.geojson")))
    write_tracks(files.tracks)
    ground = np.array([(x, y) for x in (0.0, 25.0, 60.0, 110.0) for y in (-8.0, 0.0, 6.0)])
    geodetic = DATUM.to_geodetic(ground)
    lines = ["pixel_x,pixel_y,latitude,longitude"]
    for (u, v), (latitude, longitude) in zip(to_pixel(ground), geodetic, strict=True):
        lines.append(f"{u:.3f},{v:.3f},{latitude:.9f},{longitude:.9f}")
    files.calibration.write_text("\n".join(lines) + "\n", encoding="utf-8")
    lanes = tuple(truth_lane(k, y) for k, y in LANE_Y_M.items())
    write_lanes(files.truth, LaneMap(0, lanes), DATUM)
    return files
