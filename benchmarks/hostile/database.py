"""Attacks on what is recorded."""

from __future__ import annotations

import sqlite3
import time
from pathlib import Path

import numpy as np
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.storage.pointcloud2 import encode_table
from hostile.harness import Attacker, Finding, Victim, victims, wait

DAY_NS = 86_400 * 10**9
STREAM = QoSProfile(
    depth=1000, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE
)
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
HOSTILE = {
    "1e400": '{"geoorbit": {"stamp_ns": 1e400}}',
    "10^30": '{"geoorbit": {"stamp_ns": 1' + "0" * 30 + "}}",
    "100,000 brackets": "[" * 100_000,
}


def stored(path: Path) -> dict[str, int]:
    """Frames by camera, read without the package."""
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    try:
        return dict(
            connection.execute(
                "SELECT name, coalesce(sum(frames), 0) FROM camera LEFT JOIN track_batch"
                " ON track_batch.camera = camera.id GROUP BY camera.id"
            )
        )
    except sqlite3.Error:
        return {}
    finally:
        connection.close()


def send_frames(publisher: object, start_ns: int, count: int) -> None:
    rows = np.zeros(2, TRACK_DTYPE)
    for k in range(count):
        publisher.publish(encode_table(start_ns + k * 33_000_000, "map", rows))  # type: ignore[attr-defined]
        time.sleep(0.001)


def stamps_of_the_future(folder: Path) -> Finding:
    """Rows 1 and 2: two cameras in one file, one gets two frames of the future, then restarts."""
    path, now_ns = folder / "t.db", time.time_ns()
    given = {
        "database": path,
        "retention_days": 30.0,
        "reliability": "reliable",
        "queue_depth": 0,
    }
    good = 0
    with victims() as make:
        attacker = Attacker()
        recorders = [make("recorder", folder, f"/{name}", **given) for name in ("north", "south")]
        for name in ("north", "south"):
            publisher = attacker.publisher(PointCloud2, f"/{name}/tracks", STREAM)
            send_frames(publisher, now_ns, 300)
            good += 300
        wait(lambda: sum(stored(path).values()) == 600, attacker)
        north = attacker.publisher(PointCloud2, "/north/tracks", STREAM)
        for days in (400, 3650):
            send_frames(north, now_ns + days * DAY_NS, 1)
        send_frames(north, now_ns + 300 * 33_000_000, 150)
        wait(lambda: stored(path).get("north", 0) >= 450, attacker, 8.0)
        recorders[0].end()
        wait(lambda: north.get_subscription_count() == 0, attacker)
        make("recorder", folder, "/north", **given)
        north = attacker.publisher(PointCloud2, "/north/tracks", STREAM)
        send_frames(north, now_ns + 450 * 33_000_000, 150)
        good += 300
        wait(lambda: stored(path).get("north", 0) >= 600, attacker, 8.0)
        attacker.close()
    found = stored(path)
    lost = good - min(found.get("north", 0), 600) - min(found.get("south", 0), 300)
    return Finding("1, 2: stamps of the future", lost / good, f"{lost} of {good} frames lost")


def destructive_parameter(folder: Path) -> Finding:
    """Row 3: anybody shortens what is kept."""
    with victims() as make:
        make("recorder", folder, "/north", database=folder / "t.db", retention_days=0.0)
        attacker = Attacker()
        client = attacker.node.create_client(SetParameters, "/north/recorder/set_parameters")
        wait(client.service_is_ready, attacker)
        wanted = Parameter("retention_days", value=1e-5).to_parameter_msg()
        future = client.call_async(SetParameters.Request(parameters=[wanted]))
        wait(future.done, attacker)
        taken = future.result().results[0].successful
        attacker.close()
    return Finding("3: retention set by anybody", float(taken), "accepted" if taken else "refused")


def password(folder: Path) -> Finding:
    """Row 3: anybody asks for the camera's address."""
    secret = "hunter2"
    with victims() as make:
        source = f"rtsp://me:{secret}@127.0.0.1:9/live"
        make("camera", folder, "/north", source=source)
        attacker = Attacker()
        client = attacker.node.create_client(GetParameters, "/north/camera/get_parameters")
        wait(client.service_is_ready, attacker)
        future = client.call_async(GetParameters.Request(names=["source"]))
        wait(future.done, attacker)
        seen = secret in future.result().values[0].string_value
        attacker.close()
    told = "readable" if seen else "not readable"
    return Finding("3: password by get_parameters", float(seen), told)


def hostile_maps(folder: Path) -> Finding:
    """Row 8: latched texts that end the reader, and end it again after each restart."""
    died = []
    for number, (name, text) in enumerate(HOSTILE.items()):
        with victims() as make:
            attacker = Attacker()
            latched = attacker.node.create_publisher(String, "/north/lanes/geojson", LATCHED)
            latched.publish(String(data=text))
            recorder: Victim = make("recorder", folder, "/north", database=folder / f"{number}.db")
            wait(lambda r=recorder: not r.alive or "refused" in r.text, attacker, 15.0)  # type: ignore[misc]
            died += [name] if not recorder.alive else []
            attacker.close()
    what = f"dead after: {', '.join(died)}" if died else "all refused"
    return Finding("8: hostile lane maps", len(died) / len(HOSTILE), what)


def two_recorders(folder: Path) -> Finding:
    """Row 18: two recorders of one camera on one file, the second by another name of the file."""
    path, link = folder / "t.db", folder / "same.db"
    with victims() as make:
        attacker = Attacker()
        make("recorder", folder, "/north", database=path, reliability="reliable")
        publisher = attacker.publisher(PointCloud2, "/north/tracks", STREAM)
        link.symlink_to(path)
        second = make(
            "recorder", folder, "/second", database=link, camera_id="north", reliability="reliable"
        )
        wait(lambda: not second.alive, attacker, 6.0)
        other = attacker.node.create_publisher(PointCloud2, "/second/tracks", STREAM)
        if second.alive:
            wait(lambda: other.get_subscription_count() > 0, attacker)
        now_ns, rows = time.time_ns(), np.zeros(2, TRACK_DTYPE)
        for k in range(300):
            for one in (publisher, other):
                one.publish(encode_table(now_ns + k * 33_000_000, "map", rows))
            time.sleep(0.001)
        wait(lambda: stored(path).get("north", 0) >= 300, attacker, 5.0)
        wait(lambda: False, attacker, 1.5)
        attacker.close()
    found = stored(path).get("north", 0)
    return Finding("18: two recorders", (found - 300) / 300, f"{found} frames of 300")


ATTACKS = (stamps_of_the_future, destructive_parameter, password, hostile_maps, two_recorders)
