"""One camera as a learning task (the paper's T_i): its tracks, its reference, its features."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.array_file import read_arrays
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames
from geoorbit_ros.storage.atomic import atomic_output

VERSION = 1
"""Of the file."""
MIN_VEHICLES = 3
"""Lanes that fewer vehicles drove along need not be found, as in `metrics.score`."""


@dataclass(frozen=True, slots=True)
class CameraTask:
    """What a camera knows of itself, and what the study knows of it.

    Attributes:
        camera_id: Its name.
        tracks: `TRACK_DTYPE` ground tracks of the observation.
        features: (F,) the scene's features.
        supervision: Lanes of a map such as OpenStreetMap, with its errors: what the camera learns
            from.
        truth: The lanes themselves, cut to what the camera sees: what every model is measured by.
            On a real camera they are not known; there they are the map's lanes too.
        surveyed: Whether `truth` is exact.
    """

    camera_id: str
    tracks: Frames
    features: NDArray[np.float64]
    supervision: tuple[Lane, ...]
    truth: tuple[Lane, ...]
    surveyed: bool = True


def required(lanes: tuple[Lane, ...]) -> tuple[tuple[Lane, ...], int]:
    """The lanes that must be found, and how many more may be (`metrics.paper_losses`).

    Lanes of unknown traffic must be found. Where no lane has traffic enough, all must be.
    """
    asked = tuple(lane for lane in lanes if not lane.vehicles < MIN_VEHICLES) or lanes
    return asked, len(lanes) - len(asked)


def save_task(task: CameraTask, path: Path) -> None:
    """Write a task to one .npz file, whole or not at all."""
    lists = {"supervision": task.supervision, "truth": task.truth}
    arrays: dict[str, Any] = {
        f"{name}_{k}": np.stack([lane.centerline_m, lane.left_m, lane.right_m])
        for name, lanes in lists.items()
        for k, lane in enumerate(lanes)
    }
    about = {
        "version": VERSION,
        "camera_id": task.camera_id,
        "surveyed": task.surveyed,
        **{
            name: [[lane.lane_id, lane.width_m, lane.vehicles] for lane in lanes]
            for name, lanes in lists.items()
        },
    }
    with atomic_output(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            about=np.array(json.dumps(about)),
            stamp_ns=task.tracks.stamp_ns,
            offset=task.tracks.offset,
            rows=task.tracks.rows,
            features=task.features,
            **arrays,
        )


def load_task(path: Path) -> CameraTask:
    """Read what `save_task` wrote.

    Raises:
        InputFileError: Not such a file, or one of another version.
    """
    try:
        arrays = read_arrays(path, "a camera written by geoorbit train")
        about = json.loads(str(arrays["about"]))
        if about["version"] != VERSION or arrays["rows"].dtype != TRACK_DTYPE:
            raise InputFileError(str(path), "another version", f"version {VERSION}")
        tracks = Frames(arrays["stamp_ns"], arrays["offset"], arrays["rows"])
        supervision, truth = (
            tuple(_lane(row, arrays[f"{name}_{k}"]) for k, row in enumerate(about[name]))
            for name in ("supervision", "truth")
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputFileError(str(path), error, "a camera written by geoorbit train") from error
    return CameraTask(
        about["camera_id"], tracks, arrays["features"], supervision, truth, about["surveyed"]
    )


def _lane(about: tuple[int, float, float], lines: NDArray[np.float64]) -> Lane:
    (lane_id, width_m, vehicles), (center, left, right) = about, lines
    return Lane(lane_id, center, left, right, width_m, 0.0, 1.0, "confirmed", vehicles)
