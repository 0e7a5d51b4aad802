"""Small cameras for tests of learning: exact streams of vehicles, no simulation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from made_lane_traffic import Stream, straight, traffic
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.learning.camera_task import CameraTask, save_task
from geoorbit_ros.learning.features import scene_features


def made_lane(lane_id: int, line_m: NDArray[np.float64], vehicles: float = 12.0) -> Lane:
    sides = offset_line(line_m, 1.75), offset_line(line_m, -1.75)
    return Lane(lane_id, line_m, *sides, 3.5, 0.0, 1.0, "confirmed", vehicles)


def road(heading_rad: float = 0.0, seed: int = 0, lanes: int = 2) -> tuple[Frames, list[Lane]]:
    """A minute on lanes side by side, and these lanes."""
    curves = [straight(heading_rad, 3.5 * k) for k in range(lanes)]
    frames = traffic([Stream(c, 12) for c in curves], seed=seed, fps=5.0)
    at = np.linspace(0.0, 120.0, 121)
    return frames, [made_lane(k + 1, c(at)) for k, c in enumerate(curves)]


def made_task(camera_id: str = "north", heading_rad: float = 0.0, seed: int = 0) -> CameraTask:
    frames, lanes = road(heading_rad, seed)
    return CameraTask(camera_id, frames, scene_features(frames), tuple(lanes), tuple(lanes))


def made_file(folder: Path, task: CameraTask) -> Path:
    path = folder / f"{task.camera_id}.npz"
    save_task(task, path)
    return path
