"""The homography node: the same numbers as the projector, frame by frame, whatever comes in."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from made_up_camera import MadeUpCamera
from probe import KEEP_ALL, LIMIT_S, LOSSLESS, Probe
from sensor_msgs.msg import CameraInfo, NavSatFix, PointCloud2
from std_msgs.msg import Float64MultiArray, String

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.conversions import plane_of
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.tables import (
    DETECTION_DTYPE,
    FLAG_DOUBTFUL,
    PIXEL_TRACK_DTYPE,
    TRACK_DTYPE,
)
from geoorbit_ros.nodes.homography import HomographyNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED_ALL
from geoorbit_ros.storage.pointcloud2 import encode_table

FRAMES = 60


def start(nodes: Composition, camera: MadeUpCamera, **overrides: object) -> HomographyNode:
    given = LOSSLESS | {"calibration_file": str(camera.calibration)} | overrides
    return nodes.make(HomographyNode, camera.camera_id, given)


def refused(node: HomographyNode, count: int) -> bool:
    return node.diagnostics.refused == count


def test_tracks_are_bit_for_bit_those_of_the_projector(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    node = start(nodes, camera)
    probe = Probe(nodes)
    tracks = probe.listen_tables("tracks", TRACK_DTYPE)
    vehicles = probe.listen("vehicles", PoseArray, KEEP_ALL)
    probe.until(lambda: node.tracks.get_subscription_count() == 1, "the node to see the probe")
    probe.until(lambda: probe.node.count_publishers("/north/vehicles") == 1, "vehicles")
    send = probe.table_publisher("tracks_px")
    for k in range(FRAMES):
        send(int(camera.frames.stamp_ns[k]), camera.frames.frame(k))
    probe.until(lambda: len(tracks) == len(vehicles) == FRAMES, "all frames")

    points = read_control_points(camera.calibration)
    projector = BoxProjector(fit_homography(points), camera.image_size)
    for k, (stamp_ns, frame_id, rows) in enumerate(tracks):
        assert (stamp_ns, frame_id) == (camera.frames.stamp_ns[k], "map")
        expected = projector.project(int(camera.frames.stamp_ns[k]), camera.frames.frame(k))
        assert rows.tobytes() == expected.tobytes()
        assert len(vehicles[k].poses) == len(rows)
        stamp = vehicles[k].header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == stamp_ns
    assert sum(len(rows) for _, _, rows in tracks) > FRAMES


def test_the_datum_reaches_a_late_joiner_exactly(nodes: Composition, camera: MadeUpCamera) -> None:
    start(nodes, camera)
    for _ in range(5):
        nodes.spin()
    fixes = Probe(nodes).listen("datum", NavSatFix)
    nodes.wait(lambda: bool(fixes), LIMIT_S, "the datum")
    datum = read_control_points(camera.calibration).datum
    assert datum is not None
    assert (fixes[0].latitude, fixes[0].longitude) == (datum.latitude_deg, datum.longitude_deg)


def test_an_empty_frame_stays_a_frame(nodes: Composition, camera: MadeUpCamera) -> None:
    node = start(nodes, camera)
    probe = Probe(nodes)
    tracks = probe.listen_tables("tracks", TRACK_DTYPE)
    probe.until(lambda: node.tracks.get_subscription_count() == 1, "the node to see the probe")
    probe.table_publisher("tracks_px")(7_000_000_001, np.empty(0, PIXEL_TRACK_DTYPE))
    probe.until(lambda: len(tracks) == 1, "the frame")
    assert tracks[0][0] == 7_000_000_001
    assert len(tracks[0][2]) == 0


def test_what_can_not_be_used_is_refused_with_a_reason_and_the_node_lives_on(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    node = start(nodes, camera)
    probe = Probe(nodes)
    tracks = probe.listen_tables("tracks", TRACK_DTYPE)
    probe.until(lambda: node.tracks.get_subscription_count() == 1, "the node to see the probe")
    publisher = probe.publisher("tracks_px", PointCloud2)
    rows = np.zeros(2, PIXEL_TRACK_DTYPE)
    good = encode_table(10**9, "c", rows)
    bad = {
        "no field 'track_id'": encode_table(2 * 10**9, "c", np.zeros(2, DETECTION_DTYPE)),
        "bytes": good[: len(good) // 2],
        "stamps that increase": good,
    }
    publisher.publish(good)
    for n, (reason, cdr) in enumerate(bad.items(), 1):
        publisher.publish(cdr)
        probe.until(partial(refused, node, n), "the refusal")
        assert "/north/tracks_px" in str(node.diagnostics.last_refusal)
        assert reason in str(node.diagnostics.last_refusal)
    publisher.publish(encode_table(3 * 10**9, "c", rows))
    probe.until(lambda: len(tracks) == 2, "the good frames")
    assert node.diagnostics.received == 5
    status = probe.status_of("/north/homography")
    assert status["refused"] == "3"
    assert status["last_refusal"] == str(node.diagnostics.last_refusal)


def test_a_publisher_of_another_type_is_named(nodes: Composition, camera: MadeUpCamera) -> None:
    start(nodes, camera)
    # A context of its own: one DDS participant keeps one type per topic.
    with Composition(nodes.domain_id, quiet=True) as others:
        stranger = Probe(others, name="stranger")
        stranger.node.create_publisher(String, "tracks_px", 1)
        probe = Probe(nodes)
        probe.until(lambda: probe.node.count_publishers("/north/tracks_px") == 1, "the stranger")
        status = probe.status_of("/north/homography")
    assert "/north/tracks_px: found std_msgs/msg/String from node 'stranger'" in status["message"]
    assert "expected sensor_msgs/msg/PointCloud2" in status["message"]
    assert status["level"] == "1"


def test_a_source_that_starts_again_is_followed(nodes: Composition, camera: MadeUpCamera) -> None:
    node = start(nodes, camera)
    probe = Probe(nodes)
    tracks = probe.listen_tables("tracks", TRACK_DTYPE)
    probe.until(lambda: node.tracks.get_subscription_count() == 1, "the node to see the probe")
    send = probe.table_publisher("tracks_px")
    for _ in range(2):
        for k in range(FRAMES):
            send(int(camera.frames.stamp_ns[k]), camera.frames.frame(k))
    probe.until(lambda: len(tracks) == 2 * FRAMES, "both passes")
    for first, second in zip(tracks[:FRAMES], tracks[FRAMES:], strict=True):
        assert first[0] == second[0]
        assert first[2].tobytes() == second[2].tobytes()
    assert node.diagnostics.refused == 0


def test_diagnostics_name_every_control_point(nodes: Composition, camera: MadeUpCamera) -> None:
    start(nodes, camera)
    status = Probe(nodes).status_of("/north/homography")
    lines = [key for key in status if key.startswith("control_point_line_")]
    assert len(lines) == len(read_control_points(camera.calibration))
    assert all("px" in status[key] and " m" in status[key] for key in lines)


def test_control_points_of_another_image_are_doubted_in_diagnostics_and_in_every_row(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    node = start(nodes, camera, image_width=960, image_height=540)
    probe = Probe(nodes)
    tracks = probe.listen_tables("tracks", TRACK_DTYPE)
    probe.until(lambda: node.tracks.get_subscription_count() == 1, "the node to see the probe")
    status = probe.status_of("/north/homography")
    assert status["level"] == "1"
    assert "the image is 960x540, but the control points reach pixel" in status["message"]
    assert "the image is 960x540" in status["remarks"]
    send = probe.table_publisher("tracks_px")
    for k in range(FRAMES):
        send(int(camera.frames.stamp_ns[k]), camera.frames.frame(k))
    probe.until(lambda: len(tracks) == FRAMES, "all frames")
    rows = np.concatenate([rows for _, _, rows in tracks])
    assert len(rows)
    assert (rows["flags"] & FLAG_DOUBTFUL).all()


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"calibration_file": "/nowhere.csv"}, ("/nowhere.csv",)),
        ({"calibration_file": ""}, ("/north/homography", "calibration_file", "not empty")),
        ({"datum_latitude_deg": 43.0}, ("/north/homography", "both latitude and longitude")),
    ],
)
def test_a_bad_start_is_one_sentence(
    nodes: Composition, camera: MadeUpCamera, overrides: dict[str, Any], words: tuple[str, ...]
) -> None:
    with pytest.raises(GeoOrbitError) as caught:
        start(nodes, camera, **overrides)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words)


def test_the_lens_of_the_topic_is_taken_once_and_another_one_told(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    node, probe = start(nodes, camera), Probe(nodes)
    planes = probe.listen("road_plane", Float64MultiArray, LATCHED_ALL)
    send = probe.node.create_publisher(CameraInfo, "/north/camera_info", 10)
    probe.until(lambda: len(planes) == 1, "the plane")
    assert plane_of(planes[0], "here")[0].lens is None
    probe.until(lambda: send.get_subscription_count() == 1, "the node to see the probe")
    width, height = camera.image_size
    info = CameraInfo(width=width, height=height, distortion_model="plumb_bob")
    send.publish(info)  # of a camera that isn't calibrated
    info.k = [1500.0, 0.0, width / 2, 0.0, 1500.0, height / 2, 0.0, 0.0, 1.0]
    info.d = [-0.02, 0.0, 0.0, 0.0, 0.0]
    for _ in range(3):
        send.publish(info)
    probe.until(lambda: len(planes) == 2, "the plane behind the lens")
    lens = plane_of(planes[-1], "here")[0].lens
    assert lens is not None
    assert (lens.k1, lens.cx) == (-0.02, width / 2 + 0.5)
    info.d = [-0.2, 0.0, 0.0, 0.0, 0.0]
    send.publish(info)
    said = "another lens"
    probe.until(lambda: said in str(node.diagnostic_values()["remarks"]), "a remark")
    assert len(planes) == 2
