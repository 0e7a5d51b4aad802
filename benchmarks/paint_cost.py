"""What painted lines cost a running graph: processor time as a share of one core.

The nodes detector, homography and lane_geometry run with their default parameters on six minutes
of a scene: its images, 1920x1080, every two seconds (which is what the road's background takes),
and its tracks ten times a second. In the last five minutes there is one new image of the road. The
thread's processor time in the nodes' two paint classes, transport and PNG included, is compared
with those five minutes; so the run may be as fast as the machine is, or other work go on beside.

    python benchmarks/paint_cost.py [--scene straight_3x3]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import defaultdict
from functools import wraps
from itertools import islice
from pathlib import Path
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, PointCloud2

from geoorbit_ros.calibration.control_point_writer import write_control_points
from geoorbit_ros.conversions import encode_jpeg
from geoorbit_ros.nodes.detector import DetectorNode
from geoorbit_ros.nodes.homography import HomographyNode
from geoorbit_ros.nodes.lane_geometry import LaneGeometryNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import stream_qos
from geoorbit_ros.nodes.support.road_paint import PaintListener, RoadImagePublisher
from geoorbit_ros.rendering.rendered_scene import render_scene
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import simulate
from geoorbit_ros.storage.pointcloud2 import encode_table

SIZE, FPS, TRACKS_HZ, SEED = (1920, 1080), 1.0, 10.0, 1
WARM_UP_S, MEASURED_S = 60.0, 300.0
CAMERA, LIMIT_S = "north", 300.0
LIMIT_SHARE = 0.02
LOSSLESS = {"reliability": "reliable", "queue_depth": 0}

SPENT: dict[str, list[float]] = defaultdict(list)
"""Processor seconds of every call, by what it does."""


def timed(owner: type, method: str, what: str) -> None:
    """Note the processor time of a method's calls under a name."""
    call = getattr(owner, method)

    @wraps(call)
    def wrapped(self: Any, *arguments: Any, **named: Any) -> Any:
        begin = time.thread_time()
        result = call(self, *arguments, **named)
        SPENT[what].append(time.thread_time() - begin)
        return result

    setattr(owner, method, wrapped)


def play(nodes: Composition, scene_name: str, calibration: Path) -> None:
    """Send the scene through the nodes, as fast as they take it."""
    scene = load_scene(scene_name)
    duration_s = WARM_UP_S + MEASURED_S
    run = simulate(scene, duration_s, SEED)
    write_control_points(calibration, run.control_points)
    width, height = run.image_size
    size = {"image_width": width, "image_height": height}
    lanes = nodes.make(LaneGeometryNode, CAMERA, LOSSLESS)
    given = LOSSLESS | size | {"calibration_file": str(calibration)}
    homography = nodes.make(HomographyNode, CAMERA, given)
    detector = nodes.make(DetectorNode, CAMERA, LOSSLESS)
    sender = nodes.add(Node("sender", context=nodes.context, namespace=CAMERA))
    qos = stream_qos("reliable", 0)
    images = sender.create_publisher(CompressedImage, "image/compressed", qos)
    tracks = sender.create_publisher(PointCloud2, "tracks_px", qos)
    nodes.wait(
        lambda: (
            images.get_subscription_count() > 0
            and tracks.get_subscription_count() > 0
            and homography.tracks.get_subscription_count() > 0
        ),
        LIMIT_S,
        "the nodes to see each other",
    )
    stride = round(scene.camera.fps / TRACKS_HZ)
    sent = 0
    rendered = render_scene(scene, duration_s, SEED, fps=FPS, image_size=SIZE)
    warm_ns = int(run.frames.stamp_ns[0] + WARM_UP_S * 1e9)
    every_second = islice(rendered, 0, None, 2)
    for count, frame in enumerate(every_second, 1):
        images.publish(encode_jpeg(frame.stamp_ns, CAMERA, frame.image, 90))
        while stride * sent < len(run.frames):
            if run.frames.stamp_ns[stride * sent] > frame.stamp_ns:
                break
            stamp_ns = int(run.frames.stamp_ns[stride * sent])
            tracks.publish(encode_table(stamp_ns, CAMERA, run.frames.frame(stride * sent)))
            sent += 1
        wanted = sent
        nodes.wait(
            lambda wanted=wanted, count=count: (  # type: ignore[misc]
                lanes.frames >= wanted and detector.diagnostics.published >= count
            ),
            LIMIT_S,
            "the tracks",
        )
        if frame.stamp_ns < warm_ns:
            SPENT.clear()
    nodes.wait(lambda: lanes.paint.images >= 2, LIMIT_S, "the images of the road")
    print(f"{lanes.paint.sentence}; {lanes.lane_maps} maps", file=sys.stderr)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="straight_3x3")
    given = parser.parse_args()
    timed(RoadImagePublisher, "add", "taking an image")
    timed(RoadImagePublisher, "_publish", "median, PNG, publishing")
    timed(PaintListener, "_on_image", "receiving")
    timed(PaintListener, "follow", "lane maps")
    with tempfile.TemporaryDirectory() as scratch, Composition(quiet=True) as nodes:
        play(nodes, given.scene, Path(scratch) / "calibration.csv")
    total = 0.0
    for what, seconds in SPENT.items():
        total += sum(seconds)
        print(f"{what}: {len(seconds)} times, {sum(seconds):.2f} s in all, {max(seconds):.2f} s at "
              "most", file=sys.stderr)  # fmt: skip
    share = total / MEASURED_S
    print(f"{total:.2f} s of {MEASURED_S:g} s: {share:.2%} of a core", file=sys.stderr)
    name = f"paint in the live graph / one core, {given.scene}"
    print(json.dumps({"name": name, "ratio": round(share, 4), "limit": LIMIT_SHARE}))


if __name__ == "__main__":
    main()
