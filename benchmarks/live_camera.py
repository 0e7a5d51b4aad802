"""One network camera, 720p at 25 frames a second, through all its nodes: latency and losses.

A rendered minute of traffic is served as MJPEG over HTTP on this machine, each image at its time.
The nodes camera, detector, tracker, homography and lane_geometry run in one process, as `geoorbit
up` starts them (or in one each). This process times every image from the moment it is sent until
its `tracks` arrive.

    python benchmarks/live_camera.py [--seconds 60] [--separate] [--video FOLDER]
"""

from __future__ import annotations

import argparse
import bisect
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.fleet.plan import NodePlan, ProcessPlan
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.diagnostics import StatusListener
from geoorbit_ros.nodes.support.qos import stream_qos
from geoorbit_ros.rendering.output import write_rendered_scene
from geoorbit_ros.rendering.rendered_scene import render_scene
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.storage.frames.open_source import open_frame_source
from geoorbit_ros.storage.pointcloud2 import decode_table

SCENE, FPS, SIZE, CORES = "straight_3x3", 25.0, (1280, 720), 2
RENDERED_S = 60.0
WARM_UP_S = 20.0  # imports, first serialisation, the road without vehicles, lane updates
LATENCY_P99_MS = 150.0
START_LIMIT_S = 120.0
CAMERA = "live"


def jpeg_images(folder: Path) -> list[bytes]:
    """The scene as JPEG images; filmed into the folder unless it is there already."""
    if not folder.exists():
        rendered = render_scene(load_scene(SCENE), RENDERED_S, 1, fps=FPS, image_size=SIZE)
        print(f"filming {RENDERED_S:g} s of {SCENE}", file=sys.stderr)
        write_rendered_scene(rendered, folder)
    quality = (cv2.IMWRITE_JPEG_QUALITY, 90)
    with open_frame_source(str(folder / "video.mp4")) as video:
        return [cv2.imencode(".jpg", image, quality)[1].tobytes() for _, image in video]


