"""`geoorbit up` in a process of its own, as a user starts it, and what its graph says meanwhile."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String

from geoorbit_ros.fleet.health import NodeReport
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.diagnostics import StatusListener
from geoorbit_ros.nodes.support.qos import LATCHED_ALL

REPOSITORY = Path(__file__).parents[2]
GEOORBIT = (sys.executable, "-m", "geoorbit_ros.cli.main")
LIMIT_S = 240.0


def environment() -> dict[str, str]:
    local = {"PYTHONPATH": str(REPOSITORY), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return dict(os.environ) | local


class RunningFleet:
    """A fleet file that runs.

    Attributes:
        maps: Lane maps by camera, as they came.
    """

    def __init__(self, nodes: Composition, file: Path, cameras: tuple[str, ...]) -> None:
        self.nodes, self.file, self.output = nodes, file, file.parent / "out"
        self.log = file.parent / "up.log"
        self.listener = nodes.add(StatusListener(nodes.context))
        self.maps: dict[str, list[dict[str, Any]]] = {camera: [] for camera in cameras}
        self.node = nodes.add(Node("watcher", context=nodes.context))
        for camera, maps in self.maps.items():

            def take(message: String, maps: list[dict[str, Any]] = maps) -> None:
                maps.append(json.loads(message.data))

            topic = f"/{camera}/lanes/geojson"
            self.node.create_subscription(String, topic, take, LATCHED_ALL)
        words = [*GEOORBIT, "up", str(file), "--out", str(self.output)]
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(words, env=environment(), stdout=log, stderr=log)

    def report(self, node: str) -> NodeReport | None:
        return next((r for r in self.listener.reports() if r.name == node), None)

    def value(self, node: str, key: str) -> float:
        report = self.report(node)
        return float(report.values.get(key) or 0.0) if report else 0.0

    def pid(self, name: str) -> int:
        """Of the process started last under this name."""
        return int(re.findall(rf"{name}  started, process (\d+)", self.log.read_text())[-1])

    def until(self, met: Callable[[], object], what: str) -> None:
        self.nodes.wait(lambda: bool(met()), LIMIT_S, f"{what}; {self.log.read_text()}")

    def kill(self, name: str) -> float:
        """`kill -9` of a process; waits for the next one; returns the monotonic time of the kill.

        Its last words and its open sockets outlive it by a moment: what is heard before the next
        one has started says nothing about that one.
        """
        pid, killed_s = self.pid(name), time.monotonic()
        os.kill(pid, signal.SIGKILL)
        self.until(lambda: self.pid(name) != pid, f"another {name}")
        return killed_s

    def heard_since(self, node: str, moment_s: float) -> bool:
        report = self.report(node)
        return report is not None and report.age_s < time.monotonic() - moment_s

    def lane_ids(self, camera: str) -> set[int]:
        """Confirmed lanes of the newest map."""
        properties = [feature["properties"] for feature in self.maps[camera][-1]["features"]]
        return {p["lane_id"] for p in properties if p["status"] == "confirmed"}

    def ask_status(self) -> dict[str, Any]:
        """`geoorbit status` from another terminal."""
        words = [*GEOORBIT, "status", str(self.file), "--once", "--json", "--wait", "60"]
        done = subprocess.run(
            words, env=environment(), stdout=subprocess.PIPE, timeout=LIMIT_S, check=False
        )
        answer: dict[str, Any] = json.loads(done.stdout)
        assert done.returncode == (0 if answer["healthy"] else 1)
        return answer

    def stop(self) -> None:
        """Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(LIMIT_S) == 0
