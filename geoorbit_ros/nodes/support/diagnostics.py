"""Topic /diagnostics: what every node says about itself once a second, and who collects it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.fleet.health import NodeReport

PERIOD_S = 1.0
"""Between two reports: the default of ROS's diagnostic_updater."""
LOG_PERIOD_S = 10.0
"""A reason that persists is logged this often. Chosen: larger, it is overlooked; smaller, it hides
the rest of the log."""
OLD_S = 600.0
"""Stamps older than this are a recording's own, not the present: they have no age.
Chosen: longer than any delay of a live graph."""
QUEUE = 1000
"""More nodes than a fleet reports with in a second."""


class Diagnostics:
    """Counters of one node, published on /diagnostics at 1 Hz of wall time.

    Wall time, because a stopped /clock is among the things a diagnosis must show.

    Args:
        node: Whose; the status carries its full name, the hardware id its namespace.
        details: Further values, asked for at every report.

    Attributes:
        received: Messages taken from the input stream, refused ones included.
        published: Messages sent to the output stream.
        refused: Messages that could not be used.
        last_refusal: Why the last of them was refused.
        missing: Frames that should lie between those that came, by the stream's usual interval.
    """

    def __init__(self, node: Node, details: Callable[[], Mapping[str, object]] = dict) -> None:
        self.received = self.published = self.refused = self.missing = 0
        self._node = node
        self._details = details
        self._latency_s: list[float] = []
        self._age_s: list[float] = []
        self.last_refusal: Exception | None = None
        self._logged_s: dict[str, float] = {}
        self._checks: list[Callable[[], str | None]] = []
        self._seen = (0, 0, 0)
        self._since_s = time.monotonic()
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(PERIOD_S, self.report, clock=clock)

    def took(self, latency_s: float) -> None:
        """Count one message that was handled in `latency_s`."""
        self.received += 1
        self._latency_s.append(latency_s)

    def handled(self, stamp_ns: int) -> None:
        """Note how old a frame is, by its stamp and the node's clock, now that it is done with."""
        age_s = (self._node.get_clock().now().nanoseconds - stamp_ns) / 1e9
        if abs(age_s) < OLD_S:
            self._age_s.append(age_s)

    def refuse(self, error: Exception) -> None:
        """Count a message that could not be used, and log why (each kind at most every 10 s)."""
        self.refused += 1
        self.last_refusal = error
        place = error.place if isinstance(error, GeoOrbitError) else ""
        self.warn(f"refused: {error}", f"{type(error).__name__} {place}")

    def warn(self, sentence: str, kind: str = "") -> None:
        """Log a sentence; one of the same kind at most every 10 s."""
        now = time.monotonic()
        kind = kind or sentence
        if now - self._logged_s.get(kind, -math.inf) >= LOG_PERIOD_S:
            self._logged_s[kind] = now
            self._node.get_logger().warning(sentence)

    def add_check(self, check: Callable[[], str | None]) -> None:
        """Ask at every report for a sentence about something wrong; None when all is well."""
        self._checks.append(check)

    def report(self) -> None:
        """Publish one status."""
        now = time.monotonic()
        elapsed, self._since_s = now - self._since_s, now
        latency_ms = sorted(1e3 * value for value in self._latency_s)
        age_ms = sorted(1e3 * value for value in self._age_s)
        self._latency_s, self._age_s = [], []
        before, self._seen = self._seen, (self.received, self.refused, self.missing)
        came, refused, missing = (a - b for a, b in zip(self._seen, before, strict=True))
        faults = [fault for check in self._checks if (fault := check())]
        for fault in faults:
            self.warn(fault)
        if refused:
            faults.append(str(self.last_refusal))
        if missing > 0:  # below zero: frames came late that were counted before
            faults.append(f"{missing} frames missing")
        values = {
            "rate_hz": f"{came / max(elapsed, 1e-9):.1f}",
            "latency_ms_median": _quantile(latency_ms, 0.5),
            "latency_ms_p99": _quantile(latency_ms, 0.99),
            "age_ms_median": _quantile(age_ms, 0.5),
            "age_ms_p99": _quantile(age_ms, 0.99),
            "received": self.received,
            "published": self.published,
            "refused": self.refused,
            "missing": self.missing,
            "last_refusal": self.last_refusal or "",
            **self._details(),
        }
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if faults else DiagnosticStatus.OK,
            name=self._node.get_fully_qualified_name(),
            message="; ".join(faults) or ("ok" if self.received else "nothing received yet"),
            hardware_id=self._node.get_namespace().strip("/"),
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


def _quantile(ordered: list[float], share: float) -> str:
    return f"{ordered[math.ceil(share * len(ordered)) - 1]:.3f}" if ordered else ""


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