class NetworkCamera:
    """Serves images over HTTP, each at its time, over and over.

    Attributes:
        sent_ns: Time at which each image began to be sent.
        late_s: Longest delay of a image, because the reader did not take the ones before.
    """

    def __init__(self, images: list[bytes]) -> None:
        self.sent_ns: list[int] = []
        self.late_s = 0.0
        self._images, self._closed = images, threading.Event()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                outer.send(self)

            def log_message(self, *_: object) -> None:
                """Stay silent."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self._server.server_port}/stream"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def send(self, client: BaseHTTPRequestHandler) -> None:
        """Send images to one client until it or the server goes."""
        start_s = time.monotonic()
        for k in range(10**9):
            wait_s = start_s + k / FPS - time.monotonic()
            if self._closed.wait(max(wait_s, 0.0)):
                return
            self.late_s = max(self.late_s, -wait_s) if k else 0.0
            jpeg = self._images[k % len(self._images)]
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            self.sent_ns.append(time.time_ns())
            try:
                client.wfile.write(head.encode() + jpeg + b"\r\n")
            except OSError:
                return  # the reader has gone

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._closed.set()
        self._server.shutdown()
        self._server.server_close()


class Watch:
    """Times the tracks of every image."""

    def __init__(self, nodes: Composition, camera: NetworkCamera) -> None:
        self._camera = camera
        self.arrived: list[tuple[int, float]] = []  # index of the image, latency in ms
        self.vehicles = 0
        self.status = nodes.add(StatusListener(nodes.context))
        self.node = nodes.add(Node("watch", context=nodes.context))
        qos = stream_qos("best_effort", 300)
        self.node.create_subscription(
            PointCloud2, f"/{CAMERA}/tracks", self._on_tracks, qos, raw=True
        )

    def _on_tracks(self, cdr: bytes) -> None:
        now_ns = time.time_ns()
        stamp_ns, _, rows = decode_table(cdr, TRACK_DTYPE, "tracks")
        k = bisect.bisect_right(self._camera.sent_ns, stamp_ns) - 1
        self.arrived.append((k, (now_ns - self._camera.sent_ns[k]) / 1e6))
        self.vehicles += len(rows)

    def values(self, node: str) -> dict[str, str]:
        """Last diagnostic values of a node."""
        reports = {r.name: dict(r.values) for r in self.status.reports()}
        return reports.get(f"/{CAMERA}/{node}", {})


def plans(camera: NetworkCamera, calibration: Path, *, separate: bool) -> list[ProcessPlan]:
    """One process with all nodes, readers first; or one each."""
    width, height = SIZE
    size: dict[str, int] = {"image_width": width, "image_height": height}
    nodes = (
        NodePlan("lane_geometry", CAMERA),
        NodePlan("homography", CAMERA, {"calibration_file": str(calibration), **size}),
        NodePlan("tracker", CAMERA, size),
        NodePlan("detector", CAMERA),
        NodePlan("camera", CAMERA, {"source": camera.address}),
    )
    if separate:
        return [ProcessPlan(node.executable, (node,)) for node in nodes]
    return [ProcessPlan(CAMERA, nodes)]


def start(plan: ProcessPlan, folder: Path, domain_id: int) -> tuple[subprocess.Popen[bytes], int]:
    """The process of a plan, and the reading end of its heartbeat."""
    file = folder / f"{plan.name}.json"
    file.write_text(plan.to_json())
    reading, writing = os.pipe()
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    command = [
        sys.executable,
        "-m",
        "geoorbit_ros.nodes.support.fleet_process",
        str(file),
        str(writing),
    ]
    process = subprocess.Popen(command, pass_fds=[writing], env=environment)
    os.close(writing)
    return process, reading


def cpu_s(pid: int) -> float:
    """Processor time of a process so far: proc(5), fields utime and stime."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(seconds: float, folder: Path, *, separate: bool) -> None:
    """Run the graph and print the ratios as JSON, the rest on standard error."""
    images = jpeg_images(folder)
    with (
        tempfile.TemporaryDirectory() as scratch,
        NetworkCamera(images) as camera,
        Composition(quiet=True) as nodes,
    ):
        watch = Watch(nodes, camera)
        chosen = plans(camera, folder / "calibration.csv", separate=separate)
        children = [start(plan, Path(scratch), nodes.domain_id) for plan in chosen]
        try:
            nodes.wait(lambda: len(watch.arrived) > 0, START_LIMIT_S, "tracks")
            begin = time.monotonic()
            nodes.wait(lambda: time.monotonic() > begin + WARM_UP_S, 2 * WARM_UP_S, "warm-up")
            pids = [child.pid for child, _ in children]
            before = [cpu_s(pid) for pid in pids]
            first, begin = len(camera.sent_ns), time.monotonic()
            watch.vehicles = 0
            nodes.wait(lambda: time.monotonic() > begin + seconds, 2 * seconds, "the measurement")
            last, wall_s = len(camera.sent_ns), time.monotonic() - begin
            used = [cpu_s(pid) - b for pid, b in zip(pids, before, strict=True)]
            nodes.wait(lambda: watch.arrived[-1][0] >= last, 10.0, "the last tracks")
            said = {name: watch.values(name) for name in ("camera", "detector", "lane_geometry")}
        finally:
            for child, reading in children:
                child.terminate()
                child.wait(20)
                os.close(reading)
    kept = [(k, ms) for k, ms in watch.arrived if first <= k < last]
    report(kept, first, last, wall_s, used, separate=separate)
    print(
        f"camera captured {said['camera'].get('captured')}, dropped "
        f"{said['camera'].get('dropped')}, reconnects {said['camera'].get('reconnects')}; detector "
        f"{said['detector'].get('latency_ms_median')} ms median; lanes confirmed "
        f"{said['lane_geometry'].get('lanes_confirmed')}; {watch.vehicles / max(len(kept), 1):.1f} "
        f"vehicles a image; the network camera was late by {1e3 * camera.late_s:.0f} ms at most",
        file=sys.stderr,
    )


def report(
    kept: list[tuple[int, float]],
    first: int,
    last: int,
    wall_s: float,
    used: list[float],
    *,
    separate: bool,
) -> None:
    """Ratios as JSON lines, and all figures in a sentence."""
    sent, index = last - first, np.array([k for k, _ in kept])
    latency_ms = np.array([ms for _, ms in kept])
    lost = sent - len(np.unique(index))
    median, p99 = np.quantile(latency_ms, [0.5, 0.99])
    third = sent // 3
    early = np.median(latency_ms[index < first + third])
    late = np.median(latency_ms[index >= last - third])
    layout = "one process per node" if separate else "one process"
    what = f"720p at {FPS:g} fps, {layout}"
    print(
        f"{what}: {sent} images in {wall_s:.1f} s, {lost} without tracks; image to tracks "
        f"{median:.1f} ms median, {p99:.1f} ms p99, {latency_ms.max():.0f} ms at most; median of "
        f"the first third {early:.1f} ms, of the last {late:.1f} ms; processor "
        f"{sum(used) / wall_s:.2f} cores",
        file=sys.stderr,
    )
    for name, ratio, limit in (
        (f"{what}: images without tracks / sent", lost / sent, 0.0),
        (f"{what}: latency p99 / {LATENCY_P99_MS:g} ms", p99 / LATENCY_P99_MS, 1.0),
        (f"{what}: latency of the last third / of the first", late / early, 1.5),
        (f"{what}: processor time / {CORES} cores", sum(used) / wall_s / CORES, 1.0),
    ):
        print(json.dumps({"name": name, "ratio": round(float(ratio), 4), "limit": limit}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--separate", action="store_true", help="one process per node")
    parser.add_argument("--video", type=Path, help="keep the filmed scene in this folder")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.video or Path(scratch) / SCENE
        measure(options.seconds, folder, separate=options.separate)


if __name__ == "__main__":
    main()
