"""Recordings of real cameras as learning tasks, judged by the road network they stand in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_points import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.lanes.pipeline import project_frames
from geoorbit_ros.learning.camera_task import CameraTask
from geoorbit_ros.learning.features import scene_features
from geoorbit_ros.learning.fleet import Recording, thin
from geoorbit_ros.metrics.polyline import project
from geoorbit_ros.storage.track_csv import read_track_csv
from geoorbit_ros.twin.network import load_network
from geoorbit_ros.twin.references import reference_lanes
from geoorbit_ros.twin.view import view_polygon

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
    if control_points.datum is None:
        expected = "latitudes and longitudes, which tie it to the network"
        raise InputFileError(str(root / recording.calibration), "metres", expected)
    homography = fit_homography(control_points)
    frames = read_track_csv(root / recording.tracks, recording.image_size)
    projector = BoxProjector(homography, recording.image_size)
    tracks = thin(project_frames(frames, projector))
    network = load_network(root / recording.network, control_points.datum)
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
