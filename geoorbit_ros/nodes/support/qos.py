"""Quality of service of the topics, by what they carry."""

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
"""Of a state: who subscribes later gets the last message. To publish, and to follow the newest."""
LATCHED_ALL = _latched(100)
"""To subscribe where every message counts, not the newest alone."""


def stream_qos(reliability: str, queue_depth: int) -> QoSProfile:
    """Quality of service of whatever comes many times a second.

    Args:
        reliability: `best_effort` or `reliable`.
        queue_depth: Messages kept for a reader that is behind; 0 keeps all (5000 on either side in
            Fast DDS; then a reliable publisher blocks).
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST if queue_depth else HistoryPolicy.KEEP_ALL,
        depth=queue_depth,
        reliability=ReliabilityPolicy[reliability.upper()],
    )


MIN_UPDATES, MAX_UPDATES = 32, 256
"""Client updates kept for a server that is busy, at least and at most. Chosen: those of a tenth of
a second, in which a round is closed and saved; more lets a sender of rubbish fill the memory."""


def updates_qos(reliability: str = "reliable", clients: int = 0) -> QoSProfile:
    """For updates: many may come at once, and a late joiner needs none of before.

    Args:
        reliability: `reliable` or, for a server whose clients send again by themselves,
            `best_effort`. Publishers are always reliable, which fits both.
        clients: How many there are; two updates of each are kept, within bounds.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=min(max(2 * clients, MIN_UPDATES), MAX_UPDATES),
        reliability=ReliabilityPolicy[reliability.upper()],
    )


def model_qos(depth: int) -> QoSProfile:
    """For models: reliable, and a late joiner gets the last `depth`, a whole one among them."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


LOOKS = stream_qos("best_effort", 64)
"""To subscribe `view`, from whatever publisher: five seconds of a camera that shakes are kept."""
