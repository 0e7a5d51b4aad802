"""Tracks along lanes: places and speeds are those driven, wherever the world lies."""

from __future__ import annotations

import numpy as np
import pytest
from made_lane_traffic import rotated
from made_traffic_content import LANE_IDS, evenly, road, traffic_of

from geoorbit_ros.core.lanes import lane_of_map
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames
from geoorbit_ros.traffic.lane_tracks import LANE_TRACK_DTYPE, lane_tracks

SPEEDS_MPS = (20.0, 30.0, 25.0, 35.0)


def test_places_and_speeds_are_those_that_were_driven() -> None:
    frames = traffic_of([evenly(12.0, 120.0, k) for k in range(4)], SPEEDS_MPS)
    tracks = lane_tracks(road(), frames)
    assert len(np.unique(tracks["run"])) == len(np.unique(frames.rows["track_id"]))
    for lane_id, speed in zip(LANE_IDS, SPEEDS_MPS, strict=True):
        rows = tracks[tracks["lane_id"] == lane_id]
        assert rows["speed_mps"] == pytest.approx(np.full(len(rows), speed), rel=1e-3)
        for run in np.unique(rows["run"]):
            one = rows[rows["run"] == run]
            assert np.all(np.diff(one["stamp_ns"]) > 0)
            way = np.diff(one["arc_m"]) / np.diff(one["stamp_ns"]) * 1e9
            assert way == pytest.approx(np.full(len(way), speed), rel=1e-2)


def test_the_turned_world_has_the_same_tracks() -> None:
    frames = traffic_of([evenly(20.0, 60.0, k) for k in range(4)], SPEEDS_MPS)
    angle, shift = 0.7, (-40.0, 25.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = [
        lane_of_map(
            k.lane_id, *(line @ turn.T + shift for line in (k.centerline_m, k.left_m, k.right_m))
        )
        for k in road()
    ]
    here, there = lane_tracks(road(), frames), lane_tracks(turned, rotated(frames, angle, shift))
    assert here["lane_id"].tolist() == there["lane_id"].tolist()
    assert here["arc_m"] == pytest.approx(there["arc_m"], abs=1e-3)
    assert here["speed_mps"] == pytest.approx(there["speed_mps"], abs=1e-3)


def test_no_frames_have_no_tracks() -> None:
    none = Frames(np.empty(0, np.int64), np.zeros(1, np.int64), np.empty(0, TRACK_DTYPE))
    assert lane_tracks(road(), none).dtype == LANE_TRACK_DTYPE
    assert len(lane_tracks(road(), none)) == 0
