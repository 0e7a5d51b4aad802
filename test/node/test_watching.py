"""A camera from images to lanes, with the twin: all that people look at is there."""

import base64
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from foxglove_client import FoxgloveClient
from geometry_msgs.msg import PoseArray
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from probe import LIMIT_S, Probe
from rclpy.expand_topic_name import expand_topic_name
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.conversions import decode_string, message_class
from geoorbit_ros.fleet.fleet_io import load_fleet
from geoorbit_ros.fleet.prepare import prepare
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.fleet_process import node_class
from geoorbit_ros.nodes.support.qos import LATCHED_ALL
from geoorbit_ros.nodes.viewer import ViewerNode
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.viewer.layout import ANNOTATIONS, LANE_MAP, layout_topics, make_layout

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
SCENE = "scene:straight_3x3?size=480x270&fps=10&duration=45"
FRAMES = 2000
"""Four times the film: enough for lanes, if they come at all."""
LOSSLESS = {"reliability": "reliable", "queue_depth": 0}
"""On a busy machine the film takes longer, but no image is lost: the lanes do not depend on it."""
RATE = 0.5
"""Slow enough for a seventh of a core: what people look at is late where there is a backlog."""
PARAMETERS: dict[str, dict[str, object]] = {
    "camera": {"rate": RATE, **LOSSLESS},
    "detector": LOSSLESS,
    "tracker": LOSSLESS,
    "homography": LOSSLESS,
    "lane_geometry": LOSSLESS,
}
RVIZ_TYPES = {
    "rviz_default_plugins/Image": "sensor_msgs/msg/CompressedImage",
    "rviz_default_plugins/Path": "nav_msgs/msg/Path",
    "rviz_default_plugins/PoseArray": "geometry_msgs/msg/PoseArray",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
}
LATCHED_IN_RVIZ = ("Reliable", "Transient Local")
STREAM = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)


@dataclass
class Graph:
    """The nodes of a fleet with one camera and a twin, in this process.

    Attributes:
        frames: Serialised vehicles, one message per image of the film.
        sent: Serialised messages by topic, of topics that `hear` was called with.
    """

    nodes: Composition
    probe: Probe
    viewer: ViewerNode
    frames: list[bytes] = field(default_factory=list)
    sent: dict[str, list[bytes]] = field(default_factory=dict)

    def wait(self, met: Callable[[], bool], what: str) -> None:
        """Wait while images come, however slowly, for some rounds of the film at most."""
        self.nodes.wait(met, LIMIT_S, what, lambda: min(len(self.frames), FRAMES))

    def types(self) -> dict[str, list[str]]:
        return dict(self.probe.node.get_topic_names_and_types())

    def hear(self, topic: str) -> None:
        """Keep what is published there from now on; the last message, if it is latched."""
        ends = self.probe.node.get_publishers_info_by_topic(topic)
        latched = any(end.qos_profile.durability.name == "TRANSIENT_LOCAL" for end in ends)
        kind = message_class(self.types()[topic][0])
        heard = self.sent.setdefault(topic, [])
        qos = LATCHED_ALL if latched else STREAM
        self.probe.node.create_subscription(kind, topic, heard.append, qos, raw=True)


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    folder = tmp_path_factory.mktemp("watching")
    scene = load_scene("straight_3x3")
    datum = Datum(scene.place.latitude_deg, scene.place.longitude_deg)
    network = write_network(place_roads(scene), folder, datum)
    content = {
        "name": "watched",
        "cameras": [{"id": "north", "source": SCENE, "parameters": PARAMETERS}],
        "twin": {"network": str(network)},
    }
    file = folder / "fleet.yaml"
    file.write_text(yaml.safe_dump(content))
    fleet, _ = load_fleet(file)
    with Composition(quiet=True) as nodes:
        for plan in prepare(fleet, folder, folder / "out"):
            for node in plan.nodes:
                nodes.make(node_class(node.executable), node.namespace, node.parameters)
        viewer = nodes.make(ViewerNode, "", {"port": 0, "discovery_period_s": 0.1})
        graph = Graph(nodes, Probe(nodes), viewer)
        graph.probe.node.create_subscription(
            PoseArray, "/north/vehicles", graph.frames.append, STREAM, raw=True
        )
        graph.wait(lambda: "/north/lanes/lane_1/centerline" in graph.types(), "a confirmed lane")
        yield graph


