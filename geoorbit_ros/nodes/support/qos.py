"""Topics whose last message reaches whoever subscribes later."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def _latched(depth: int) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


LATCHED = _latched(1)
"""To publish, and to follow the newest state."""
LATCHED_ALL = _latched(100)
"""To subscribe where every message counts, not the newest alone."""
