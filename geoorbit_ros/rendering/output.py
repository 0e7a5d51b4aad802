"""A rendered scene as files: the video, and everything that a full test camera needs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_point_writer import write_control_points
from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, Frames
from geoorbit_ros.lanes.geojson import write_lanes
from geoorbit_ros.rendering.rendered_scene import RenderedScene
from geoorbit_ros.scenes.output import CALIBRATION, TRACKS, TRUTH, check_new_folder
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.frames.video_writer import VideoWriter, new_video
from geoorbit_ros.storage.mot_text import write_mot
from geoorbit_ros.storage.track_csv import write_track_csv

VIDEO, MOT = "video.mp4", "tracks.txt"


@dataclass(frozen=True, slots=True)
class RenderedFiles:
    """Paths of what `write_rendered_scene` wrote.

    Attributes:
        video: The images.
        tracks: True boxes as `tracks.csv`, the visible share as `conf`.
        mot: The same as MOTChallenge text, frames numbered from 1.
        calibration: Surveyed control points, with the errors of surveying and clicking.
        truth: The true lanes.
        boxes: Number of boxes.
        vehicles: Number of vehicles that they belong to.
    """

    video: Path
    tracks: Path
    mot: Path
    calibration: Path
    truth: Path
    boxes: int
    vehicles: int


def write_rendered_scene(
    rendered: RenderedScene,
    out_dir: str | Path,
    camera_id: str | None = None,
    *,
    overwrite: bool = False,
) -> RenderedFiles:
    """Render a scene into a new folder: all files or none.

    Args:
        rendered: The scene, no frame of it taken yet.
        out_dir: The folder, which must not exist (or be empty).
        camera_id: The camera's name in the truth; default: the scene's.
        overwrite: Replace a folder that exists.

    Raises:
        InputFileError: `out_dir` can't be written, or holds something.
        NoTrafficError: The camera saw no vehicle.
    """
    check_new_folder(out_dir, overwrite=overwrite)
    stamps: list[int] = []
    tables: list[NDArray[np.void]] = []
    name = rendered.scene.name if camera_id is None else camera_id
    with atomic_output(out_dir, overwrite=overwrite) as folder:
        folder.mkdir()
        video = VideoWriter(folder / VIDEO, rendered.fps, rendered.image_size)
        try:
            for frame in rendered:
                video.write(frame.image)
                stamps.append(frame.stamp_ns)
                tables.append(frame.boxes)
        finally:
            video.close()
        frames = _frames(stamps, tables)
        if not len(frames.rows):
            raise NoTrafficError(
                f"scene '{rendered.scene.name}'",
                f"no vehicle in {len(frames)} frames",
                "a longer duration, or more vehicles per hour where the camera looks",
            )
        write_track_csv(folder / TRACKS, frames)
        write_mot(folder / MOT, ((k + 1, frames.frame(k)) for k in range(len(frames))))
        write_control_points(folder / CALIBRATION, rendered.control_points)
        lane_map = LaneMap(stamps[-1], rendered.truth)
        write_lanes(folder / TRUTH, lane_map, rendered.datum, camera_id=name, estimator="truth")
    there = Path(out_dir)
    return RenderedFiles(
        video=there / VIDEO,
        tracks=there / TRACKS,
        mot=there / MOT,
        calibration=there / CALIBRATION,
        truth=there / TRUTH,
        boxes=len(frames.rows),
        vehicles=len(np.unique(frames.rows["track_id"])),
    )


def write_video(rendered: RenderedScene, path: str | Path) -> None:
    """Render a scene into a video file alone.

    Raises:
        InputFileError: The name has no suffix of a video, or nothing can be written there.
    """
    with new_video(path, rendered.fps, rendered.image_size) as video:
        for frame in rendered:
            video.write(frame.image)


def _frames(stamps: list[int], tables: list[NDArray[np.void]]) -> Frames:
    offset = np.append(0, np.cumsum([len(table) for table in tables])).astype(np.int64)
    rows = np.concatenate(tables) if tables else np.empty(0, PIXEL_TRACK_DTYPE)
    return Frames(np.array(stamps, dtype=np.int64), offset, rows)
