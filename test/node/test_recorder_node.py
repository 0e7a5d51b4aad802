"""The recorder: what was on the topics is in the database, and nothing else."""

from pathlib import Path

import numpy as np
import pytest
from probe import LOSSLESS, Probe
from std_msgs.msg import String

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.nodes.recorder import DAY_NS, RecorderNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED
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


def test_old_data_goes(nodes: Composition, tmp_path: Path) -> None:
    path = tmp_path / "t.db"
    given = LOSSLESS | {"database": str(path), "retention_days": 1.0}
    nodes.make(RecorderNode, "north", given)
    probe = Probe(nodes)
    send = probe.table_publisher("tracks")
    for k in range(5):
        send(DAY_NS + k * SECOND_NS, table(1))
    probe.until(lambda: stored(path) == 5, "five frames")
    send(3 * DAY_NS, table(1))
    probe.until(lambda: stored(path) == 1, "the newest alone")


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
