"""Topics of `std_msgs/ByteMultiArray`: payloads in, payloads out, nothing filled byte by byte."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.qos import QoSProfile
from std_msgs.msg import ByteMultiArray

from geoorbit_ros.conversions import decode_byte_array, encode_byte_array
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.nodes.support.base import GeoOrbitNode


def subscribe_payloads(
    node: GeoOrbitNode[Any],
    topic: str,
    qos: QoSProfile,
    on_payload: Callable[[bytes], None],
) -> None:
    """Hand each payload of a topic on; what is refused is counted and logged by the node.

    Args:
        node: Subscribes; its diagnostics count.
        topic: Of type ByteMultiArray.
        qos: Quality of service.
        on_payload: Raises GeoOrbitError for a payload that can't be used.
    """
    place = node.resolve_topic_name(topic)

    def receive(cdr: bytes) -> None:
        start = time.perf_counter()
        try:
            on_payload(decode_byte_array(cdr, place))
        except GeoOrbitError as error:
            node.diagnostics.refuse(error)
        node.diagnostics.took(time.perf_counter() - start)

    node.create_subscription(ByteMultiArray, topic, receive, qos, raw=True)


class PayloadPublisher:
    """Publishes payloads on one topic.

    Attributes:
        sent_bytes: Payload bytes published so far.
        subscribers: How many listen now.
    """

    def __init__(self, node: GeoOrbitNode[Any], topic: str, qos: QoSProfile) -> None:
        self._node = node
        self._publisher = node.create_publisher(ByteMultiArray, topic, qos)
        self.sent_bytes = 0

    @property
    def subscribers(self) -> int:
        """How many listen now."""
        return int(self._publisher.get_subscription_count())

    def publish(self, payload: bytes) -> None:
        """Send one payload."""
        self._publisher.publish(encode_byte_array(payload))
        self.sent_bytes += len(payload)
        self._node.diagnostics.published += 1
