"""Publishes the network's lanes for the cameras that see them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path as FilePath
from typing import Any

from nav_msgs.msg import Path
from rclpy.publisher import Publisher

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.conversions import encode_path, path_headings
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.roadnet.network import load_network
from geoorbit_ros.roadnet.reference_lanes import reference_lanes
from geoorbit_ros.twin.cameras import CameraView


class ReferencePublisher:
    """Latched paths `<camera>/reference/lane_<k>/{centerline,left,right}`.

    Args:
        node: Publishes.
        network: The network's file.
        views: What the cameras see; of others nothing is published.
        frame_id: Name of the cameras' map frames.
    """

    def __init__(
        self,
        node: GeoOrbitNode[Any],
        network: str | FilePath,
        views: Mapping[str, CameraView],
        frame_id: str,
    ) -> None:
        self._node, self._network, self._views = node, network, views
        self._frame_id = frame_id
        self._publishers: dict[str, list[Publisher]] = {}

    def refer(self, camera: str, datum: Datum) -> None:
        """Publish the lanes in a camera's view, in the frame of its tracks.

        Raises:
            RoadNetworkError: No lane of the network is in view.
        """
        if (view := self._views.get(camera)) is None:
            return
        lanes = reference_lanes(load_network(self._network, datum), view.polygon_in(datum))
        for publisher in self._publishers.pop(camera, []):
            self._node.destroy_publisher(publisher)
        self._publishers[camera] = publish_lanes(self._node, camera, self._frame_id, lanes)


def publish_lanes(
    node: GeoOrbitNode[Any], camera: str, frame_id: str, lanes: Iterable[Lane]
) -> list[Publisher]:
    """Latched paths of lanes, in the node's own namespace where `camera` is empty.

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
            topic = f"{camera}/reference/lane_{lane.lane_id}/{role}".lstrip("/")
            publisher = node.create_publisher(Path, topic, LATCHED)
            publisher.publish(encode_path(0, frame_id, line, heading))
            publishers.append(publisher)
    return publishers
