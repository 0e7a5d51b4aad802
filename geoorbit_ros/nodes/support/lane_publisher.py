"""A lane map as standard messages on the topics below `lanes`."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseArray
from nav_msgs.msg import Path
from rclpy.publisher import Publisher
from std_msgs.msg import Bool, String
from visualization_msgs.msg import MarkerArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.conversions import (
    encode_path,
    encode_pose_array,
    encode_string,
    lane_markers,
    lane_poses,
    path_headings,
)
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.lanes.geojson import dumps_lanes
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import LATCHED


class LanePublisher:
    """Topics `lanes`, `lanes/lane_<k>/{centerline,left,right}`, `lanes/markers`, `lanes/geojson`.

    `lanes/held` says whether they are those of an earlier time. All are latched. `lanes` has one
    pose per lane that has paths: confirmed lanes, and the tentative ones too if asked for. Markers
    and GeoJSON always have both and tell them apart.

    Args:
        node: Publishes; its namespace is the camera's name in the GeoJSON.
        frame_id: Frame of the map.
        estimator: Name for the GeoJSON.
        tentative: Whether tentative lanes get a pose and paths.
    """

    def __init__(
        self,
        node: GeoOrbitNode[Any],
        frame_id: str,
        estimator: str,
        *,
        tentative: bool,
    ) -> None:
        self._node, self._frame_id = node, frame_id
        self._estimator, self._tentative = estimator, tentative
        self._poses = node.create_publisher(PoseArray, "lanes", LATCHED)
        self._markers = node.create_publisher(MarkerArray, "lanes/markers", LATCHED)
        self._geojson = node.create_publisher(String, "lanes/geojson", LATCHED)
        self._held = node.create_publisher(Bool, "lanes/held", LATCHED)
        self._paths: dict[int, dict[str, Publisher]] = {}
        self._leaving: list[Publisher] = []

    def publish(self, lane_map: LaneMap, datum: Datum | None) -> None:
        """Publish a map; GeoJSON only when the datum is known."""
        stamp_ns, frame_id = lane_map.stamp_ns, self._frame_id
        lanes = lane_map.lanes if self._tentative else lane_map.confirmed
        self._retire({lane.lane_id for lane in lanes}, stamp_ns)
        for lane in lanes:
            self._publish_paths(lane, stamp_ns)
        self._held.publish(Bool(data=lane_map.held))
        self._poses.publish(encode_pose_array(stamp_ns, frame_id, *lane_poses(lanes)))
        self._markers.publish(lane_markers(lane_map, frame_id))
        if datum is None:
            topic = self._node.resolve_topic_name("datum")
            text = f"{topic}: nothing received, so lanes/geojson is not published"
            self._node.diagnostics.warn(text)
        else:
            camera_id = self._node.camera_id
            text = dumps_lanes(lane_map, datum, camera_id=camera_id, estimator=self._estimator)
            self._geojson.publish(encode_string(text))

    def _publish_paths(self, lane: Lane, stamp_ns: int) -> None:
        lines = {"centerline": lane.centerline_m, "left": lane.left_m, "right": lane.right_m}
        if lane.lane_id not in self._paths:
            self._paths[lane.lane_id] = {
                role: self._node.create_publisher(
                    Path, f"lanes/lane_{lane.lane_id}/{role}", LATCHED
                )
                for role in lines
            }
        heading = path_headings(lane.centerline_m)
        for role, line in lines.items():
            # A boundary runs along its lane: where it is short or kinked, its own points say less.
            along = heading if len(heading) == len(line) else path_headings(line)
            cdr = encode_path(stamp_ns, self._frame_id, line, along)
            self._paths[lane.lane_id][role].publish(cdr)

    def _retire(self, staying: set[int], stamp_ns: int) -> None:
        """Empty the paths of lanes that are gone; drop their topics one update later.

        At once would be too early: the empty path might not have reached its subscribers.
        """
        for publisher in self._leaving:
            self._node.destroy_publisher(publisher)
        self._leaving = []
        for lane_id in sorted(set(self._paths) - staying):
            for publisher in self._paths.pop(lane_id).values():
                publisher.publish(encode_path(stamp_ns, self._frame_id, [], []))
                self._leaving.append(publisher)
