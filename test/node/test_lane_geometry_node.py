"""The lane_geometry node: what it publishes agrees with itself and with the offline mapper."""

import json
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from made_up_camera import MadeUpCamera
from nav_msgs.msg import Path
from numpy.typing import NDArray
from probe import LOSSLESS, Probe
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import NavSatFix
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.conversions import datum_to_fix
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.geojson import dumps_lanes, parse_lane_file
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.parameters import LaneParameters
from geoorbit_ros.nodes.lane_geometry import LaneGeometryNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.view.looks import Blindness, ViewLook, ViewState
from geoorbit_ros.view.picture import shifted

DATUM = Datum(43.05, -89.35)
LANES = (1, 2, 3)
Tracks = list[tuple[int, NDArray[np.void]]]


@pytest.fixture(scope="module")
def tracks(camera: MadeUpCamera) -> Tracks:
    """Ground tracks of the made-up camera: (stamp_ns, rows) per frame."""
    projector = BoxProjector(
        fit_homography(read_control_points(camera.calibration)), camera.image_size
    )
    return [
        (int(stamp_ns), projector.project(int(stamp_ns), camera.frames.frame(k)))
        for k, stamp_ns in enumerate(camera.frames.stamp_ns)
    ]


def start(nodes: Composition, **overrides: object) -> LaneGeometryNode:
    return nodes.make(LaneGeometryNode, "north", LOSSLESS | overrides)


def feed(node: Any, probe: Probe, tracks: Tracks) -> None:
    send = probe.table_publisher("tracks")
    for stamp_ns, rows in tracks:
        send(stamp_ns, rows)
    probe.until(lambda: node.frames == len(tracks), "all frames")


def give_datum(probe: Probe, node: Any) -> None:
    probe.publisher("datum", NavSatFix, LATCHED).publish(datum_to_fix(DATUM, "map"))
    probe.until(lambda: node.datum == DATUM, "the datum")


def update(probe: Probe) -> Trigger.Response:
    return probe.call("lane_geometry/update", Trigger, Trigger.Request())


def headings(poses: Any) -> np.ndarray:
    return np.array([2 * np.arctan2(p.orientation.z, p.orientation.w) for p in poses])


def positions(poses: Any) -> np.ndarray:
    return np.array([(p.position.x, p.position.y) for p in poses])


