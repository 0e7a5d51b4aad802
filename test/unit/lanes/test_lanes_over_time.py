"""Positions on Earth and lanes of stored tracks, by the map that was valid then."""

import numpy as np
import pytest

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.lanes import LaneMap, lane_of_map
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames
from geoorbit_ros.lanes.geojson import dumps_lanes
from geoorbit_ros.lanes.lanes_over_time import LanesOverTime

DATUM = Datum(48.1, 11.6)
NORTH = np.pi / 2


def map_text(ids: list[int], stamp_ns: int) -> str:
    """Lanes northwards beside each other, the first one around x = 0."""
    lanes = []
    for k, lane_id in enumerate(ids):
        line = np.column_stack((np.full(10, 3.5 * k), np.linspace(0.0, 90.0, 10)))
        lane = lane_of_map(lane_id, line, offset_line(line, 1.75), offset_line(line, -1.75))
        lanes.append(lane)
    return dumps_lanes(LaneMap(stamp_ns, tuple(lanes)), DATUM)


def frame_at(stamp_ns: int, *x_m: float) -> Frames:
    rows = np.zeros(len(x_m), TRACK_DTYPE)
    rows["x"], rows["y"], rows["heading"] = x_m, 50.0, NORTH
    return Frames(np.array([stamp_ns]), np.array([0, len(rows)]), rows)


MAPS = {100: map_text([4, 2], 100), 200: map_text([7], 200)}


def test_lanes_are_those_of_the_map_that_was_valid() -> None:
    lanes = LanesOverTime(sorted(MAPS), MAPS.__getitem__, "maps")
    for stamp_ns, ids, numbers in (
        (50, [4, 2, np.nan], [2, 1, np.nan]),
        (199, [4, 2, np.nan], [2, 1, np.nan]),
        (200, [7, np.nan, np.nan], [1, np.nan, np.nan]),
    ):
        found = lanes.describe(frame_at(stamp_ns, 0.2, 3.3, 40.0))
        np.testing.assert_array_equal(found["lane_id"], ids)
        np.testing.assert_array_equal(found["lane_number"], numbers)


def test_a_lane_has_the_number_of_the_last_map_all_the_time() -> None:
    maps = {100: map_text([4], 100), 200: map_text([4, 2], 200)}
    lanes = LanesOverTime(sorted(maps), maps.__getitem__, "maps")
    assert [lanes.describe(frame_at(t, 0.0))["lane_number"][0] for t in (150, 250)] == [2, 2]


def test_positions_are_those_of_the_map_s_datum() -> None:
    found = LanesOverTime([100], MAPS.__getitem__, "maps").describe(frame_at(120, 0.0, 3.5))
    local_m = DATUM.to_local(found["latitude_deg"], found["longitude_deg"])
    assert np.abs(local_m - np.array([[0.0, 50.0], [3.5, 50.0]])).max() < 1e-3


def test_without_a_map_nothing_is_known() -> None:
    lanes = LanesOverTime([], MAPS.__getitem__, "maps")
    assert not lanes
    assert all(np.isnan(column).all() for column in lanes.describe(frame_at(5, 1.0)).values())


def test_a_damaged_map_is_named() -> None:
    lanes = LanesOverTime([100], lambda _: "{", "tracks.db, lane map of north")
    with pytest.raises(InputFileError, match="lane map of north"):
        lanes.describe(frame_at(120, 0.0))
