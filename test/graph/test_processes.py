"""One process per node, started as users start them."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from made_up_camera import MadeUpCamera
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from geoorbit_ros.cli.main import main
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.process import _name_claimed
from geoorbit_ros.nodes.support.qos import LATCHED_ALL
from geoorbit_ros.storage.database.writer import TrajectoryReader

REPOSITORY = Path(__file__).parents[2]
LIMIT_S = 120.0


class Fleet:
    """Node processes in one ROS domain, and a node of the test among them."""

    def __init__(self, nodes: Composition, folder: Path) -> None:
        self.nodes, self._folder = nodes, folder
        self.node = nodes.add(Node("watcher", context=nodes.context, namespace="north"))
        self.status: dict[str, dict[str, str]] = {}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_status, 100)

    def _on_status(self, array: DiagnosticArray) -> None:
        for status in array.status:
            self.status[status.name] = {pair.key: pair.value for pair in status.values}

    def start(self, name: str, namespace: str = "/north", **parameters: object) -> None:
        words = [sys.executable, "-m", f"geoorbit_ros.nodes.{name}", "--ros-args"]
        words += ["-r", f"__ns:={namespace}"]
        for key, value in parameters.items():
            words += ["-p", f"{key}:={value}"]
        environment = os.environ | {
            "ROS_DOMAIN_ID": str(self.nodes.domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "PYTHONPATH": str(REPOSITORY),
        }
        with (self._folder / f"{name}.log").open("wb") as log:
            self.processes[name] = subprocess.Popen(
                words, env=environment, stdout=log, stderr=subprocess.STDOUT
            )

    def log(self, name: str) -> str:
        return (self._folder / f"{name}.log").read_text()

    def until(self, met: Callable[[], Any], what: str) -> None:
        def alive() -> bool:
            for name, process in self.processes.items():
                assert process.poll() in (None, 0), f"{name} died: {self.log(name)}"
            return bool(met())

        self.nodes.wait(alive, LIMIT_S, what)

    def value(self, node: str, key: str) -> str:
        return self.status.get(f"/north/{node}", {}).get(key, "")

    def stop(self, name: str, with_signal: signal.Signals) -> int:
        process = self.processes.pop(name)
        process.send_signal(with_signal)
        return process.wait(LIMIT_S)


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    with Composition() as nodes:
        fleet = Fleet(nodes, tmp_path)
        yield fleet
        for process in fleet.processes.values():
            process.kill()
            process.wait()


def test_a_second_node_of_one_name_says_who_is_there_and_ends(fleet: Fleet) -> None:
    fleet.start("tracker")
    fleet.until(lambda: "/north/tracker" in fleet.status, "the first tracker")
    first = fleet.processes.pop("tracker")
    fleet.start("tracker")
    assert fleet.processes.pop("tracker").wait(LIMIT_S) == 2
    said = fleet.log("tracker")
    domain = fleet.nodes.domain_id
    assert f"node '/north/tracker' of domain {domain}: found process {first.pid}, which" in said
    assert first.poll() is None
    fleet.start("tracker", namespace="/south")
    fleet.processes["first"] = first
    fleet.until(lambda: "/south/tracker" in fleet.status, "a tracker of another camera")
    first.kill()  # whatever way it ends, its name is free
    assert fleet.processes.pop("first").wait(LIMIT_S) == -signal.SIGKILL
    fleet.stop("tracker", signal.SIGTERM)
    fleet.status.clear()
    fleet.start("tracker")
    fleet.until(lambda: "/north/tracker" in fleet.status, "a tracker again")


def test_however_many_ask_for_a_name_none_waits_and_long_names_are_told_apart(
    fleet: Fleet,
) -> None:
    context = fleet.nodes.context
    first, other = (
        fleet.nodes.add(Node(f"{'n' * 120}_{end}", context=context)) for end in ("a", "b")
    )
    with _name_claimed(first), _name_claimed(other):  # type: ignore[arg-type]
        for _ in range(300):
            with pytest.raises(ParameterError, match="which has this name"):
                _name_claimed(first)  # type: ignore[arg-type]


def test_four_processes_give_the_bytes_of_the_offline_command(
    fleet: Fleet, camera: MadeUpCamera, tmp_path: Path
) -> None:
    lossless: dict[str, Any] = {"reliability": "reliable", "queue_depth": 0, "use_sim_time": "true"}
    database = tmp_path / "t.db"
    fleet.start("homography", calibration_file=camera.calibration, **lossless)
    fleet.start("lane_geometry", **lossless)
    fleet.start("recorder", database=database, **lossless)
    texts: list[String] = []
    fleet.node.create_subscription(String, "lanes/geojson", texts.append, LATCHED_ALL)
    update = fleet.node.create_client(Trigger, "lane_geometry/update")
    fleet.until(
        lambda: (
            fleet.value("homography", "tracks_subscribers") == "2"
            and fleet.value("lane_geometry", "datum") == "known"
            and update.service_is_ready()
        ),
        "three nodes that found each other",
    )

    fleet.start("bag_player", namespace="/", bag=camera.bag, rate=10, queue_depth=0)
    fleet.until(lambda: fleet.processes["bag_player"].poll() == 0, "the player's end")
    everything = str(len(camera.frames))
    fleet.until(lambda: fleet.value("lane_geometry", "frames") == everything, "all frames")
    answer = update.call_async(Trigger.Request())
    fleet.until(answer.done, "an answer of lane_geometry/update")
    assert answer.result().message == f"3 lanes from {everything} frames"

    out = tmp_path / "lanes.geojson"
    words = ["lanes", "--bag", camera.bag, "--calibration", camera.calibration, "--out", out]
    assert main([str(word) for word in words]) == 0
    fleet.until(lambda: texts and texts[-1].data == out.read_text(), "the same bytes")

    assert fleet.stop("homography", signal.SIGINT) == 0
    assert fleet.stop("lane_geometry", signal.SIGTERM) == 0
    fleet.until(lambda: fleet.value("recorder", "received") == everything, "all frames recorded")
    assert fleet.stop("recorder", signal.SIGTERM) == 0
    for name in ("homography", "lane_geometry", "recorder", "bag_player"):
        assert "Traceback" not in fleet.log(name)
    with TrajectoryReader(database) as reader:
        assert [content.frames for content in reader.cameras()] == [len(camera.frames)]


def test_a_bad_parameter_ends_the_process_with_one_sentence(
    fleet: Fleet, camera: MadeUpCamera
) -> None:
    fleet.start("homography", calibration_file=camera.calibration, image_width=-5)
    process = fleet.processes.pop("homography")
    assert process.wait(LIMIT_S) == 2
    assert fleet.log("homography").strip() == (
        "node '/north/homography', parameter 'image_width': "
        "found -5, expected a whole number from 16 to 32768"
    )
