"""Two real cameras on US-12; skipped where `GEOORBIT_REAL_DATA` doesn't name their folder."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.storage.track_csv import read_track_csv

ROOT = os.environ.get("GEOORBIT_REAL_DATA")
pytestmark = pytest.mark.skipif(ROOT is None, reason="GEOORBIT_REAL_DATA isn't set")


def ground_tracks(camera: str) -> tuple[BoxProjector, NDArray[np.void]]:
    folder = Path(str(ROOT)) / "us12" / camera
    homography = fit_homography(read_control_points(folder / "calibration.csv"))
    made = BoxProjector(homography, (1920, 1080))
    frames = read_track_csv(folder / "trajectory.csv")
    tracks = [made.project(int(s), frames.frame(k)) for k, s in enumerate(frames.stamp_ns)]
    return made, np.concatenate(tracks)


@pytest.mark.parametrize("camera", ["Yahara", "Monona"])
def test_vehicles_drive_along_the_road(camera: str) -> None:
    made, ground = ground_tracks(camera)
    assert made.pose is not None
    assert 14 < made.pose.position_m[2] < 18, "the cameras hang about 16 m above the road"
    counts = made.counts
    assert counts.truncated < 0.05 * counts.rows
    assert counts.returned > 0.99 * (counts.rows - counts.truncated)
    assert counts.not_finite == counts.above_horizon == 0

    moving = ground[np.isfinite(ground["heading"]) & (ground["sigma"] < 2)]
    assert len(moving) > 0.8 * len(ground)
    axis = 0.5 * np.angle(np.mean(np.exp(2j * moving["heading"])))
    off_axis = np.abs(np.sin(moving["heading"] - axis))
    assert np.mean(off_axis < np.sin(np.radians(10))) > 0.97
    towards = np.cos(moving["heading"] - axis) > 0
    assert 0.2 < towards.mean() < 0.8
    speed = np.hypot(moving["vx"], moving["vy"])
    assert 15 < np.median(speed) < 40, "free traffic on a highway, scale along the road ±20 %"
