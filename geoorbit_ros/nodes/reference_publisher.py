"""Publishes the network's lanes for one camera."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from nav_msgs.msg import Path
from rclpy.publisher import Publisher

from geoorbit_ros.conversions import encode_path, path_headings
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.nodes.base import GeoOrbitNode
from geoorbit_ros.nodes.latched import LATCHED


def publish_references(
    node: GeoOrbitNode[Any], camera: str, frame_id: str, lanes: Iterable[Lane]
) -> list[Publisher]:
    """Latched paths `<camera>/reference/lane_<k>/{centerline,left,right}`.

    Their stamp is zero: a map has no capture time.
    """
    publishers = []
    for lane in lanes:
        heading = path_headings(lane.centerline_m)
        for role, line in (
            ("centerline", lane.centerline_m),
            ("left", lane.left_m),
            ("right", lane.right_m),
        ):
            topic = f"{camera}/reference/lane_{lane.lane_id}/{role}"
            publisher = node.create_publisher(Path, topic, LATCHED)
            publisher.publish(encode_path(0, frame_id, line, heading))
            publishers.append(publisher)
    return publishers
