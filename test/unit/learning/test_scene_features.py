"""Features say what they claim to, and nothing about where the camera is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_lane_traffic import rotated
from tasks import road

from geoorbit_ros.core.tables import Frames
from geoorbit_ros.learning.features import CLIP, FEATURE_NAMES, scene_features


def feature(frames: Frames, name: str) -> float:
    return float(scene_features(frames)[FEATURE_NAMES.index(name)])


def test_moving_the_camera_changes_nothing_but_rounding() -> None:
    frames, _ = road(0.3)
    there = rotated(frames, 0.0, (4096.0, -2048.0))
    np.testing.assert_allclose(scene_features(there), scene_features(frames), atol=0.02)


def test_turning_the_road_turns_the_axis() -> None:
    east, _ = road(0.0)
    north = rotated(east, np.pi / 2, (0.0, 0.0))
    assert feature(east, "axis_cos") > 1.3
    assert feature(north, "axis_cos") < -1.3
    assert feature(north, "tilt") > feature(east, "tilt")
    for name in ("traffic", "speed", "across", "reach", "bend", "two_way"):
        assert feature(north, name) == pytest.approx(feature(east, name), abs=0.02)


def test_the_order_of_rows_within_a_frame_does_not_matter() -> None:
    frames, _ = road(0.2)
    rows = frames.rows.copy()
    for k in range(len(frames)):
        part = slice(frames.offset[k], frames.offset[k + 1])
        rows[part] = rows[part][::-1]
    shuffled = Frames(frames.stamp_ns, frames.offset, rows)
    np.testing.assert_allclose(scene_features(shuffled), scene_features(frames), atol=1e-9)


def test_more_lanes_are_more_traffic_over_more_width() -> None:
    two, _ = road(lanes=2)
    four, _ = road(lanes=4)
    assert feature(four, "traffic") > feature(two, "traffic")
    assert feature(four, "across") > feature(two, "across")


def test_time_of_day_comes_from_stamps_and_longitude() -> None:
    frames, _ = road()
    noon = replace(frames, stamp_ns=frames.stamp_ns + 12 * 3600 * 10**9)
    assert feature(noon, "hour_cos") == pytest.approx(-1.0, abs=0.01)
    # At 90 degrees east the sun is six hours ahead of UTC.
    east = scene_features(frames, longitude_deg=90.0)
    assert east[FEATURE_NAMES.index("hour_sin")] == pytest.approx(1.0, abs=0.01)


def test_no_traffic_is_the_typical_scene_and_nothing_leaves_the_range() -> None:
    frames, _ = road()
    parked = frames.rows.copy()
    parked["x"], parked["y"] = 1.0, 2.0
    assert not scene_features(Frames(frames.stamp_ns, frames.offset, parked)).any()
    wild = frames.rows.copy()
    wild["x"] *= 1e4
    assert np.abs(scene_features(Frames(frames.stamp_ns, frames.offset, wild))).max() <= CLIP
