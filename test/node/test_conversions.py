"""Serialised messages are what rclpy reads, for every frame name and number of poses."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from hypothesis import given
from hypothesis import strategies as st
from made_markings import lane_map, road_plane
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import NavSatFix, PointCloud2
from std_msgs.msg import String
from visualization_msgs.msg import Marker

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.conversions import (
    datum_from_fix,
    datum_to_fix,
    decode_string,
    encode_clock,
    encode_path,
    encode_pose_array,
    encode_string,
    lane_markers,
    message_class,
    path_headings,
    plane_message,
    plane_of,
)
from geoorbit_ros.core.errors import MessageError
from geoorbit_ros.core.lanes import LaneEdge, LaneMap

letters = st.characters(min_codepoint=1, exclude_categories=["Cs"])
frame_ids = st.text(letters, max_size=20)
poses = st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 2, st.floats(-3.2, 3.2)), max_size=9)
stamps = st.integers(0, 2**31 * 10**9 - 1)


def columns(values: list[Any]) -> tuple[Any, Any]:
    array = np.array(values, dtype=np.float64).reshape(-1, 3)
    return array[:, :2], array[:, 2]


def in_poses(message_poses: Any) -> list[Any]:
    return [
        (p.position.x, p.position.y, 2 * np.arctan2(p.orientation.z, p.orientation.w))
        for p in message_poses
    ]


def same(found: list[Any], values: list[Any]) -> None:
    assert len(found) == len(values)
    for (x, y, heading), expected in zip(found, values, strict=True):
        assert (x, y) == expected[:2]
        assert heading == pytest.approx(expected[2], abs=1e-12)


@given(stamps, frame_ids, poses)
def test_pose_arrays_read_back(stamp_ns: int, frame_id: str, values: list[Any]) -> None:
    message = deserialize_message(
        encode_pose_array(stamp_ns, frame_id, *columns(values)), PoseArray
    )
    assert message.header.frame_id == frame_id
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp_ns
    same(in_poses(message.poses), values)


@given(stamps, frame_ids, poses)
def test_paths_read_back_with_the_header_in_every_pose(
    stamp_ns: int, frame_id: str, values: list[Any]
) -> None:
    message = deserialize_message(encode_path(stamp_ns, frame_id, *columns(values)), Path)
    assert message.header.frame_id == frame_id
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp_ns
    assert all(stamped.header == message.header for stamped in message.poses)
    same(in_poses(stamped.pose for stamped in message.poses), values)


@given(st.text(letters))
def test_strings_read_back_here_and_in_rclpy(text: str) -> None:
    assert deserialize_message(encode_string(text), String).data == text
    assert decode_string(serialize_message(String(data=text)), "topic") == text


@given(st.binary(max_size=40))
def test_bytes_that_are_no_string_are_refused_by_name(cdr: bytes) -> None:
    try:
        decode_string(cdr, "/cam/lanes/geojson")
    except MessageError as error:
        assert "/cam/lanes/geojson" in str(error)


@given(stamps)
def test_the_clock_reads_back(stamp_ns: int) -> None:
    clock = deserialize_message(encode_clock(stamp_ns), Clock).clock
    assert clock.sec * 10**9 + clock.nanosec == stamp_ns


@given(st.floats(-90, 90), st.floats(-180, 180))
def test_the_datum_survives_the_message_exactly(latitude: float, longitude: float) -> None:
    datum = Datum(latitude, longitude)
    cdr = serialize_message(datum_to_fix(datum, "map"))
    assert datum_from_fix(deserialize_message(cdr, NavSatFix), "datum") == datum


@pytest.mark.parametrize("latitude", [float("nan"), 90.5, float("inf")])
def test_a_fix_without_a_position_is_refused(latitude: float) -> None:
    with pytest.raises(MessageError, match="/cam/datum"):
        datum_from_fix(NavSatFix(latitude=latitude), "/cam/datum")


def test_headings_follow_the_line_and_turn_with_it() -> None:
    angle = np.linspace(0, np.pi / 2, 40)
    line = 100 * np.column_stack((np.sin(angle), 1 - np.cos(angle)))
    assert np.allclose(path_headings(line), angle, atol=0.03)
    turned = line @ np.array([[0.0, 1.0], [-1.0, 0.0]])  # by 90 degrees
    difference = np.angle(np.exp(1j * (path_headings(turned) - path_headings(line))))
    assert np.allclose(difference, np.pi / 2)


def test_message_classes_are_found_by_name() -> None:
    assert message_class("sensor_msgs/msg/PointCloud2") is PointCloud2
    assert message_class("not_there_msgs/msg/Thing") is None
    assert message_class("sensor_msgs/msg/NoSuchThing") is None


def test_a_road_plane_goes_there_and_back() -> None:
    plane = road_plane()
    message = plane_message(plane, (1280, 720))
    back, size = plane_of(message, "/north/road_plane")
    assert np.array_equal(back.matrix, plane.matrix)
    assert np.array_equal(back.spread, plane.spread)
    assert size == (1280, 720)
    assert back.lens is None


def test_a_road_plane_takes_its_lens_and_common_errors_along() -> None:
    lens = Lens(900.0, 905.0, 640.0, 360.0, (1280, 720), -0.2, 0.03, focal_known=False)
    plane = road_plane()
    spread = np.concatenate((plane.spread, plane.spread[:2]))
    plane = replace(plane, lens=lens, spread=spread, k1_spread=np.linspace(0.0, 0.01, 10))
    back, _ = plane_of(plane_message(plane, (1280, 720)), "/north/road_plane")
    assert back.lens == lens
    pixel = np.array([[400.0, 600.0], [900.0, 500.0]])
    assert np.array_equal(back.fit_shifts(pixel), plane.fit_shifts(pixel))


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda data: data[:-1], "100 numbers"),
        (lambda data: data[:0], "0 numbers"),
        (lambda data: [*data[:5], float("nan"), *data[6:]], "some not finite"),
        (lambda data: [0.0, *data[1:]], "an image of 0x720"),
    ],
)
def test_what_is_no_road_plane(change: Callable[[list[float]], list[float]], found: str) -> None:
    message = plane_message(road_plane(), (1280, 720))
    message.data = change(list(message.data))
    with pytest.raises(MessageError, match=found):
        plane_of(message, "/north/road_plane")


def test_markers_show_boundaries_as_they_are_painted() -> None:
    (lane,) = lane_map((1.75,)).lanes
    dashed = LaneEdge("paint", 0.03, "dashed", "white", 1.0, 0.12)
    yellow = LaneEdge("paint", 0.03, "solid", "yellow", 1.0, 0.25)
    painted = replace(lane, left_edge=dashed, right_edge=yellow)
    left, right = (
        next(m for m in lane_markers(LaneMap(1, (painted,)), "map").markers if m.ns == role)
        for role in ("left", "right")
    )
    assert (left.type, right.type) == (Marker.LINE_LIST, Marker.LINE_STRIP)
    assert left.color.b == 1.0
    assert right.color.b < 0.5
    ends = np.array([(point.x, point.y) for point in left.points]).reshape(-1, 2, 2)
    lengths = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
    assert lengths[:-1] == pytest.approx(3.0, abs=0.01)
    assert 0.0 < lengths[-1] <= 3.01
    covered = lengths.sum() / np.hypot(*np.diff(lane.left_m, axis=0).T).sum()
    assert covered == pytest.approx(1 / 3, abs=0.05)
    assert len(right.points) == len(lane.right_m)
