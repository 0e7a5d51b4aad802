"""The node graph under load: 8 cameras × 30 frames per second × 20 vehicles for a minute.

One process per camera holds its `homography` and `lane_geometry`, as `geoorbit up` composes them.
This process plays the eight trackers: it publishes `tracks_px` of every camera at 30 Hz and times
each frame until its `tracks` come back. Every frame sent must come through both nodes.

    python benchmarks/graph_load.py [--cameras 8] [--seconds 60] [--processes 8]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, TRACK_DTYPE
from geoorbit_ros.nodes.homography import HomographyNode
from geoorbit_ros.nodes.lane_geometry import LaneGeometryNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import stream_qos
from geoorbit_ros.storage.pointcloud2 import decode_table, encode_table

FRAMES_PER_S, VEHICLES, CORES = 30, 20, 2
LANE_X_M = np.array([-5.4, -1.8, 1.8, 5.4])
ROAD_M, SPEED_M_S = 150.0, 20.0
VEHICLE_M = np.array([1.8, 4.5, 1.5])  # width, length, height
IMAGE_SIZE, FOCAL_PX, HEIGHT_M, PITCH_RAD, NEAREST_M = (1920, 1080), 1200.0, 12.0, 0.26, 30.0
WARM_UP_S = 12.0  # imports, first serialisation, two lane updates
LIMIT_S = 60.0
STREAM = {"reliability": "reliable"}

Array = NDArray[np.float64]


def to_pixel(xyz_m: Array) -> Array:
    """Pixels (..., 2) of points (..., 3) seen from a pole at the road's near end."""
    x, y, z = np.moveaxis(xyz_m, -1, 0)
    sin, cos = np.sin(PITCH_RAD), np.cos(PITCH_RAD)
    ahead, below = y + NEAREST_M, HEIGHT_M - z
    depth = cos * ahead + sin * below
    u = IMAGE_SIZE[0] / 2 + FOCAL_PX * x / depth
    v = IMAGE_SIZE[1] / 2 + FOCAL_PX * (cos * below - sin * ahead) / depth
    return np.stack((u, v), axis=-1)


