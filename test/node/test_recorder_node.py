"""The recorder: what was on the topics is in the database, and nothing else."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from probe import LOSSLESS, Probe
from rclpy.parameter import Parameter
from std_msgs.msg import String

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.nodes.recorder import RecorderNode
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.nodes.traffic import TrafficNode
from geoorbit_ros.storage.database.writer import TrajectoryReader

SECOND_NS = 10**9


def table(n: int, first_id: int = 1) -> np.ndarray:
    rows = np.zeros(n, TRACK_DTYPE)
    rows["track_id"] = np.arange(first_id, first_id + n)
    rows["x"] = np.linspace(0, 1, n)
    return rows


def stored(path: Path) -> int:
    with TrajectoryReader(path) as reader:
        return sum(content.frames for content in reader.cameras())


def test_frames_are_readable_within_a_second_while_the_node_runs(
    nodes: Composition, tmp_path: Path
) -> None:
    path = tmp_path / "t.db"
    node = nodes.make(RecorderNode, "north", LOSSLESS | {"database": str(path)})
    probe = Probe(nodes)
    send = probe.table_publisher("tracks")
    for k in range(30):
        send((k + 1) * SECOND_NS // 30, table(k % 4))
    # The stream now falls silent: only the node's own timer can commit the rest.
    probe.until(lambda: stored(path) == 30, "all frames in the file")
    assert node.diagnostics.refused == 0
    content = TrajectoryReader(path).cameras()[0]
    assert content.camera_id == "north"
    assert content.rows == sum(k % 4 for k in range(30))


def test_lane_maps_are_stored_with_their_stamp(nodes: Composition, tmp_path: Path) -> None:
    path = tmp_path / "t.db"
    node = nodes.make(RecorderNode, "north", LOSSLESS | {"database": str(path)})
    probe = Probe(nodes)
    publisher = probe.publisher("lanes/geojson", String, LATCHED)
    text = '{"geoorbit": {"stamp_ns": 5000000000}}'
    publisher.publish(String(data=text))
    probe.until(lambda: node.lane_maps == 1, "the lane map")
    publisher.publish(String(data="not a lane map"))
    probe.until(lambda: node.diagnostics.refused == 1, "the refusal")
    assert "/north/lanes/geojson" in str(node.diagnostics.last_refusal)
    maps = list(TrajectoryReader(path).lane_maps("north"))
    assert maps == [(5 * SECOND_NS, text)]


def test_the_same_recording_twice_is_stored_once(nodes: Composition, tmp_path: Path) -> None:
    path = tmp_path / "t.db"
    node = nodes.make(RecorderNode, "north", LOSSLESS | {"database": str(path)})
    probe = Probe(nodes)
    send = probe.table_publisher("tracks")
    for _ in range(2):
        for k in range(10):
            send((k + 1) * SECOND_NS, table(2))
    probe.until(lambda: node.diagnostics.received == 20, "all frames")
    assert node.diagnostics.refused == 10
    probe.until(lambda: stored(path) == 10, "the first ten")


def test_one_stamp_of_the_future_deletes_nothing_and_stops_no_recording(
    nodes: Composition, tmp_path: Path
) -> None:
    path = tmp_path / "t.db"
    given = LOSSLESS | {"database": str(path), "retention_days": 30.0}
    first_ns = time.time_ns()
    senders = []
    probe = Probe(nodes)
    for namespace in ("north", "south"):
        node = nodes.make(RecorderNode, namespace, given)
        senders.append((node, probe.table_publisher(f"/{namespace}/tracks")))
    for _, send in senders:
        for k in range(100):
            send(first_ns + k * SECOND_NS // 30, table(1))
    send = senders[0][1]
    for days in (400, 3650):
        send(first_ns + days * 86_400 * SECOND_NS, table(1))
    for k in range(100, 200):
        send(first_ns + k * SECOND_NS // 30, table(1))
    probe.until(lambda: stored(path) == 300, "all that is good, of both cameras")
    north = senders[0][0]
    assert north.diagnostics.refused == 2
    for _ in range(3):  # each of which prunes
        north._maintain()
    assert stored(path) == 300


def test_a_sequence_of_the_future_is_refused_with_what_to_do(
    nodes: Composition, tmp_path: Path
) -> None:
    path = tmp_path / "t.db"
    node = nodes.make(RecorderNode, "north", LOSSLESS | {"database": str(path)})
    probe = Probe(nodes)
    send = probe.table_publisher("tracks")
    now_ns = time.time_ns()
    for k in range(5):
        send(now_ns + 3650 * 86_400 * SECOND_NS + k * SECOND_NS, table(1))
    probe.until(lambda: node.diagnostics.refused == 5, "five refusals")
    assert "set the clock" in str(node.diagnostics.last_refusal)
    for k in range(5):
        send(now_ns + k * SECOND_NS, table(1))
    probe.until(lambda: stored(path) == 5, "the camera with its clock put right")


@pytest.mark.parametrize(
    "text",
    [
        '{"geoorbit": {"stamp_ns": 1e400}}',
        '{"geoorbit": {"stamp_ns": 1' + "0" * 30 + "}}",
        '{"geoorbit": {"stamp_ns": 1' + "0" * 5000 + "}}",
        '{"geoorbit": {"stamp_ns": NaN}}',
        '{"geoorbit": {"stamp_ns": "5"}}',
        '{"geoorbit": {"stamp_ns": ' + str(2**62) + "}}",
        "[" * 100_000,
        '{"geoorbit": ' * 3000 + "1" + "}" * 3000,
    ],
    ids=["infinite", "30 digits", "5000 digits", "NaN", "text", "2116", "brackets", "objects"],
)
def test_a_hostile_lane_map_is_refused_and_the_next_one_is_stored(
    nodes: Composition, tmp_path: Path, text: str
) -> None:
    path = tmp_path / "t.db"
    node = nodes.make(RecorderNode, "north", LOSSLESS | {"database": str(path)})
    probe = Probe(nodes)
    publisher = probe.publisher("lanes/geojson", String, LATCHED)
    publisher.publish(String(data=text))
    probe.until(lambda: node.diagnostics.refused == 1, "the refusal")
    assert len(str(node.diagnostics.last_refusal)) < 300
    publisher.publish(String(data='{"geoorbit": {"stamp_ns": 5}}'))
    probe.until(lambda: node.lane_maps == 1, "the next map")


@pytest.mark.parametrize("node_class", [RecorderNode, TrafficNode])
def test_nobody_shortens_what_is_kept_while_the_node_runs(
    nodes: Composition, tmp_path: Path, node_class: type[GeoOrbitNode[Any]]
) -> None:
    node = nodes.make(node_class, "north", {"database": str(tmp_path / "t.db")})
    (result,) = node.set_parameters([Parameter("retention_days", value=1e-5)])
    assert not result.successful
    assert node.get_parameter("retention_days").value == 0.0


@pytest.mark.parametrize(
    ("namespace", "database", "words"),
    [
        ("", "t.db", ("/recorder", "'camera_id'")),
        ("north", "missing/there/t.db", ("t.db",)),
        ("north", "", ("/north/recorder", "'database'")),
    ],
)
def test_a_bad_start_is_one_sentence(
    nodes: Composition, tmp_path: Path, namespace: str, database: str, words: tuple[str, ...]
) -> None:
    path = str(tmp_path / database) if database else ""
    with pytest.raises(GeoOrbitError) as caught:
        nodes.make(RecorderNode, namespace, {"database": path})
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words), str(caught.value)
