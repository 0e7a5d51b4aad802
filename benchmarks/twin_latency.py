"""How long a frame of tracks takes through the node `sumo_bridge`: 100 vehicles at 10 Hz.

The node runs in a process of its own, as `geoorbit up` starts it. This process publishes
`<camera>/tracks` at 10 Hz and times each frame until `twin/vehicles` of the same stamp is here:
both ways over ROS are in the figure.

    python benchmarks/twin_latency.py [--seconds 60] [--vehicles 100]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseArray
from rclpy.node import Node
from sensor_msgs.msg import NavSatFix, PointCloud2

from geoorbit_ros.conversions import datum_to_fix
from geoorbit_ros.fleet.plan import NodePlan, ProcessPlan
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED, stream_qos
from geoorbit_ros.roadnet.network import load_network
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.storage.pointcloud2 import encode_table
from live_camera import start
from twin import DATUM, STEP_S, MadeTraffic, made_roads

LATENCY_S = 0.02
WARM_UP_FRAMES = 30
START_LIMIT_S, LIMIT_S = 60.0, 10.0


def stamp_of(cdr: bytes) -> int:
    """Stamp of a serialised message that begins with a header."""
    seconds, nanoseconds = np.frombuffer(cdr, "<u4", 2, 4).tolist()
    return int(seconds) * 10**9 + int(nanoseconds)


def measure(net: Path, folder: Path, vehicles: int, seconds: float) -> list[float]:
    """Latency of each frame after the warm-up, in seconds."""
    traffic = MadeTraffic(load_network(net, DATUM), vehicles)
    frames = WARM_UP_FRAMES + round(seconds / STEP_S)
    sent: dict[int, float] = {}
    took: dict[int, float] = {}
    with Composition(quiet=True) as nodes:
        node = nodes.add(Node("clock", context=nodes.context))
        qos = stream_qos("best_effort", 300)

        def arrived(cdr: bytes) -> None:
            stamp_ns = stamp_of(cdr)
            took[stamp_ns] = time.perf_counter() - sent.get(stamp_ns, time.perf_counter())

        node.create_subscription(PoseArray, "/twin/vehicles", arrived, qos, raw=True)
        tracks = node.create_publisher(PointCloud2, "/c/tracks", qos)
        fix = node.create_publisher(NavSatFix, "/c/datum", LATCHED)
        fix.publish(datum_to_fix(DATUM, "map"))
        plan = NodePlan("sumo_bridge", "", {"network": str(net), "cameras": "c"})
        child, heartbeat = start(ProcessPlan("twin", (plan,)), folder, nodes.domain_id)
        try:
            nodes.wait(
                lambda: min(tracks.get_subscription_count(), fix.get_subscription_count()) > 0,
                START_LIMIT_S,
                "the bridge",
            )
            begin_s = time.perf_counter()
            nodes.wait(lambda: time.perf_counter() > begin_s + 2.0, LIMIT_S, "its readers")
            begin_s = time.perf_counter()
            for k in range(frames):
                rows = traffic.rows(k * STEP_S)
                due_s = begin_s + k * STEP_S
                while (wait_s := due_s - time.perf_counter()) > 0:
                    nodes.spin(wait_s)
                stamp_ns = 10**9 + round(k * STEP_S * 1e9)
                sent[stamp_ns] = time.perf_counter()
                tracks.publish(encode_table(stamp_ns, "map", rows))
            nodes.wait(lambda: len(took) >= frames, LIMIT_S, "the last steps", lambda: len(took))
        finally:
            child.terminate()
            child.wait(20)
            os.close(heartbeat)
    kept = list(sent)[WARM_UP_FRAMES:]
    return [took[stamp_ns] for stamp_ns in kept]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--vehicles", type=int, default=100)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        net = write_network(made_roads(), Path(name), DATUM)
        took_s = measure(net, Path(name), options.vehicles, options.seconds)
    p50_s, p99_s = np.quantile(took_s, [0.5, 0.99])
    title = f"{options.vehicles} vehicles at 10 Hz through the node, 99 % of the latencies / 20 ms"
    print(json.dumps({"name": title, "ratio": round(p99_s / LATENCY_S, 4), "limit": 1.0}))
    print(
        f"{title}: {len(took_s)} frames, half within {1e3 * p50_s:.1f} ms, 99 % within "
        f"{1e3 * p99_s:.1f} ms, the slowest {1e3 * max(took_s):.1f} ms",
        file=sys.stderr,
    )


if __name__ == "__main__":
    main()