def rviz_displays() -> list[dict[str, Any]]:
    content = yaml.safe_load((ROOT / "params" / "geoorbit.rviz").read_text())
    displays: list[dict[str, Any]] = content["Visualization Manager"]["Displays"]
    return [display for display in displays if "Topic" in display]


def test_every_display_of_rviz_finds_its_topic_with_its_type_and_quality_of_service(
    graph: Graph,
) -> None:
    displays = rviz_displays()
    assert {display["Class"] for display in displays} == set(RVIZ_TYPES)
    for display in displays:
        topic = expand_topic_name(display["Topic"]["Value"], "rviz", "/north")
        ends = graph.probe.node.get_publishers_info_by_topic(topic)
        assert [end.topic_type for end in ends] == [RVIZ_TYPES[display["Class"]]], topic
        offered = ends[0].qos_profile
        asked = display["Topic"]["Reliability Policy"], display["Topic"]["Durability Policy"]
        latched = offered.durability.name == "TRANSIENT_LOCAL"
        assert (asked == LATCHED_IN_RVIZ) == latched, topic


def test_a_viewer_gets_every_channel_in_time_and_decodes_what_was_published(graph: Graph) -> None:
    def lanes_offered() -> set[str]:
        topics = graph.viewer.server.topics
        return {topic for topic in topics if topic.startswith("/north/lanes/lane_")}

    graph.wait(lambda: len(lanes_offered()) >= 3, "a lane's paths offered")
    offered, lanes = graph.viewer.server.topics, lanes_offered()
    shown = layout_topics(["north"])
    derived = {f"/north/{name}" for name in (ANNOTATIONS, LANE_MAP)}
    wanted = shown | lanes | {"/north/image/annotated/compressed", "/north/tracks_px"}
    assert wanted - derived <= offered
    for topic in (wanted - derived) | {"/north/lanes/geojson"}:
        graph.hear(topic)

    # Processor time of this process, in which all of it runs: others beside it take none of that.
    began = time.process_time()
    with FoxgloveClient(graph.viewer.server.port) as client:
        graph.wait(lambda: wanted <= set(client.received()), "all channels")
        took_s = time.process_time() - began
        received, channels = client.received(), client.channels
    assert took_s < 2.0

    for topic in wanted - derived:
        sent = graph.sent[topic]
        graph.nodes.wait(partial(any_of, received[topic], sent), LIMIT_S, f"{topic} as published")
        decode = ros_decoder(channels[topic])
        decode(received[topic][-1])
    boxes = protobuf_decoder(channels[f"/north/{ANNOTATIONS}"])
    assert any(len(boxes(payload).points) for payload in received[f"/north/{ANNOTATIONS}"])
    shown_map = protobuf_decoder(channels[f"/north/{LANE_MAP}"])(received[f"/north/{LANE_MAP}"][-1])
    graph.nodes.wait(
        lambda: shown_map.geojson in map(text_of, graph.sent["/north/lanes/geojson"]),
        LIMIT_S,
        "the map as published",
    )


def text_of(cdr: bytes) -> str:
    return decode_string(cdr, "the lane map")


def any_of(received: list[bytes], sent: list[bytes]) -> bool:
    return bool(set(received) & set(sent))


def ros_decoder(channel: dict[str, Any]) -> Callable[[bytes], Any]:
    """By the schema that the viewer was given, and nothing else."""
    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(channel["schema"], channel["schemaName"]))
    return lambda payload: store.deserialize_cdr(payload, channel["schemaName"])


def protobuf_decoder(channel: dict[str, Any]) -> Callable[[bytes], Any]:
    assert channel["encoding"] == "protobuf"
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
    return lambda payload: kind.FromString(payload)


def test_a_layout_shows_what_the_graph_has(graph: Graph) -> None:
    text = str(make_layout(["north"]))
    topics = set(graph.types()) | {f"/north/{name}" for name in (ANNOTATIONS, LANE_MAP)}
    for topic in layout_topics(["north"]):
        assert topic in topics
        assert topic in text
