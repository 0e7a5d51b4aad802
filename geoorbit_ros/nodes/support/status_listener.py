"""Collects what the nodes of a graph say on /diagnostics."""

from __future__ import annotations

import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.context import Context
from rclpy.node import Node

from geoorbit_ros.fleet.health import NodeReport

QUEUE = 1000
"""More nodes than a fleet reports with in a second."""


class StatusListener(Node):
    """Keeps the last status of every node; not itself a part of the fleet.

    Args:
        context: ROS context.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__("geoorbit_status", context=context)
        self._last: dict[str, tuple[float, DiagnosticStatus]] = {}
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_status, QUEUE)

    def reports(self) -> list[NodeReport]:
        """The last report of every node heard so far."""
        now = time.monotonic()
        return [
            NodeReport(
                name=name,
                ok=status.level == DiagnosticStatus.OK,
                message=status.message,
                values={item.key: item.value for item in status.values},
                age_s=now - came_s,
            )
            for name, (came_s, status) in sorted(self._last.items())
        ]

    def _on_status(self, array: DiagnosticArray) -> None:
        now = time.monotonic()
        for status in array.status:
            self._last[status.name] = (now, status)
