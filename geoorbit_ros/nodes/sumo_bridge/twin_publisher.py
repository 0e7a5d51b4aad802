"""Publishes the twin after every step, and how well it follows."""

from __future__ import annotations

import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import NavSatFix, PointCloud2

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.conversions import (
    datum_to_fix,
    encode_clock,
    encode_pose_array,
    encode_table,
    health_array,
    vehicle_poses,
)
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.twin.health import HealthReport, HealthWindow
from geoorbit_ros.twin.placement import TwinStep, track_rows

CLOCK_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""As rclcpp's ClockQoS: the newest time only."""


class TwinPublisher:
    """Topics `twin/vehicles`, `twin/tracks`, `twin/health`, `twin/datum` and, if asked, `/clock`.

    Args:
        node: Publishes.
        datum: Origin of the twin's map frame.
        frame_id: Its name.
        qos: Of the topics that come with every step.
        health_period_s: Time between two reports, by the stamps of the steps.
        clock: Whether the twin's time is the graph's.

    Attributes:
        latest: The last report.
        arrived_s: `time.perf_counter` when the frame came that is being handled.
    """

    def __init__(
        self,
        node: GeoOrbitNode[Any],
        datum: Datum,
        frame_id: str,
        qos: QoSProfile,
        health_period_s: float,
        *,
        clock: bool,
    ) -> None:
        self._node, self._frame_id = node, frame_id
        self._period_ns = round(health_period_s * 1e9)
        self.vehicles = node.create_publisher(PoseArray, "twin/vehicles", qos)
        self.tracks = node.create_publisher(PointCloud2, "twin/tracks", qos)
        self._health = node.create_publisher(DiagnosticArray, "twin/health", 10)
        self._fix = node.create_publisher(NavSatFix, "twin/datum", LATCHED)
        self._fix.publish(datum_to_fix(datum, frame_id))
        self._clock = node.create_publisher(Clock, "/clock", CLOCK_QOS) if clock else None
        self._window, self._since_ns = HealthWindow(), -1
        self.latest: HealthReport | None = None
        self.arrived_s = time.perf_counter()

    def diagnostic_values(self) -> dict[str, str]:
        """The last report's main figures, for diagnostics."""
        latest = self.latest
        return {
            "steps_per_s": f"{latest.steps_per_s:.0f}" if latest else "",
            "error_m_p95": f"{latest.position_error_m_p95:.3f}" if latest else "",
            "other_lane_share": f"{latest.lane_error_share:.4f}" if latest else "",
        }

    def publish(self, step: TwinStep) -> None:
        """Publish one step."""
        rows = track_rows(step)
        if self._clock is not None:
            self._clock.publish(encode_clock(step.stamp_ns))
        poses = encode_pose_array(step.stamp_ns, self._frame_id, *vehicle_poses(rows))
        self._node.publish_stream(self.vehicles, poses)
        if self.tracks.get_subscription_count():
            self.tracks.publish(encode_table(step.stamp_ns, self._frame_id, rows))
        self._window.add(step)
        self._window.add_latency(time.perf_counter() - self.arrived_s)
        if self._since_ns < 0 or step.stamp_ns < self._since_ns:
            self._since_ns = step.stamp_ns
        if step.stamp_ns - self._since_ns >= self._period_ns:
            self._since_ns = step.stamp_ns
            self.latest = self._window.report()
            name = self._node.get_fully_qualified_name()
            self._health.publish(
                health_array(step.stamp_ns, name, self.latest.faults, self.latest.values())
            )