def traffic(frame: int) -> NDArray[np.void]:
    """Boxes of the vehicles in one frame: evenly spaced, four lanes, new ids on every pass."""
    k = np.arange(VEHICLES)
    travelled = (
        SPEED_M_S * frame / FRAMES_PER_S + ROAD_M * (k // 4) / (VEHICLES / 4) + 7.0 * (k % 4)
    )
    x = LANE_X_M[k % 4] + 0.2 * np.sin(travelled // ROAD_M * 1.7 + k)
    centre = np.stack((x, travelled % ROAD_M, np.full(VEHICLES, VEHICLE_M[2] / 2)), axis=-1)
    signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
    corner = to_pixel(centre[:, None] + signs * VEHICLE_M)
    low, high = corner.min(axis=1), corner.max(axis=1)
    rows = np.zeros(VEHICLES, PIXEL_TRACK_DTYPE)
    rows["x"], rows["y"] = ((low + high) / 2).T
    rows["width"], rows["height"] = (high - low).T
    rows["score"], rows["class_id"] = 0.9, 2
    rows["track_id"] = 1 + k + VEHICLES * (travelled // ROAD_M).astype(np.int64)
    return rows


def write_calibration(path: Path) -> None:
    """Control points of that camera."""
    lines = ["pixel_x,pixel_y,x_m,y_m"]
    for x in (-8.0, 0.0, 8.0):
        for y in (5.0, 40.0, 80.0, 140.0):
            u, v = to_pixel(np.array([x, y, 0.0]))
            lines.append(f"{u:.4f},{v:.4f},{x},{y}")
    path.write_text("\n".join(lines) + "\n")


def run_cameras(names: list[str], domain_id: int, calibration: str) -> None:
    """The nodes of some cameras, until the process is killed."""
    fixed = {"datum_latitude_deg": 43.05, "datum_longitude_deg": -89.35}
    with Composition(domain_id, quiet=True) as nodes:
        for name in names:
            nodes.make(LaneGeometryNode, name, STREAM)
            nodes.make(HomographyNode, name, STREAM | fixed | {"calibration_file": calibration})
        while True:
            nodes.spin(1.0)


def cpu_s(pid: int) -> float:
    """Processor time of a process so far: proc(5), fields utime and stime."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Load:
    """The trackers of all cameras, and the watch on what comes of their frames."""

    def __init__(self, nodes: Composition, names: list[str]) -> None:
        self.nodes, self.sent = nodes, 0
        self.node = nodes.add(Node("load", context=nodes.context))
        qos = stream_qos("reliable", 300)
        topics = {name: f"/{name}/tracks_px" for name in names}
        self.publishers = {
            name: self.node.create_publisher(PointCloud2, topic, qos)
            for name, topic in topics.items()
        }
        self.latency_s: list[float] = []
        self.returned = 0
        self._sent_s: dict[tuple[str, int], float] = {}
        self.status: dict[str, dict[str, str]] = {}
        for name in names:
            take = partial(self._on_tracks, name)
            self.node.create_subscription(PointCloud2, f"/{name}/tracks", take, qos, raw=True)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_status, 1000)

    def _on_tracks(self, name: str, cdr: bytes) -> None:
        stamp_ns, _, _ = decode_table(cdr, TRACK_DTYPE, name)
        self.latency_s.append(time.perf_counter() - self._sent_s.pop((name, stamp_ns)))
        self.returned += 1

    def _on_status(self, array: DiagnosticArray) -> None:
        for status in array.status:
            self.status[status.name] = {pair.key: pair.value for pair in status.values}

    def count(self, node: str, key: str) -> int:
        """One counter, summed over the cameras; -1 while a node has not reported."""
        found = [self.status.get(f"/{name}/{node}", {}).get(key) for name in self.publishers]
        return -1 if None in found else sum(int(value or 0) for value in found)

    def ready(self) -> bool:
        """Whether every node hears and is heard."""
        return (
            all(p.get_subscription_count() == 1 for p in self.publishers.values())
            and self.count("homography", "tracks_subscribers") == 2 * len(self.publishers)
            and self.count("lane_geometry", "received") == 0
        )

    def play(self, first: int, frames: int) -> int:
        """Send frames at 30 Hz, the cameras one after the other within the interval."""
        start = time.perf_counter()
        step_s = 1.0 / FRAMES_PER_S / len(self.publishers)
        turn = 0
        for frame in range(first, first + frames):
            rows = traffic(frame)
            stamp_ns = 10**9 + frame * 10**9 // FRAMES_PER_S
            for name, publisher in self.publishers.items():
                while (wait_s := start + turn * step_s - time.perf_counter()) > 0:
                    self.nodes.spin(min(wait_s, 0.01))
                turn += 1
                self._sent_s[name, stamp_ns] = time.perf_counter()
                publisher.publish(encode_table(stamp_ns, name, rows))
                self.sent += 1
        return first + frames

    def settle(self) -> int:
        """Wait until the nodes have reported all frames, or nothing changes; frames lost."""
        seen: Callable[[], int] = lambda: self.count("lane_geometry", "received")  # noqa: E731
        deadline, last = time.monotonic() + 10.0, -1
        while seen() < self.sent and time.monotonic() < deadline:
            self.nodes.spin()
            if seen() != last:
                deadline, last = time.monotonic() + 10.0, seen()
        return self.sent - seen()


def measure(cameras: int, seconds: float, processes: int) -> None:
    """Run the graph and print the ratios as JSON, the rest on standard error."""
    names = [f"camera_{k}" for k in range(cameras)]
    with tempfile.TemporaryDirectory() as folder, Composition(quiet=True) as nodes:
        calibration = Path(folder) / "calibration.csv"
        write_calibration(calibration)
        load = Load(nodes, names)
        common = [sys.executable, __file__, "--domain-id", str(nodes.domain_id)]
        common += ["--calibration", str(calibration), "--run"]
        children = [
            subprocess.Popen([*common, *names[k::processes]])
            for k in range(min(processes, cameras))
        ]
        try:
            nodes.wait(load.ready, LIMIT_S, f"{2 * cameras} nodes that hear each other")
            frame = load.play(0, round(WARM_UP_S * FRAMES_PER_S))
            load.latency_s.clear()
            pids = [child.pid for child in children]
            before = [cpu_s(pid) for pid in [*pids, os.getpid()]]
            start = time.perf_counter()
            load.play(frame, round(seconds * FRAMES_PER_S))
            wall_s = time.perf_counter() - start
            used = [cpu_s(pid) - b for pid, b in zip([*pids, os.getpid()], before, strict=True)]
            lost = load.settle()
            lanes = load.count("lane_geometry", "lanes_confirmed")
            missing = load.count("lane_geometry", "missing")
        finally:
            for child in children:
                child.kill()
                child.wait()
    median, p99 = np.quantile(np.array(load.latency_s) * 1e3, [0.5, 0.99])
    print(
        f"{cameras} cameras x {FRAMES_PER_S} Hz x {VEHICLES} vehicles, {len(children)} processes, "
        f"{wall_s:.1f} s: sent {load.sent}, through homography {load.returned}, lost {lost}, "
        f"missing {missing}, lanes {lanes}; processor {sum(used[:-1]) / wall_s:.2f} cores "
        f"(and the load {used[-1] / wall_s:.2f}); tracks_px to tracks {median:.2f} ms median, "
        f"{p99:.2f} ms p99, {max(load.latency_s) * 1e3:.0f} ms at most",
        file=sys.stderr,
    )
    what = f"{cameras} cameras x {FRAMES_PER_S} Hz x {VEHICLES} vehicles"
    for name, ratio, limit in (
        (f"{what}: frames lost / sent", lost / load.sent, 0.0),
        (f"{what}: processor time / {CORES} cores", sum(used[:-1]) / wall_s / CORES, 1.0),
        (f"{what}: latency p99 / frame interval", p99 * FRAMES_PER_S / 1e3, None),
    ):
        print(json.dumps({"name": name, "ratio": float(ratio), "limit": limit}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument(
        "--processes", type=int, default=8, help="the cameras are shared out among these"
    )
    parser.add_argument("--run", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--domain-id", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--calibration", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.run:
        run_cameras(options.run, options.domain_id, options.calibration)
    else:
        measure(options.cameras, options.seconds, options.processes)


if __name__ == "__main__":
    main()
