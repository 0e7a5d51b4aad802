"""Holds the cameras' lanes against the network, and says what it finds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.clock import Clock, ClockType
from std_msgs.msg import String

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.conversions import decode_string, findings_array, movement_message
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.mapcheck.alignment import Alignment
from geoorbit_ros.mapcheck.driven_lanes import DrivenNetwork
from geoorbit_ros.mapcheck.map_watch import MapWatch
from geoorbit_ros.mapcheck.validation import Validation, say_alignment
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.roadnet.network import RoadNetwork

POLL_S = 0.5
"""Between two looks for a result. Chosen: short beside the seconds between two maps of a camera."""


class MapValidator:
    """Topics `<camera>/lanes/geojson` in; `twin/map` and `<camera>/reference/alignment` out.

    Args:
        node: Subscribes and publishes.
        network: The network, in the twin's map frame.
        cameras: Their names.
        frame_id: Name of the cameras' map frames.
        period_s: Between two looks at one camera's lanes, by their stamps; 0 never looks.
        on_alignment: Called with a camera and the alignment that holds from now on; may be None.
        on_driven: Called with the network's lanes where they are driven from now on; may be None.
    """

    def __init__(
        self,
        node: GeoOrbitNode[Any],
        network: RoadNetwork,
        cameras: Sequence[str],
        frame_id: str,
        period_s: float,
        on_alignment: Callable[[str, Alignment], None] | None,
        on_driven: Callable[[DrivenNetwork], None] | None = None,
    ) -> None:
        self._node, self._network, self._frame_id = node, network, frame_id
        self._on_alignment, self._on_driven = on_alignment, on_driven
        self._driven: DrivenNetwork | None = None
        self.watch = MapWatch(network, period_s)
        self.datums: dict[str, Datum] = {}
        if period_s <= 0.0:
            return
        self._findings = node.create_publisher(DiagnosticArray, "twin/map", LATCHED)
        self._movements = {
            camera: node.create_publisher(
                PoseWithCovarianceStamped, f"{camera}/reference/alignment", LATCHED
            )
            for camera in cameras
        }
        for camera in cameras:
            topic = node.resolve_topic_name(f"{camera}/lanes/geojson")
            take = partial(self._take, camera, topic)
            node.create_subscription(String, topic, take, LATCHED, raw=True)
        node.create_timer(POLL_S, self._collect, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def diagnostic_values(self) -> dict[str, object]:
        """Findings of all cameras, and which of them are laid on the map."""
        found = self.watch.validations
        aligned, driven = self.watch.alignments, self.watch.driven
        return {
            "lanes_moved_m": f"{driven.largest_m:.2f}" if driven else "0.00",
            "map_findings": sum(len(v.findings) for v in found.values()),
            **{f"aligned_{c}_m": f"{a.size_m:.2f}" for c, a in aligned.items() if a.significant},
        }

    def close(self) -> None:
        """End the thread."""
        self.watch.close()

    def _take(self, camera: str, topic: str, cdr: bytes) -> None:
        try:
            self.watch.offer(camera, decode_string(cdr, topic))
        except GeoOrbitError as error:
            self._node.diagnostics.refuse(error)

    def _collect(self) -> None:
        for camera, found in self.watch.collect():
            if isinstance(found, GeoOrbitError):
                self._node.diagnostics.refuse(found)
                continue
            moved = self.watch.realigned(camera)
            if moved is not None and self._on_alignment is not None:
                self._on_alignment(camera, moved)
            if self.watch.driven is not self._driven:
                self._driven = self.watch.driven
                if self._on_driven is not None and self._driven is not None:
                    self._on_driven(self._driven)
            self._publish_alignment(camera, found.alignment.applied)
            self._publish_findings()

    def _publish_findings(self) -> None:
        self._findings.publish(
            findings_array(
                self._node.get_clock().now().nanoseconds,
                [_status(camera, found) for camera, found in self.watch.validations.items()],
            )
        )

    def _publish_alignment(self, camera: str, alignment: Alignment) -> None:
        """In the camera's own map frame, whose origin may be another than the twin's."""
        own = self.datums.get(camera, self._network.datum)
        centre = own.to_local(*self._network.datum.to_geodetic(alignment.centre_m).T)[0]
        shift, covariance = alignment.about_origin(centre)
        self._movements[camera].publish(
            movement_message(
                self._frame_id, float(shift[0]), float(shift[1]), alignment.turn_rad, covariance
            )
        )


def _status(camera: str, found: Validation) -> tuple[str, list[str], dict[str, str]]:
    values = {name: f"{value:g}" for name, value in found.alignment.values().items()}
    values["alignment"] = say_alignment(found.alignment)
    values["compared_lanes"] = str(len(found.discrepancies.compared))
    values["significant"] = str(found.alignment.significant).lower()
    return f"map as seen by {camera}", [f.sentence for f in found.findings], values
