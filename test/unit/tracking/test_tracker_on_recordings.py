"""Boxes of real and simulated cameras, their ids taken away and given again."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.tables import DETECTION_DTYPE, FLAG_PREDICTED, Frames
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_lanes, project_frames
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import simulate
from geoorbit_ros.storage.track_csv import read_track_csv
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.tracker import Tracker
from scores.tracking_score import score_tracks

REAL_DATA = os.environ.get("GEOORBIT_REAL_DATA")


def tracked(frames: Frames, image_size: tuple[int, int]) -> Frames:
    """The same boxes with ids from the tracker."""
    tracker = Tracker(TrackerParameters(image_width=image_size[0], image_height=image_size[1]))
    tables = []
    for k, stamp_ns in enumerate(frames.stamp_ns.tolist()):
        rows = np.empty(len(frames.frame(k)), DETECTION_DTYPE)
        for name in DETECTION_DTYPE.names or ():
            rows[name] = frames.frame(k)[name]
        tables.append(tracker.update(stamp_ns, rows))
    offset = np.append(0, np.cumsum([len(rows) for rows in tables])).astype(np.int64)
    return Frames(frames.stamp_ns, offset, np.concatenate(tables))


@pytest.mark.skipif(REAL_DATA is None, reason="GEOORBIT_REAL_DATA names no recordings")
@pytest.mark.parametrize("camera", ["Yahara", "Monona"])
def test_real_boxes_give_four_lanes_each_way(camera: str) -> None:
    folder = Path(str(REAL_DATA)) / "us12" / camera
    homography = fit_homography(read_control_points(folder / "calibration.csv"))
    size = (1920, 1080)
    frames = tracked(read_track_csv(folder / "trajectory.csv"), size)
    ground = project_frames(frames, BoxProjector(homography, size))
    lanes = map_lanes(ground, LaneMapper(make_estimator("curvilinear")), camera).confirmed
    eastbound = [lane for lane in lanes if abs(lane.heading_deg - 90.0) < 20.0]
    westbound = [lane for lane in lanes if abs(lane.heading_deg - 270.0) < 20.0]
    assert (len(eastbound), len(westbound), len(lanes)) == (4, 4, 8)


def test_nearly_all_that_was_detected_gets_the_right_id() -> None:
    run = simulate(load_scene("straight_3x3"), 15.0, 3)
    frames = tracked(run.frames, run.image_size)
    score = score_tracks(run.boxes, frames)
    # One true box in eight has no detection; half of these are filled by prediction.
    assert score.idf1 > 0.9
    assert score.hota > 0.75
    assert score.id_switches <= 0.1 * score.true_tracks
    seen = (frames.rows["flags"] & FLAG_PREDICTED) == 0
    assert 0.9 * len(run.frames.rows) < seen.sum() <= len(run.frames.rows)
