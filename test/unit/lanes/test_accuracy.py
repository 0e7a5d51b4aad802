"""What the project promises of its lanes: every shipped scene, clean tracks, the real cameras."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from made_lane_traffic import rotated
from test_curvilinear import lanes_of

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_lanes, project_frames
from geoorbit_ros.metrics.lane_score import LaneScore
from geoorbit_ros.metrics.score import score_lanes
from geoorbit_ros.scenes.scene import load_scene, shipped_scenes
from geoorbit_ros.scenes.simulate import SceneRun, simulate
from geoorbit_ros.storage.track_csv import read_track_csv

REAL_DATA = os.environ.get("GEOORBIT_REAL_DATA")


@cache
def minute(scene: str) -> SceneRun:
    return simulate(load_scene(scene), 60.0, 1)


@cache
def score(scene: str) -> LaneScore:
    run = minute(scene)
    projector = BoxProjector(fit_homography(run.control_points), run.image_size)
    mapper = LaneMapper(make_estimator("curvilinear"))
    return score_lanes(map_lanes(project_frames(run.frames, projector), mapper).lanes, run.truth)


def real_map(camera: str) -> LaneMap:
    place = Path(str(REAL_DATA)) / "us12" / camera
    homography = fit_homography(read_control_points(place / "calibration.csv"))
    frames = read_track_csv(place / "trajectory.csv")
    mapper = LaneMapper(make_estimator("curvilinear"))
    return map_lanes(project_frames(frames, BoxProjector(homography, (1920, 1080))), mapper)


@pytest.mark.parametrize("scene", shipped_scenes())
def test_every_lane_with_traffic_is_there_and_none_besides(scene: str) -> None:
    result = score(scene)
    assert not result.missed("busy")
    assert not result.unconfirmed
    assert not result.missed("sparse")
    assert not result.invented
    assert not result.direction_wrong


@pytest.mark.parametrize("scene", shipped_scenes())
def test_centrelines_and_widths_are_where_they_belong(scene: str) -> None:
    result = score(scene)
    assert result.centerline_mean_m <= 0.20
    assert np.quantile(result.centerline_error_m, 0.95) <= 0.40
    assert np.mean([abs(row.width_error_m) for row in result.confirmed]) <= 0.15


def test_a_minute_of_clean_tracks_gives_the_centreline_to_five_centimetres() -> None:
    run = minute("motorway_4x4")
    frames = range(0, len(run.clean), round(len(run.clean.rows) / 20_000))
    tracks = [(int(run.clean.stamp_ns[k]), run.clean.frame(k)) for k in frames]
    mapper = LaneMapper(make_estimator("curvilinear"))
    assert score_lanes(map_lanes(tracks, mapper).lanes, run.truth).centerline_mean_m <= 0.05


@pytest.mark.parametrize("scene", ["on_ramp_merge", "urban_turn"])
def test_a_turned_and_shifted_scene_has_turned_and_shifted_lanes(scene: str) -> None:
    run = minute(scene)
    projector = BoxProjector(fit_homography(run.control_points), run.image_size)
    tables = [rows for _, rows in project_frames(run.frames, projector)]
    offset = np.append(0, np.cumsum([len(t) for t in tables])).astype(np.int64)
    rows = np.frombuffer(b"".join(t.tobytes() for t in tables), TRACK_DTYPE)
    here = Frames(run.frames.stamp_ns, offset, rows)
    angle, shift = 2.3, (64.0, -128.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    before, after = lanes_of(here).confirmed, lanes_of(rotated(here, angle, shift)).confirmed
    assert len(before) == len(after)
    for a, b in zip(before, after, strict=True):
        assert a.vehicles == pytest.approx(b.vehicles, abs=0.01)
        assert a.width_m == pytest.approx(b.width_m, abs=0.01)
        assert len(a.centerline_m) == len(b.centerline_m)
        np.testing.assert_allclose(a.centerline_m @ turn.T + shift, b.centerline_m, atol=0.03)


@pytest.mark.skipif(REAL_DATA is None, reason="GEOORBIT_REAL_DATA names no recordings")
@pytest.mark.parametrize("camera", ["Yahara", "Monona"])
def test_real_cameras_have_four_lanes_each_way(camera: str) -> None:
    lane_map = real_map(camera)
    east = sum(0.0 < lane.heading_deg < 180.0 for lane in lane_map.confirmed)
    assert (east, len(lane_map.confirmed) - east) == (4, 4)
    again = real_map(camera)
    assert [lane.centerline_m.tobytes() for lane in lane_map.lanes] == [
        lane.centerline_m.tobytes() for lane in again.lanes
    ]
    assert [lane.lane_id for lane in lane_map.lanes] == [lane.lane_id for lane in again.lanes]