def test_one_pose_per_lane_on_its_path_and_along_it_for_a_late_joiner(
    nodes: Composition, tracks: Tracks
) -> None:
    node, probe = start(nodes), Probe(nodes)
    feed(node, probe, tracks)
    assert update(probe).success

    late = Probe(nodes, name="late")
    lanes = late.listen("lanes", PoseArray)
    paths = {
        (k, role): late.listen(f"lanes/lane_{k}/{role}", Path)
        for k in LANES
        for role in ("centerline", "left", "right")
    }
    late.until(lambda: bool(lanes) and all(paths.values()), "the latched lanes")
    assert len(lanes) == 1, "a late joiner gets the last message alone"
    assert len(lanes[0].poses) == len(LANES)
    assert lanes[0].header.frame_id == "map"
    for k, pose in zip(LANES, lanes[0].poses, strict=True):
        line = [stamped.pose for stamped in paths[k, "centerline"][0].poses]
        points, along = positions(line), headings(line)
        step = np.diff(points, axis=0)
        travel = np.arctan2(step[:, 1], step[:, 0])
        turn = np.angle(np.exp(1j * (along[:-1] - travel)))
        assert np.abs(turn).max() < np.radians(5.0)
        middle = positions([pose])[0]
        nearest = int(np.argmin(np.hypot(*(points - middle).T)))
        assert np.hypot(*(points[nearest] - middle)) < 3.0
        assert abs(np.angle(np.exp(1j * (headings([pose])[0] - along[nearest])))) < np.radians(5)
        sides = {}
        for role in ("left", "right"):
            border = positions([stamped.pose for stamped in paths[k, role][0].poses])
            aside = border[len(border) // 2] - points[len(points) // 2]
            sides[role] = step[len(step) // 2, 0] * aside[1] - step[len(step) // 2, 1] * aside[0]
        assert sides["left"] > 0 > sides["right"], "left is to the driver's left"


def test_the_map_is_bit_for_bit_the_offline_one(nodes: Composition, tracks: Tracks) -> None:
    node, probe = start(nodes), Probe(nodes)
    give_datum(probe, node)
    texts = probe.listen("lanes/geojson", String)
    feed(node, probe, tracks)
    update(probe)
    probe.until(lambda: len(texts) == node.lane_maps, "all maps")

    mapper = LaneMapper(make_estimator("curvilinear"), LaneParameters(), 5.0)
    maps = [m for stamp_ns, rows in tracks if (m := mapper.add(stamp_ns, rows)) is not None]
    maps.append(mapper.finish())
    expected = [dumps_lanes(m, DATUM, camera_id="north", estimator="curvilinear") for m in maps]
    assert [text.data for text in texts] == expected


def test_lanes_are_stamped_with_the_data_not_with_the_clock(
    nodes: Composition, tracks: Tracks
) -> None:
    node, probe = start(nodes), Probe(nodes)
    lanes = probe.listen("lanes", PoseArray)
    feed(node, probe, tracks)
    update(probe)
    probe.until(lambda: len(lanes) == node.lane_maps, "all maps")
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in lanes]
    assert stamps[-1] == tracks[-1][0]
    assert set(stamps) <= {stamp_ns for stamp_ns, _ in tracks}


def test_markers_start_with_a_clean_slate_and_tell_every_lane(
    nodes: Composition, tracks: Tracks
) -> None:
    node, probe = start(nodes), Probe(nodes)
    feed(node, probe, tracks)
    update(probe)
    arrays = probe.listen("lanes/markers", MarkerArray)
    probe.until(lambda: bool(arrays), "markers")
    first, *rest = arrays[0].markers
    assert first.action == Marker.DELETEALL
    assert {marker.id for marker in rest} == set(LANES)
    assert all(marker.color.a > 0 for marker in rest)
    lines = [marker for marker in rest if marker.type == Marker.LINE_STRIP]
    assert len(lines) == 3 * len(LANES)
    assert all(len(marker.points) >= 2 for marker in lines)


def test_lanes_that_the_image_does_not_show_are_held_and_say_since_when_and_why(
    nodes: Composition, tracks: Tracks
) -> None:
    node, probe = start(nodes), Probe(nodes)
    give_datum(probe, node)
    texts, held = probe.listen("lanes/geojson", String), probe.listen("lanes/held", Bool)
    arrays = probe.listen("lanes/markers", MarkerArray)
    send_view = probe.table_publisher("view")
    feed(node, probe, tracks)
    update(probe)
    probe.until(lambda: len(texts) == node.lane_maps, "all maps")
    live, last_ns = texts[-1].data, tracks[-1][0]

    def show(after_s: int, state: ViewState, sigma_px: float = 0.05, moved_px: float = 0.0) -> None:
        stamp_ns, before = last_ns + after_s * 10**9, len(texts)
        view = 0 if np.isfinite(sigma_px) else -1
        motion, since_ns = shifted(moved_px, 0.0), last_ns + 3 * 10**9
        blindness = Blindness.FROZEN if state is ViewState.BLIND else Blindness.NONE
        look = ViewLook(
            *(stamp_ns, state, view, motion, sigma_px, 0.0, moved_px, since_ns, blindness)
        )
        send_view(stamp_ns, look.row())
        if after_s > 2:
            probe.until(lambda: len(texts) > before, "a map that says so")

    show(2, ViewState.STEADY)
    show(5, ViewState.BLIND, np.inf)
    about = json.loads(texts[-1].data)
    assert about["geoorbit"]["held"] is True
    assert about["geoorbit"]["view"]["since_ns"] == last_ns + 3 * 10**9
    assert "frozen" in about["geoorbit"]["view"]["why"]
    assert about["geoorbit"]["stamp_ns"] == last_ns, "the newest evidence is as old as before"
    assert all(feature["properties"]["held"] for feature in about["features"])
    assert held[-1].data
    assert "held" in arrays[-1].markers[-1].text
    assert node.diagnostic_values()["held"] is True
    again = parse_lane_file(texts[-1].data, "the topic").lane_map
    assert again.held
    assert again.view is not None
    assert again.view.since_ns == last_ns + 3 * 10**9
    show(9, ViewState.MOVED, moved_px=14.0)
    about = json.loads(texts[-1].data)
    assert "held" not in about["geoorbit"]
    assert about["geoorbit"]["view"]["held"] is False
    assert "moved by 14 px" in about["geoorbit"]["view"]["why"]
    assert not held[-1].data
    show(12, ViewState.STEADY)
    assert texts[-1].data == live, "as if nothing had been"


def test_without_a_datum_there_are_lanes_but_no_geojson_until_it_comes(
    nodes: Composition, tracks: Tracks
) -> None:
    node, probe = start(nodes), Probe(nodes)
    texts = probe.listen("lanes/geojson", String)
    lanes = probe.listen("lanes", PoseArray)
    feed(node, probe, tracks)
    update(probe)
    probe.until(lambda: len(lanes) == node.lane_maps, "lanes")
    assert texts == []
    give_datum(probe, node)
    probe.until(lambda: len(texts) == 1, "the map as GeoJSON")
    assert json.loads(texts[0].data)["geoorbit"]["stamp_ns"] == tracks[-1][0]


def test_a_lane_that_is_gone_leaves_an_empty_path_then_no_topic(
    nodes: Composition, tracks: Tracks
) -> None:
    node, probe = start(nodes), Probe(nodes)
    paths = probe.listen("lanes/lane_1/centerline", Path)
    lanes = probe.listen("lanes", PoseArray)
    feed(node, probe, tracks)
    update(probe)
    probe.until(lambda: bool(paths) and bool(lanes) and len(lanes[-1].poses) == 3, "lanes")
    # The source starts again, an hour earlier, with no traffic.
    send = probe.table_publisher("tracks")
    early_ns = tracks[0][0] - 3600 * 10**9
    for k in range(2):  # the second one says that the first was no wrong stamp
        send(early_ns + k * 10**8, np.empty(0, TRACK_DTYPE))
    probe.until(lambda: node.frames == len(tracks) + 2, "the empty frames")
    update(probe)
    probe.until(lambda: len(lanes[-1].poses) == 0 and len(paths[-1].poses) == 0, "an empty path")
    assert probe.node.count_publishers("/north/lanes/lane_1/centerline") == 1
    update(probe)
    probe.until(
        lambda: probe.node.count_publishers("/north/lanes/lane_1/centerline") == 0, "no topic"
    )


def test_empty_frames_and_wrong_ones_do_no_harm(nodes: Composition) -> None:
    node, probe = start(nodes), Probe(nodes)
    assert not update(probe).success, "no frame yet"
    send = probe.table_publisher("tracks")
    send(10**9, np.empty(0, TRACK_DTYPE))
    send(2 * 10**9, np.zeros(1, [("x", "<f4")]))
    send(10**9, np.empty(0, TRACK_DTYPE))
    send(3 * 10**9, np.empty(0, TRACK_DTYPE))
    probe.until(lambda: node.diagnostics.received == 4, "all frames")
    assert (node.frames, node.diagnostics.refused) == (2, 2)
    answer = update(probe)
    assert answer.success
    assert answer.message == "0 lanes from 2 frames"


def test_detection_parameters_change_while_running_and_only_within_bounds(
    nodes: Composition, tracks: Tracks
) -> None:
    node, probe = start(nodes), Probe(nodes)

    def set_to(name: str, value: object) -> Any:
        request = SetParameters.Request()
        request.parameters = [Parameter(name, value=value).to_parameter_msg()]
        return probe.call("lane_geometry/set_parameters", SetParameters, request).results[0]

    assert set_to("width_scale", 2.0).successful
    assert node.p.width_scale == 2.0
    feed(node, probe, tracks)
    update(probe)
    refused = set_to("width_scale", 3.0)
    assert not refused.successful
    for word in ("/north/lane_geometry", "'width_scale'", "3.0", "0.5 to 2"):
        assert word in refused.reason
    assert node.p.width_scale == 2.0
    assert not set_to("estimator", "geolane").successful, "read-only"

    mapper = LaneMapper(make_estimator("curvilinear"), LaneParameters(width_scale=2.0), 5.0)
    for stamp_ns, rows in tracks:
        mapper.add(stamp_ns, rows)
    wide = [lane.width_m for lane in mapper.finish().lanes]
    arrays = probe.listen("lanes/markers", MarkerArray)
    probe.until(lambda: bool(arrays), "markers")
    labels = [m.text for m in arrays[0].markers if m.type == Marker.TEXT_VIEW_FACING]
    assert [label.split("(")[1] for label in labels] == [f"{width:.1f} m)" for width in wide]
