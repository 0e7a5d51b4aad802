"""A fleet from one file, as a user starts it: healthy, killed, back, stopped."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from made_up_camera import MadeUpCamera
from rclpy.node import Node
from std_msgs.msg import String

from geoorbit_ros.nodes.composition import Composition
from geoorbit_ros.nodes.latched import LATCHED_ALL
from geoorbit_ros.nodes.status_listener import StatusListener
from geoorbit_ros.storage.database import TrajectoryReader

REPOSITORY = Path(__file__).parents[2]
LIMIT_S = 90.0
BACK_S, STOP_S = 10.0, 5.0
FLUSH_S = 1.0


GEOORBIT = (sys.executable, "-m", "geoorbit_ros.cli.main")


def environment() -> dict[str, str]:
    local = {"PYTHONPATH": str(REPOSITORY), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return dict(os.environ) | local


class RunningFleet:
    """`geoorbit up` in a process of its own, and a listener on its ROS domain."""

    def __init__(self, nodes: Composition, folder: Path, camera: MadeUpCamera) -> None:
        self.nodes, self.output = nodes, folder / "out"
        self.file = folder / "fleet.yaml"
        cameras = "".join(
            f"  - id: {name}\n    source: bag:{camera.bag}\n    calibration: {camera.calibration}\n"
            for name in ("north", "south")
        )
        self.file.write_text(
            f"name: pair\ndomain_id: {nodes.domain_id}\ncameras:\n{cameras}recorder: {{}}\n"
        )
        self.listener = nodes.add(StatusListener(nodes.context))
        self.maps: list[dict[str, object]] = []
        watcher = nodes.add(Node("watcher", context=nodes.context))
        watcher.create_subscription(String, "/north/lanes/geojson", self._on_map, LATCHED_ALL)
        words = [*GEOORBIT, "up", str(self.file), "--out", str(self.output)]
        with (folder / "up.log").open("wb") as log:
            self.process = subprocess.Popen(words, env=environment(), stdout=log, stderr=log)
        self.log = folder / "up.log"

    def _on_map(self, message: String) -> None:
        self.maps.append(json.loads(message.data))

    def value(self, node: str, key: str) -> float:
        for report in self.listener.reports():
            if report.name == node and report.values.get(key):
                return float(report.values[key])
        return 0.0

    def pid(self, name: str) -> int:
        """Of the process started last under this name."""
        return int(re.findall(rf"{name}  started, process (\d+)", self.log.read_text())[-1])

    def until(self, met: Callable[[], bool], what: str) -> None:
        self.nodes.wait(met, LIMIT_S, f"{what}; {self.log.read_text()}")

    def ask_status(self) -> dict[str, Any]:
        """`geoorbit status` from another terminal."""
        words = [*GEOORBIT, "status", str(self.file), "--once", "--json", "--wait", "20"]
        done = subprocess.run(
            words, env=environment(), stdout=subprocess.PIPE, timeout=LIMIT_S, check=False
        )
        answer: dict[str, Any] = json.loads(done.stdout)
        assert done.returncode == (0 if answer["healthy"] else 1)
        return answer

    def lane_ids(self) -> set[int]:
        """Confirmed lanes of the newest map."""
        features = self.maps[-1]["features"]
        assert isinstance(features, list)
        properties = [feature["properties"] for feature in features]
        return {p["lane_id"] for p in properties if p["status"] == "confirmed"}


@pytest.fixture
def fleet(tmp_path: Path, camera: MadeUpCamera) -> Iterator[RunningFleet]:
    with Composition(quiet=True) as nodes:
        running = RunningFleet(nodes, tmp_path, camera)
        yield running
        running.process.send_signal(signal.SIGINT)
        running.process.wait(LIMIT_S)


@pytest.mark.slow
def test_a_killed_camera_is_back_in_time_with_its_lanes_and_its_recording(
    fleet: RunningFleet,
) -> None:
    fleet.until(lambda: fleet.value("/north/lane_geometry", "lanes_confirmed") == 3, "lanes")
    fleet.until(lambda: fleet.value("/south/lane_geometry", "frames") > 0, "the other camera")
    answer = fleet.ask_status()
    assert answer["healthy"]
    assert [row["name"] for row in answer["cameras"]] == ["north", "south"]
    assert answer["cameras"][0]["values"]["lanes_confirmed"] == 3
    before, other = fleet.lane_ids(), fleet.pid("south")

    maps = len(fleet.maps)
    killed_ns = time.time_ns()
    os.kill(fleet.pid("north"), signal.SIGKILL)
    fleet.until(lambda: len(fleet.maps) > maps, "a map after the kill")
    assert time.time_ns() - killed_ns < BACK_S * 1e9
    assert fleet.lane_ids() == before
    assert fleet.pid("south") == other

    fleet.until(lambda: len(fleet.maps) > maps + 1, "a map of new traffic")
    assert fleet.lane_ids() == before

    fleet.process.send_signal(signal.SIGINT)
    asked = time.monotonic()
    assert fleet.process.wait(LIMIT_S) == 0
    assert time.monotonic() - asked < STOP_S + 1.0  # and Python's own end
    for name in ("north", "south"):
        with pytest.raises(ProcessLookupError):
            os.kill(fleet.pid(name), 0)
    with TrajectoryReader(fleet.output / "recordings" / "north.db") as reader:
        stamps = reader.read("north").stamp_ns
    kept = stamps[stamps < killed_ns]
    assert killed_ns - kept[-1] < (FLUSH_S + 0.5) * 1e9
    assert stamps[-1] > killed_ns
