"""Node `lane_geometry`: vehicles on the road become a lane map that keeps itself up to date."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import NavSatFix
from std_srvs.srv import Trigger

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.conversions import datum_from_fix
from geoorbit_ros.core.errors import MessageError, PluginError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.federated.keys import Verifier, public_key
from geoorbit_ros.federated.payloads.lane_parameters import MAX_BYTES, ThetaInbox
from geoorbit_ros.lanes.common_shift import with_shift_sigma
from geoorbit_ros.lanes.mapping.live_mapper import LiveMapper
from geoorbit_ros.lanes.parameters import LaneParameters
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.byte_topic import PayloadSubscription
from geoorbit_ros.nodes.support.lane_publisher import LanePublisher
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.nodes.support.reference_listener import PriorListener
from geoorbit_ros.nodes.support.road_paint import PaintListener
from geoorbit_ros.nodes.support.table_stream import TableStream
from geoorbit_ros.nodes.support.view_listener import ViewNotes


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
    """Subscribes `tracks`, `datum`, `view`; publishes the lane map on `lanes…`, latched.

    Boundaries follow painted lines once `road_plane` and `road_image/compressed` have come.
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
        file = Path(p.state_file) if p.state_file else None
        self._mapper = LiveMapper(
            p.estimator, self.theta, p.update_period_s, file, self.diagnostics.warn
        )
        self._prior = PriorListener(self) if p.map_prior else None
        self.paint = PaintListener(self)
        self._lanes = LanePublisher(self, p.frame_id, p.estimator, tentative=p.publish_tentative)
        self._view = ViewNotes(self, self._on_view)
        TableStream(self, "tracks", TRACK_DTYPE, p, self._on_frame, self._mapper.restart)
        self.create_subscription(NavSatFix, "datum", self._on_datum, LATCHED)
        PayloadSubscription(self, "lane_parameters", LATCHED, self._on_theta, MAX_BYTES)
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
            "view": self._view.note.why if self._view.note else "",
            "held": self._view.note is not None and self._view.note.held,
            "paint": self.paint.sentence,
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

    def _on_view(self) -> None:
        """Lanes that are held say so at once, and so do those that are live again."""
        if self._latest is not None:
            self._publish(self._latest)

    def _publish(self, lane_map: LaneMap, *, anew: bool = False) -> None:
        self._latest = lane_map
        lane_map = replace(lane_map, view=self._view.note)
        refined = lane_map if self._prior is None else self._prior.refine(lane_map)
        bounded = self.paint.follow(refined, anew=anew)
        if self.paint.plane is not None:
            bounded = with_shift_sigma(bounded, self.paint.plane)
        self._lanes.publish(bounded, self.datum)
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
            self._publish(lane_map, anew=True)
            response.message = f"{len(lane_map.lanes)} lanes from {self.frames} frames"
        return response


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(LaneGeometryNode, args)


if __name__ == "__main__":
    sys.exit(main())
