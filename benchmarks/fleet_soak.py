"""A fleet for minutes on end: nothing piles up, memory stays flat, how late the tracks are.

`rendered`: four cameras along one road, pictures drawn beforehand and played as videos, with
detector, tracker, homography, lane map, recorder and meta_client each, a federated server and the
SUMO twin of the road. `tracks`: eight cameras from recorded boxes, with homography, lane map and
recorder each.

Memory is the sum over all processes of the fleet; its slope is fitted after the warm-up, with the
error of the fit. A camera's latency is from the stamp of a frame to the arrival of its `tracks`
here, less that of the fastest frame: a recording's first stamp is set when it is opened, not when
it begins.

    python benchmarks/fleet_soak.py [--kind rendered] [--kind tracks] [--minutes 10]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from geoorbit_ros.fleet.health import NodeReport, rows
from geoorbit_ros.nodes.composition import Composition
from geoorbit_ros.nodes.status_listener import StatusListener
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.output import write_scene_run
from geoorbit_ros.scenes.render.conditions import Conditions
from geoorbit_ros.scenes.render.output import write_rendered_scene
from geoorbit_ros.scenes.render.rendered_scene import render_scene
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import Scene, load_scene, shipped_scenes
from geoorbit_ros.scenes.simulate import simulate

CAMERAS, SPACING_M, ROAD_M = 4, 250.0, 1200.0
SIZE, FPS, RECORDED_S = (640, 360), 10.0, 60.0
TRACK_CAMERAS = 8
SAMPLE_S = 5.0
WARM_UP_SHARE = 0.3
START_LIMIT_S = 120.0
LATENCY_LIMIT_MS = 150.0
REPOSITORY = Path(__file__).parents[1]


def long_road() -> Scene:
    """The straight motorway, long enough for four cameras."""
    scene = load_scene("straight_3x3")
    piece = scene.roads[0].path[0].model_copy(update={"straight_m": ROAD_M})
    road = scene.roads[0].model_copy(update={"path": [piece]})
    return scene.model_copy(update={"roads": [road, *scene.roads[1:]]})


def beside(scene: Scene, along_m: float) -> Scene:
    """The scene with its camera that far down the road."""
    pole = scene.camera.pole.model_copy(update={"along_m": along_m})
    ahead_m = scene.camera.look_at.along_m - scene.camera.pole.along_m
    look_at = scene.camera.look_at.model_copy(update={"along_m": along_m + ahead_m})
    camera = scene.camera.model_copy(update={"pole": pole, "look_at": look_at})
    return scene.model_copy(update={"camera": camera})


def rendered_fleet(folder: Path) -> dict[str, object]:
    """Videos, calibrations and network in a folder; the fleet file's content."""
    scene = long_road()
    cameras = []
    for k in range(CAMERAS):
        print(f"drawing camera {k + 1} of {CAMERAS}", file=sys.stderr)
        view = beside(scene, 150.0 + SPACING_M * k)
        shown = render_scene(view, RECORDED_S, 1, Conditions(), fps=FPS, image_size=SIZE)
        files = write_rendered_scene(shown, folder / f"camera_{k}")
        cameras.append(
            {
                "id": f"camera_{k}",
                "source": str(files.video),
                "calibration": str(files.calibration),
                "datum": {
                    "latitude_deg": shown.datum.latitude_deg,
                    "longitude_deg": shown.datum.longitude_deg,
                },
            }
        )
        datum = shown.datum
    (folder / "net").mkdir()
    network = write_network(place_roads(scene), folder / "net", datum)
    return {
        "cameras": cameras,
        "federated_server": {},
        "twin": {"network": str(network)},
        "recorder": {},
    }


def tracks_fleet(folder: Path) -> dict[str, object]:
    """Bags and calibrations in a folder; the fleet file's content."""
    cameras = []
    for k, name in enumerate(shipped_scenes()[:TRACK_CAMERAS]):
        print(f"recording camera {k + 1} of {TRACK_CAMERAS}: {name}", file=sys.stderr)
        run = simulate(load_scene(name), RECORDED_S, 1)
        files = write_scene_run(run, folder / name, name)
        camera = {"id": name, "source": f"bag:{files.bag}", "calibration": str(files.calibration)}
        cameras.append({**camera, "image_size": list(run.image_size)})
    return {"cameras": cameras, "recorder": {}}


class Watch:
    """What the fleet says and costs while it runs."""

    def __init__(self, nodes: Composition, cameras: list[str], log: Path) -> None:
        self.listener = nodes.add(StatusListener(nodes.context))
        self._node = nodes.add(Node("soak", context=nodes.context))
        self._log = log
        self.latency_s: dict[str, list[float]] = {camera: [] for camera in cameras}
        qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
        for camera in cameras:
            take = partial(self._take, camera)
            self._node.create_subscription(PointCloud2, f"/{camera}/tracks", take, qos, raw=True)

    def _take(self, camera: str, cdr: bytes) -> None:
        sec, nanosec = np.frombuffer(cdr, "<u4", 2, 4).tolist()
        self.latency_s[camera].append(time.time() - sec - 1e-9 * nanosec)

    def memory_mb(self) -> float:
        """Resident memory of all processes of the fleet, their children included."""
        started = dict(re.findall(r"(\w+)  started, process (\d+)", self._log.read_text()))
        pages = sum(resident_pages(pid) for root in started.values() for pid in family(int(root)))
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20

    def lost(self) -> tuple[float, list[str]]:
        """Frames dropped, missing or refused so far, and what is not healthy."""
        cameras, services = rows(self.listener.reports())
        found = sum(float(row.values.get("lost", 0)) for row in cameras)
        return found, [f"{row.name}: {p}" for row in [*cameras, *services] for p in row.problems]

    def reports(self) -> list[NodeReport]:
        """Of all nodes."""
        return self.listener.reports()


