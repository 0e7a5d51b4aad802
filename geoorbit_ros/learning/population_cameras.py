"""The cameras of a population, made once and kept in a folder, and their theta*."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.plugins import is_plugin, plugin_file, short_name
from geoorbit_ros.core.polylines import project
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.lanes.pipeline import project_frames
from geoorbit_ros.learning.camera_task import CameraTask, load_task, save_task
from geoorbit_ros.learning.features import scene_features
from geoorbit_ros.learning.local_training import Examples
from geoorbit_ros.learning.loss_table import CameraFile, search_job
from geoorbit_ros.learning.parameter_search import (
    GENERATIONS,
    POPULATION,
    STAY,
    SearchResult,
)
from geoorbit_ros.learning.population import Population, Recording, Split, scene_task, thin
from geoorbit_ros.learning.processes import Progress, quiet, spread, watched
from geoorbit_ros.learning.validation import roles
from geoorbit_ros.roadnet.network import load_network
from geoorbit_ros.roadnet.reference_lanes import reference_lanes, view_polygon
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.track_csv import read_track_csv

REACH_M = 2.5
"""A vehicle drives along a reference lane if it is nearer than this on average: maps are off by a
metre or so, and the neighbour lane is 3 m and more away."""


def recording_task(recording: Recording, root: Path) -> CameraTask:
    """Read a recording; its reference is the SUMO network's lanes in the camera's view.

    Their widths and places are those of OpenStreetMap, not of a survey: `surveyed` is False.

    Raises:
        GeoOrbitError: A file is missing or wrong.
    """
    control_points = read_control_points(root / recording.calibration)
    datum = control_points.need_datum("latitudes and longitudes, which tie it to the network")
    homography = fit_homography(control_points)
    frames = read_track_csv(root / recording.tracks, recording.image_size)
    projector = BoxProjector(homography, recording.image_size)
    tracks = thin(project_frames(frames, projector))
    network = load_network(root / recording.network, datum)
    lanes = reference_lanes(network, view_polygon(homography, recording.image_size))
    counted = count_vehicles(lanes, tracks)
    features = scene_features(tracks, recording.longitude_deg)
    return CameraTask(recording.camera_id, tracks, features, counted, counted, surveyed=False)


def count_vehicles(lanes: Sequence[Lane], tracks: Frames) -> tuple[Lane, ...]:
    """The lanes with the number of tracks that are nearest to each and drive its way."""
    counts = np.zeros(len(lanes))
    rows = tracks.rows[np.isfinite(tracks.rows["x"]) & np.isfinite(tracks.rows["y"])]
    point = np.column_stack([rows["x"], rows["y"]]).astype(np.float64)
    ids, first, owner = np.unique(rows["track_id"], return_index=True, return_inverse=True)
    last = np.zeros(len(ids), np.int64)
    last[owner] = np.arange(len(rows))
    travel = (point[last] - point[first])[owner]
    distance = np.full((len(ids), len(lanes)), np.inf)
    for k, lane in enumerate(lanes):
        on = project(point, lane.centerline_m)
        along = np.sum(on.tangent * travel, axis=1) > 0.5 * np.hypot(travel[:, 0], travel[:, 1])
        good = on.inside & along
        number = np.bincount(owner[good], minlength=len(ids))
        total = np.bincount(owner[good], np.abs(on.offset_m[good]), minlength=len(ids))
        enough = number > 0
        distance[enough, k] = total[enough] / number[enough]
    for row in distance:
        if row.min() <= REACH_M:
            counts[int(np.argmin(row))] += 1
    return tuple(replace(lane, vehicles=float(n)) for lane, n in zip(lanes, counts, strict=True))


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PopulationCamera:
    """One camera of a population.

    Attributes:
        camera_id: Its name.
        split: Whether it takes part in training.
        path: Its task file.
        features: (F,) its scene's features.
        surveyed: Whether its true lanes are known exactly.
    """

    camera_id: str
    split: Split
    path: Path
    features: Array
    surveyed: bool


def population_cameras(
    population: Population, folder: Path, workers: int = 1, progress: Progress = quiet
) -> list[PopulationCamera]:
    """All cameras of a population; those that are not in `folder` yet are simulated and put there.

    A cached camera is used again only for the same settings of the population.

    Raises:
        InputFileError: A file in the folder that is no camera.
    """
    named = {
        camera_id: (seed, split, folder / f"{camera_id}-{_digest(population, seed)}.npz")
        for camera_id, (seed, split) in population.scenes.items()
    }
    missing = [(c, seed, path) for c, (seed, _, path) in named.items() if not path.exists()]
    made = spread(partial(_make, population), missing, workers)
    for _ in watched(made, len(missing), "simulating cameras", progress):
        pass
    found = [(camera_id, split, path) for camera_id, (_, split, path) in named.items()]
    found += _recordings(population, folder, progress)
    cameras = []
    for camera_id, split, path in found:
        task = load_task(path)
        cameras.append(PopulationCamera(camera_id, split, path, task.features, task.surveyed))
    return cameras


def _recordings(
    population: Population, folder: Path, progress: Progress
) -> list[tuple[str, Split, Path]]:
    """The real cameras; none where the environment does not say where they are."""
    root = population.recordings_folder()
    if root is None:
        return []
    found: list[tuple[str, Split, Path]] = []
    for k, recording in enumerate(population.recordings):
        progress("reading recordings", k / len(population.recordings))
        text = recording.model_dump_json()
        digest = hashlib.sha256(text.encode()).hexdigest()[:8]
        path = folder / f"{recording.camera_id}-{digest}.npz"
        if not path.exists():
            save_task(recording_task(recording, root), path)
        found.append((recording.camera_id, recording.split, path))
    return found


def best_parameters(
    cameras: list[PopulationCamera],
    estimator: str,
    folder: Path,
    workers: int = 1,
    seed: int = 0,
    progress: Progress = quiet,
) -> dict[str, SearchResult]:
    """Theta* of each camera against its supervision, kept in `folder`."""
    settings = {"population": POPULATION, "generations": GENERATIONS, "stay": STAY, "seed": seed}
    path = folder / f"best-{_kept_name(estimator)}.json"
    known = _read_results(path, settings)
    missing = [camera for camera in cameras if camera.path.name not in known]
    jobs = [(CameraFile(camera.path, estimator, "supervision"), seed) for camera in missing]
    found = spread(search_job, jobs, workers)
    what = f"searching the best parameters ({short_name(estimator)})"
    for camera, result in zip(missing, watched(found, len(jobs), what, progress), strict=True):
        known[camera.path.name] = result
        _write_results(path, settings, known)
    return {camera.camera_id: known[camera.path.name] for camera in cameras}


def _kept_name(estimator: str) -> str:
    """Name for files; that of a plug-in changes with the content of its file."""
    if not is_plugin(estimator):
        return estimator
    digest = hashlib.sha256(Path(plugin_file(estimator)).read_bytes()).hexdigest()[:8]
    return f"{short_name(estimator)}-{digest}"


def examples_of(
    cameras: list[PopulationCamera], best: dict[str, SearchResult]
) -> dict[str, Examples]:
    """What each camera has to learn from; those without a lane at any theta have nothing."""
    return {
        camera.camera_id: Examples(camera.features[None, :], best[camera.camera_id].theta[None, :])
        for camera in cameras
        if best[camera.camera_id].found
    }


def split_seen_cameras(
    cameras: list[PopulationCamera],
) -> tuple[list[PopulationCamera], list[PopulationCamera]]:
    """The seen cameras, split: about a quarter only validates.

    In a population of fewer than eight, all train and validate (`validation.roles`).
    """
    seen = {camera.camera_id: camera for camera in cameras if camera.split == "seen"}
    _, training, validating = roles(list(seen))
    return (
        [camera for name, camera in seen.items() if name in training],
        [camera for name, camera in seen.items() if name in validating],
    )


def _make(population: Population, job: tuple[str, int, Path]) -> None:
    camera_id, seed, path = job
    save_task(scene_task(population, camera_id, seed), path)


def _digest(population: Population, scene_seed: int) -> str:
    """Everything that a camera's data depend on, as a few letters."""
    content = population.model_dump(include={"duration_s", "seed", "tilt_deg", "map"}) | {
        "scene": scene_seed
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]


def _read_results(path: Path, settings: dict[str, float]) -> dict[str, SearchResult]:
    if not path.exists():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["settings"] != settings:
            return {}
        return {
            name: SearchResult(
                np.array(row["theta"]),
                row["total"],
                row["default_total"],
                row["runs"],
                row["found"],
            )
            for name, row in content["cameras"].items()
        }
    except (ValueError, KeyError, TypeError) as error:
        raise InputFileError(str(path), error, "parameters written by geoorbit train") from error


def _write_results(
    path: Path, settings: dict[str, float], results: dict[str, SearchResult]
) -> None:
    rows = {
        name: {
            "theta": result.theta.tolist(),
            "total": result.total,
            "default_total": result.default_total,
            "runs": result.runs,
            "found": result.found,
        }
        for name, result in results.items()
    }
    with atomic_output(path) as temporary:
        temporary.write_text(json.dumps({"settings": settings, "cameras": rows}), encoding="utf-8")
