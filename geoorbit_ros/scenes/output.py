"""A scene run as the files that every other command reads."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_point_writer import write_control_points
from geoorbit_ros.core.errors import InputFileError, NoTrafficError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import FLAG_GROUND_POINT, PIXEL_TRACK_DTYPE, Frames, frames_from_rows
from geoorbit_ros.lanes.geojson import write_lanes
from geoorbit_ros.roadnet.netconvert import drop_header
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.simulate import SceneRun
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.track_bag import write_track_bag
from geoorbit_ros.storage.track_csv import write_track_csv

BAG, TRACKS, CALIBRATION = "bag", "tracks.csv", "calibration.csv"
CLEAN_TRACKS, CLEAN_CALIBRATION = "clean_tracks.csv", "clean_calibration.csv"
TRUTH = "truth.geojson"
NETWORK = "network.net.xml"


@dataclass(frozen=True, slots=True)
class SceneFiles:
    """Paths of what `write_scene_run` wrote.

    Attributes:
        bag: Boxes on `/<camera_id>/tracks_px`, a frame without boxes as an empty table.
        tracks: The same boxes as `tracks.csv`.
        calibration: The surveyed control points, with the errors of surveying and clicking.
        clean_tracks: True ground points of the same vehicles, as pixels with `w = h = 0`.
        clean_calibration: The same positions with their exact pixels. It belongs to the clean
            tracks: together they show what a lane estimator does without camera and detector.
        truth: The true lanes.
        network: The roads as a SUMO network, at their place on earth.
    """

    bag: Path
    tracks: Path
    calibration: Path
    clean_tracks: Path
    clean_calibration: Path
    truth: Path
    network: Path


def write_scene_run(
    run: SceneRun, out_dir: str | Path, camera_id: str | None = None, *, overwrite: bool = False
) -> SceneFiles:
    """Write a run into a new folder: all files or none.

    Args:
        run: The run.
        out_dir: The folder, which must not exist (or be empty).
        camera_id: The camera's namespace in the bag; default: the scene's name.
        overwrite: Replace a folder that exists.

    Raises:
        InputFileError: `out_dir` can't be written, or holds something.
        ParameterError: A `camera_id` that is no ROS name.
        NoTrafficError: The camera saw no vehicle: no reader takes empty tracks.
    """
    name = run.scene.name if camera_id is None else camera_id
    clean = clean_pixels(run)
    if not len(clean.rows):
        raise NoTrafficError(
            f"scene '{run.scene.name}'",
            f"no vehicle in {len(run.frames)} frames",
            "a longer duration, or more vehicles per hour where the camera looks",
        )
    check_new_folder(out_dir, overwrite=overwrite)
    with atomic_output(out_dir, overwrite=overwrite) as folder:
        folder.mkdir()
        write_track_bag(folder / BAG, name, run.frames)
        write_track_csv(folder / TRACKS, run.frames)
        write_track_csv(folder / CLEAN_TRACKS, clean)
        points = run.control_points
        write_control_points(folder / CALIBRATION, points)
        exact = replace(points, pixel=_ground_pixels(run, points.local_m))
        write_control_points(folder / CLEAN_CALIBRATION, exact)
        lane_map = LaneMap(int(run.frames.stamp_ns[-1]), run.truth)
        write_lanes(folder / TRUTH, lane_map, run.datum, camera_id=name, estimator="truth")
        with tempfile.TemporaryDirectory(prefix="geoorbit_scene_") as scratch:
            net = write_network(place_roads(run.scene), Path(scratch), run.datum)
            drop_header(net)
            shutil.copyfile(net, folder / NETWORK)
    there = Path(out_dir)
    names = (BAG, TRACKS, CALIBRATION, CLEAN_TRACKS, CLEAN_CALIBRATION, TRUTH, NETWORK)
    return SceneFiles(*(there / file for file in names))


def check_new_folder(path: str | Path, *, overwrite: bool = False) -> None:
    """Refuse a folder with content, or a file, before any work is done; unless told to overwrite.

    Raises:
        InputFileError: It is there already.
    """
    folder = Path(path)
    if not overwrite and (folder.is_file() or (folder.is_dir() and any(folder.iterdir()))):
        found = "a file" if folder.is_file() else "a folder with content"
        raise InputFileError(str(path), found, "a path that does not exist yet (or --force)")


def clean_pixels(run: SceneRun) -> Frames:
    """True ground points (`run.clean`) through the true camera: `PIXEL_TRACK_DTYPE` ground points.

    A vehicle whose middle lies outside of the image is left out, and so is a frame without any.
    """
    clean = run.clean.rows
    pixel = _ground_pixels(run, np.column_stack([clean["x"], clean["y"]]))
    with np.errstate(invalid="ignore"):  # NaN: behind the camera
        inside = np.all((pixel >= 0.0) & (pixel <= run.image_size), axis=1)
    rows = np.zeros(int(inside.sum()), PIXEL_TRACK_DTYPE)
    rows["x"], rows["y"] = pixel[inside].T
    rows["flags"] = FLAG_GROUND_POINT
    for field in ("score", "class_id", "track_id"):
        rows[field] = clean[field][inside]
    return frames_from_rows(run.clean.row_stamp_ns()[inside], rows)


def _ground_pixels(run: SceneRun, ground_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) pixels of points (N, 2) on the road, NaN behind the camera."""
    pixel, _ = run.camera.project(np.column_stack([ground_m, np.zeros(len(ground_m))]))
    return pixel