def family(pid: int) -> Iterator[int]:
    """A process and its children."""
    yield pid
    children = Path(f"/proc/{pid}/task/{pid}/children")
    if children.exists():
        for child in children.read_text().split():
            yield from family(int(child))


def resident_pages(pid: int) -> int:
    """0 for a process that has just ended."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except FileNotFoundError:
        return 0


def slope(minute: np.ndarray, value: np.ndarray) -> tuple[float, float]:
    """Least-squares slope and its 1-sigma error."""
    (gain, _), covariance = np.polyfit(minute, value, 1, cov=True)
    return float(gain), float(np.sqrt(covariance[0, 0]))


def run(kind: str, minutes: float) -> None:
    """Run one fleet and print its ratios."""
    with tempfile.TemporaryDirectory() as name, Composition(quiet=True) as nodes:
        folder = Path(name)
        content = {"rendered": rendered_fleet, "tracks": tracks_fleet}[kind](folder)
        fleet = folder / "fleet.yaml"
        content = {"name": kind, "domain_id": nodes.domain_id, **content}
        fleet.write_text(yaml.safe_dump(content, sort_keys=False))
        log = folder / "up.log"
        words = [sys.executable, "-m", "geoorbit_ros.cli.main", "up", str(fleet)]
        with log.open("wb") as stream:
            process = subprocess.Popen(
                [*words, "--out", str(folder / "out")], stdout=stream, stderr=stream
            )
        cameras = [str(camera["id"]) for camera in content["cameras"]]  # type: ignore[attr-defined]
        watch = Watch(nodes, cameras, log)
        try:
            nodes.wait(
                lambda: "processes run" in log.read_text() or process.poll() is not None,
                START_LIMIT_S,
                "a fleet that runs",
            )
            measure(watch, nodes, kind, minutes)
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(30.0)
            print(log.read_text()[-3000:], file=sys.stderr)


def measure(watch: Watch, nodes: Composition, kind: str, minutes: float) -> None:
    """Watch for so many minutes, then print."""
    began = due = time.monotonic()
    samples: list[tuple[float, float]] = []
    first_lost: float | None = None
    taken: dict[str, int] = {}
    warm_s = 60.0 * minutes * WARM_UP_SHARE
    while (elapsed := time.monotonic() - began) < 60.0 * minutes:
        nodes.spin()
        if elapsed > warm_s and first_lost is None:
            first_lost = watch.lost()[0]
            taken = {camera: len(values) for camera, values in watch.latency_s.items()}
        if time.monotonic() >= due:
            due += SAMPLE_S
            samples.append((elapsed / 60.0, watch.memory_mb()))
    lost, problems = watch.lost()
    late = [np.array(v[taken.get(c, 0) :]) for c, v in watch.latency_s.items()]
    frames = sum(len(v) for v in late)
    p99_ms = max(1e3 * float(np.quantile(v - v.min(), 0.99)) for v in late)
    drift_ms = max(
        1e3 * float(np.median(v[-len(v) // 4 :]) - np.median(v[: len(v) // 4])) for v in late
    )
    minute, memory = np.array([s for s in samples if s[0] * 60.0 > warm_s]).T
    gain, error = slope(minute, memory)
    print(
        f"{kind}: {frames} frames in {minutes * (1 - WARM_UP_SHARE):.1f} min, "
        f"{lost - (first_lost or 0):g} lost, p99 latency {p99_ms:.0f} ms, "
        f"drift {drift_ms:+.0f} ms, "
        f"memory {memory[0]:.0f} to {memory[-1]:.0f} MB, slope {gain:+.2f} ± {error:.2f} MB/min; "
        f"not healthy: {'; '.join(problems) or 'nothing'}",
        file=sys.stderr,
    )
    name = f"fleet of {'4 rendered' if kind == 'rendered' else '8 trajectory'} cameras"
    growth = gain * minutes * (1 - WARM_UP_SHARE) / float(memory.mean())
    for what, ratio, limit in (
        ("frames lost / frames", (lost - (first_lost or 0.0)) / max(frames, 1), 0.0),
        (f"p99 latency / {LATENCY_LIMIT_MS:g} ms", p99_ms / LATENCY_LIMIT_MS, 1.0),
        ("memory at the end / after the warm-up", 1.0 + growth, 1.05),
    ):
        print(json.dumps({"name": f"{name}, {what}", "ratio": ratio, "limit": limit}), flush=True)


def main() -> int:
    """Run the fleets that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", action="append", choices=("rendered", "tracks"))
    parser.add_argument("--minutes", type=float, default=10.0)
    options = parser.parse_args()
    for kind in options.kind or ("rendered", "tracks"):
        run(kind, options.minutes)
    return 0


if __name__ == "__main__":
    sys.exit(main())
