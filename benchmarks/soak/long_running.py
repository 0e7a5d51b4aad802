"""Lane memories of cameras that have run for hours: their evidence is full.

A camera's evidence is bounded by a number of vehicles, which a recording of a minute reaches after
hours of being played. Here it is played as fast as it goes, by the mapper that the node uses.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from geoorbit_ros.cli.camera_input import CameraInput, load_camera
from geoorbit_ros.lanes.estimators.curvilinear.evidence import MAX_SEGMENTS
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.live_mapper import LaneMemory
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import StampedRows, project_frames

MOST_MINUTES = 180
UPDATE_PERIOD_S = 30.0
ID_STEP = 10_000
ESTIMATOR = "curvilinear"


def fill_memories(cameras: Iterable[dict[str, Any]], folder: Path, output: Path) -> None:
    """Write `state/<camera>/lanes.npz` of a fleet's output folder for each of its cameras.

    Args:
        cameras: As in the fleet file.
        folder: Where tracks of filmed cameras are kept for the next time.
        output: The fleet's output folder.
    """
    for camera in cameras:
        source = recorded(camera, folder)
        memory = LaneMemory(output / "state" / camera["id"] / "lanes.npz", ESTIMATOR)
        minutes, segments = fill(source, memory)
        print(f"{camera['id']}: {segments} segments in {minutes} minutes", file=sys.stderr)


def recorded(camera: dict[str, Any], folder: Path) -> CameraInput:
    """The camera's tracked boxes: of its bag, or found in its film."""
    kind, _, bag = camera["source"].partition(":")
    calibration = Path(camera["calibration"])
    size = "x".join(map(str, camera["image_size"]))
    nowhere = folder / "lanes.geojson"
    if kind == "bag":
        return load_camera(None, Path(bag), calibration, camera["id"], size, None, nowhere)
    found = folder / f"{camera['id']}-found"
    if not found.exists():
        words = [sys.executable, "-m", "geoorbit_ros.cli.main", "process", camera["source"]]
        words += ["--calibration", str(calibration), "--out", str(found)]
        subprocess.run(words, check=True, stdout=sys.stderr)
    tracks = found / "tracks.csv"
    return load_camera(tracks, None, calibration, camera["id"], size, None, nowhere)


def fill(camera: CameraInput, memory: LaneMemory) -> tuple[int, int]:
    """Play a camera's recording again and again until its evidence is full, and save that.

    Returns:
        Minutes played, and segments remembered.
    """
    frames: list[StampedRows] = list(project_frames(camera.frames, camera.projector))
    mapper = LaneMapper(make_estimator(ESTIMATOR), update_period_s=UPDATE_PERIOD_S)
    first_ns, last_ns = frames[0][0], frames[-1][0]
    period_ns = last_ns - first_ns + (last_ns - first_ns) // max(len(frames) - 1, 1)
    repeats = max(1, round(MOST_MINUTES * 60e9 / period_ns))
    begin_ns = time.time_ns() - repeats * period_ns
    segments = played = 0
    while played < repeats and segments < MAX_SEGMENTS:
        for stamp_ns, rows in frames:
            shifted = rows.copy()
            shifted["track_id"] += played * ID_STEP
            mapper.add(begin_ns + played * period_ns + stamp_ns - first_ns, shifted)
        played += 1
        segments = len(mapper.state()["estimator_segments_offset"]) - 1
    mapper.finish()
    memory.save(mapper, camera.datum)
    return round(played * period_ns / 60e9), segments
