"""What a running fleet says and costs, sampled from outside."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from geoorbit_ros.fleet.health import Row, rows
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.diagnostics import StatusListener
from soak.processes import usage

TOPICS = {"tracks": PointCloud2, "lanes": PoseArray}
SAMPLE_S = 5.0


@dataclass
class Samples:
    """One row per `SAMPLE_S`.

    Attributes:
        minute: Since the beginning.
        memory_mb, cpu_s: By process.
        lost: By camera, frames dropped, missing or refused so far.
        latency_s: By (camera, topic): minute and seconds from stamp to arrival of every message.
        problems: What was not healthy at the end.
    """

    minute: list[float] = field(default_factory=list)
    memory_mb: list[dict[str, float]] = field(default_factory=list)
    cpu_s: list[dict[str, float]] = field(default_factory=list)
    lost: list[dict[str, float]] = field(default_factory=list)
    latency_s: dict[tuple[str, str], list[tuple[float, float]]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def after(self, warm_min: float, camera: str, topic: str) -> NDArray[np.float64]:
        """(N, 2) minute and latency after the warm-up."""
        table = np.array(self.latency_s[camera, topic]).reshape(-1, 2)
        return table[table[:, 0] > warm_min]


class Watch:
    """Listens to a fleet.

    Args:
        nodes: Where its own nodes run, in the fleet's ROS domain.
        cameras: Their ids.
        up_log: What `geoorbit up` says.
    """

    def __init__(self, nodes: Composition, cameras: Sequence[str], up_log: Path) -> None:
        self._nodes, self._up_log = nodes, up_log
        self._listener = nodes.add(StatusListener(nodes.context))
        self._node = nodes.add(Node("soak", context=nodes.context))
        self._began_s = time.monotonic()
        self.samples = Samples()
        qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
        for camera in cameras:
            for topic, kind in TOPICS.items():
                self.samples.latency_s[camera, topic] = []
                take = partial(self._take, camera, topic)
                self._node.create_subscription(kind, f"/{camera}/{topic}", take, qos, raw=True)

    def run(self, minutes: float) -> Samples:
        """Sample for so long."""
        samples = self.samples
        for heard in samples.latency_s.values():
            heard.clear()
        began = due = self._began_s = time.monotonic()
        while (elapsed_s := time.monotonic() - began) < 60.0 * minutes:
            self._nodes.spin()
            if time.monotonic() >= due:
                due += SAMPLE_S
                used = usage(self._up_log)
                samples.minute.append(elapsed_s / 60.0)
                samples.memory_mb.append({name: mb for name, (mb, _) in used.items()})
                samples.cpu_s.append({name: cpu for name, (_, cpu) in used.items()})
                samples.lost.append(
                    {r.name: float(r.values.get("lost", 0)) for r in self._rows()[0]}
                )
        cameras, services = self._rows()
        samples.problems = [f"{r.name}: {p}" for r in [*cameras, *services] for p in r.problems]
        return samples

    def _rows(self) -> tuple[list[Row], list[Row]]:
        return rows(self._listener.reports())

    def _take(self, camera: str, topic: str, cdr: bytes) -> None:
        sec, nanosec = np.frombuffer(cdr, "<u4", 2, 4).tolist()
        minute = (time.monotonic() - self._began_s) / 60.0
        late_s = time.time() - sec - 1e-9 * nanosec
        self.samples.latency_s[camera, topic].append((minute, late_s))
