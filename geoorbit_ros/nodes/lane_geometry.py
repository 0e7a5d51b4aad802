"""Node `lane_geometry`: vehicles on the road become a lane map that keeps itself up to date."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from sensor_msgs.msg import NavSatFix
from std_msgs.msg import String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.conversions import (
    datum_from_fix,
    encode_path,
    encode_pose_array,
    encode_string,
    lane_markers,
    lane_poses,
    movement_of,
    path_headings,
)
from geoorbit_ros.core.errors import MessageError, PluginError
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.federated.keys import Verifier, public_key
from geoorbit_ros.federated.payloads.lane_parameters import ThetaInbox
from geoorbit_ros.lanes.geojson import dumps_lanes
from geoorbit_ros.lanes.mapping.live_mapper import LiveMapper
from geoorbit_ros.lanes.mapping.map_prior import MapPrior
from geoorbit_ros.lanes.parameters import LaneParameters
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.byte_topic import subscribe_payloads
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.nodes.support.reference_listener import ReferenceListener
from geoorbit_ros.nodes.support.table_stream import TableStream


@dataclass(frozen=True, slots=True)
class LaneGeometryParameters:
    """See params/lane_geometry.yaml."""

    estimator: str
    update_period_s: float
    smoothing: float
    angle: float
    width_scale: float
    state_file: str
    publish_tentative: bool
    frame_id: str
    reliability: str
    queue_depth: int
    restart_jump_s: float
    federation: str
    lane_parameters_key: str
    map_prior: bool

    @property
    def theta(self) -> LaneParameters:
        """The part that the estimator takes."""
        return LaneParameters(self.smoothing, self.angle, self.width_scale)


class LaneGeometryNode(GeoOrbitNode[LaneGeometryParameters]):
    """Subscribes `tracks`, `datum`, `lane_parameters`; publishes the lane map on `lanes…`, latched.

    The map is renewed every `update_period_s` by the stamps of the tracks, and when the service
    `~/update` is called.
    """

    name = "lane_geometry"
    struct = LaneGeometryParameters

    def setup(self) -> None:
        """Start with an empty map."""
        p = self.p
        self.datum: Datum | None = None
        self._latest: LaneMap | None = None
        self.frames = self.lane_maps = 0
        self.theta = p.theta
        verifier = Verifier(public_key(p.lane_parameters_key), p.federation)
        self._inbox = ThetaInbox(self.camera_id, verifier)
        file = FilePath(p.state_file) if p.state_file else None
        self._mapper = LiveMapper(
            p.estimator, self.theta, p.update_period_s, file, self.diagnostics.warn
        )
        self._prior = PriorListener(self) if p.map_prior else None
        self._lanes = LanePublisher(self, p.frame_id, p.estimator, tentative=p.publish_tentative)
        TableStream(self, "tracks", TRACK_DTYPE, p, self._on_frame, self._mapper.restart)
        self.create_subscription(NavSatFix, "datum", self._on_datum, LATCHED)
        subscribe_payloads(self, "lane_parameters", LATCHED, self._on_theta)
        self.create_service(Trigger, "~/update", self._on_update)
        self.diagnostics.add_check(self._doubt)
        self.get_logger().info(f"lanes are estimated by {p.estimator}")

    def on_parameters(self, changed: LaneGeometryParameters) -> None:
        """New parameters θ hold from the next update on, until others come."""
        self.theta = self._mapper.parameters = changed.theta
        self._inbox.version = "by hand"

    def diagnostic_values(self) -> Mapping[str, object]:
        """Size and age of the map."""
        lanes = self._latest.lanes if self._latest else ()
        confirmed = sum(lane.status == "confirmed" for lane in lanes)
        return {
            "frames": self.frames,
            "lanes_confirmed": confirmed,
            "lanes_tentative": len(lanes) - confirmed,
            "map_stamp_s": self._latest.stamp_ns / 1e9 if self._latest else "",
            "predictions": self._inbox.taken,
            "parameter_version": self._inbox.version,
            **{f"theta_{name}": value for name, value in asdict(self.theta).items()},
            "datum": "known" if self.datum else "not received yet",
        }

    def _doubt(self) -> str | None:
        """Why no lane is confirmed, while the tracks' sender doubts them."""
        if not self._mapper.doubtful:
            return None
        return "no lane is confirmed: homography's diagnostics say what speaks against its inputs"

    def _on_frame(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        self.frames += 1
        lane_map = self._mapper.add(stamp_ns, rows, self.datum)
        if lane_map is not None:
            self._publish(lane_map)

    def _on_theta(self, payload: bytes) -> None:
        self.theta = self._mapper.parameters = self._inbox.take(payload, self.theta)

    def _on_datum(self, fix: NavSatFix) -> None:
        try:
            datum = datum_from_fix(fix, self.resolve_topic_name("datum"))
        except MessageError as error:
            self.diagnostics.refuse(error)
            return
        if datum != self.datum:
            self.datum = datum
            if self._latest is not None:
                self._publish(self._latest)

    def _publish(self, lane_map: LaneMap) -> None:
        self._latest = lane_map
        refined = lane_map if self._prior is None else self._prior.refine(lane_map)
        self._lanes.publish(refined, self.datum)
        self.diagnostics.published += 1
        self.lane_maps += 1

    def _on_update(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self.frames > 0
        response.message = "no frames received yet"
        if self.frames:
            try:
                lane_map = self._mapper.finish()
            except PluginError as error:
                self.diagnostics.refuse(error)
                response.success, response.message = False, str(error)
                return response
            self._publish(lane_map)
            response.message = f"{len(lane_map.lanes)} lanes from {self.frames} frames"
        return response


class LanePublisher:
    """Topics `lanes`, `lanes/lane_<k>/{centerline,left,right}`, `lanes/markers`, `lanes/geojson`.

    All are latched. `lanes` has one pose per lane that has paths: confirmed lanes, and the
    tentative ones too if asked for. Markers and GeoJSON always have both and tell them apart.

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
        self._paths: dict[int, dict[str, Publisher]] = {}
        self._leaving: list[Publisher] = []

    def publish(self, lane_map: LaneMap, datum: Datum | None) -> None:
        """Publish a map; GeoJSON only when the datum is known."""
        stamp_ns, frame_id = lane_map.stamp_ns, self._frame_id
        lanes = lane_map.lanes if self._tentative else lane_map.confirmed
        self._retire({lane.lane_id for lane in lanes}, stamp_ns)
        for lane in lanes:
            self._publish_paths(lane, stamp_ns)
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


class PriorListener:
    """Topics `reference/lane_<k>/…` and `reference/alignment` become a prior on lanes.

    There is no prior before both have come: without the alignment it isn't known how the camera's
    lanes lie on the map.

    Args:
        node: Subscribes, and is told about messages that can't be used.
    """

    def __init__(self, node: GeoOrbitNode[Any]) -> None:
        self._node = node
        self._place = node.resolve_topic_name("reference/alignment")
        self._lanes: dict[int, Lane] = {}
        self._movement: tuple[NDArray[np.float64], float] | None = None
        self.prior: MapPrior | None = None
        self._references = ReferenceListener(node, self._on_lanes)
        node.create_subscription(
            PoseWithCovarianceStamped, self._place, self._on_alignment, LATCHED
        )

    def refine(self, lane_map: LaneMap) -> LaneMap:
        """The map with its prior, as it is where there is none."""
        return lane_map if self.prior is None else self.prior.refine(lane_map)

    def _on_lanes(self, lanes: dict[int, Lane]) -> None:
        self._lanes = lanes
        self._renew()

    def _on_alignment(self, message: PoseWithCovarianceStamped) -> None:
        try:
            shift, turn_rad, _ = movement_of(message, self._place)
        except MessageError as error:
            self._node.diagnostics.refuse(error)
            return
        self._movement = (shift, turn_rad)
        self._renew()

    def _renew(self) -> None:
        if self._movement is None or not self._lanes:
            return
        self.prior = MapPrior.as_seen(self._lanes.values(), *self._movement)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(LaneGeometryNode, args)


if __name__ == "__main__":
    sys.exit(main())
