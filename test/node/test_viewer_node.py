"""A viewer sees every topic of the graph, byte for byte what was published."""

import time

import numpy as np
import pytest
from foxglove_client import FoxgloveClient
from geometry_msgs.msg import PoseArray
from nav_msgs.msg import Path as PathMessage
from probe import LIMIT_S, Probe
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.nodes.viewer import ViewerNode
from geoorbit_ros.storage.pointcloud2 import decode_table, encode_table
from geoorbit_ros.viewer.server import ViewerError, ViewerServer

QUICK = {"port": 0, "discovery_period_s": 0.05}
GEOJSON = '{"type": "FeatureCollection", "features": []}'
BOXES = np.array([(100.0, 50.0, 40.0, 20.0, 0.9, 2, 7, 0)], PIXEL_TRACK_DTYPE)


@pytest.fixture
def viewer(nodes: Composition) -> ViewerNode:
    return nodes.make(ViewerNode, "", QUICK)


def test_a_client_gets_every_channel_within_two_seconds_of_work_and_what_was_published(
    nodes: Composition, viewer: ViewerNode
) -> None:
    probe = Probe(nodes)
    lanes = PoseArray()
    lanes.header.frame_id = "map"
    path = PathMessage()
    path.header.frame_id = "map"
    messages = {
        "/north/lanes": lanes,
        "/north/lanes/lane_1/centerline": path,
        "/north/lanes/geojson": String(data=GEOJSON),
    }
    for topic, message in messages.items():
        probe.node.create_publisher(type(message), topic, LATCHED).publish(message)
    boxes = probe.node.create_publisher(PointCloud2, "/north/tracks_px", QoSProfile(depth=1))
    cdr = encode_table(5_000_000_000, "north_optical", BOXES)
    shown = {*messages, "/north/tracks_px", "/north/image/annotations", "/north/lanes/map"}
    nodes.wait(lambda: set(messages) <= viewer.server.topics, LIMIT_S, "topics found")

    started = time.process_time()  # which programs beside this one take none of
    with FoxgloveClient(viewer.server.port) as client:

        def all_seen() -> bool:
            boxes.publish(cdr)
            return shown <= set(client.received())

        nodes.wait(all_seen, LIMIT_S, "a message on every channel")
        assert time.process_time() - started < 2.0
        assert shown <= set(client.channels)
        received = client.received()

    for topic, message in messages.items():
        assert deserialize_message(received[topic][0], type(message)) == message
    stamp_ns, _, rows = decode_table(received["/north/tracks_px"][0], PIXEL_TRACK_DTYPE, "client")
    assert stamp_ns == 5_000_000_000
    assert rows.tobytes() == BOXES.tobytes()
    assert GEOJSON.encode() in received["/north/lanes/map"][0]


def test_the_schema_that_a_client_gets_decodes_the_message(
    nodes: Composition, viewer: ViewerNode
) -> None:
    probe = Probe(nodes)
    lanes = PoseArray()
    lanes.header.frame_id = "map"
    probe.node.create_publisher(PoseArray, "/north/lanes", LATCHED).publish(lanes)
    with FoxgloveClient(viewer.server.port) as client:
        nodes.wait(lambda: "/north/lanes" in client.received(), LIMIT_S, "the lanes")
        payload = client.received()["/north/lanes"][0]
        channel = client.channels["/north/lanes"]
    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(channel["schema"], channel["schemaName"]))
    decoded = store.deserialize_cdr(payload, channel["schemaName"])
    assert decoded.header.frame_id == "map"  # type: ignore[attr-defined]


def test_a_topic_is_read_only_while_somebody_looks(nodes: Composition, viewer: ViewerNode) -> None:
    probe = Probe(nodes)
    publisher = probe.node.create_publisher(PointCloud2, "/north/tracks_px", QoSProfile(depth=1))
    nodes.wait(lambda: "/north/tracks_px" in viewer.server.topics, LIMIT_S, "the topic found")
    assert publisher.get_subscription_count() == 0
    with FoxgloveClient(viewer.server.port):
        nodes.wait(lambda: publisher.get_subscription_count() == 1, LIMIT_S, "a subscription")
    nodes.wait(lambda: publisher.get_subscription_count() == 0, LIMIT_S, "its end")


def test_a_second_client_gets_what_is_latched(nodes: Composition, viewer: ViewerNode) -> None:
    probe = Probe(nodes)
    probe.node.create_publisher(String, "/north/lanes/geojson", LATCHED).publish(
        String(data=GEOJSON)
    )
    with FoxgloveClient(viewer.server.port) as first:
        nodes.wait(lambda: "/north/lanes/geojson" in first.received(), LIMIT_S, "the first")
        with FoxgloveClient(viewer.server.port) as second:
            nodes.wait(lambda: "/north/lanes/geojson" in second.received(), LIMIT_S, "the second")


def test_a_topic_without_publisher_is_withdrawn(nodes: Composition, viewer: ViewerNode) -> None:
    probe = Probe(nodes)
    publisher = probe.node.create_publisher(String, "/north/words", LATCHED)
    nodes.wait(lambda: "/north/words" in viewer.server.topics, LIMIT_S, "the topic found")
    probe.node.destroy_publisher(publisher)
    nodes.wait(lambda: "/north/words" not in viewer.server.topics, LIMIT_S, "its end")


def test_a_message_that_can_not_be_shown_is_refused_and_the_viewer_goes_on(
    nodes: Composition, viewer: ViewerNode
) -> None:
    probe = Probe(nodes)
    broken = probe.node.create_publisher(PointCloud2, "/north/tracks_px", LATCHED)

    def refused() -> bool:
        broken.publish(serialize_message(PointCloud2()))  # what nobody watches is not looked at
        return viewer.diagnostics.refused > 0

    with FoxgloveClient(viewer.server.port) as client:
        nodes.wait(refused, LIMIT_S, "a refusal")
        words = probe.node.create_publisher(String, "/north/words", LATCHED)
        words.publish(String(data="still here"))
        nodes.wait(lambda: "/north/words" in client.received(), LIMIT_S, "another topic")


def test_a_port_in_use_and_a_broken_pattern_are_named(nodes: Composition) -> None:
    server = ViewerServer("first", "127.0.0.1", 0)
    try:
        with pytest.raises(ViewerError, match=rf"127\.0\.0\.1:{server.port}.*in use"):
            nodes.make(ViewerNode, "", {"port": server.port})
    finally:
        server.close()
    with pytest.raises(ParameterError, match="'topics'"):
        nodes.make(ViewerNode, "", {**QUICK, "topics": "("})
