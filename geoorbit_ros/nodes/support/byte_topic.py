"""Topics of `std_msgs/ByteMultiArray`: payloads in, payloads out, nothing filled byte by byte."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.qos import QoSProfile
from std_msgs.msg import ByteMultiArray

from geoorbit_ros.conversions import decode_byte_array, encode_byte_array
from geoorbit_ros.core.errors import GeoOrbitError, MessageError
from geoorbit_ros.federated.payloads.header import MAX_PAYLOAD_BYTES
from geoorbit_ros.nodes.support.base import GeoOrbitNode

RUBBISH_BYTES = 64_000_000
"""So much that was too long makes a topic's memory be given back. Chosen: the middleware keeps the
longest message that it has had, once for each one that it may have to keep; smaller gives back more
often, which takes some milliseconds and the messages that wait."""
RELEASE_S = 0.5
"""Between leaving a topic and listening again. Chosen: the executor has let go of it by then;
larger loses more of what others send meanwhile."""
_FRAMING_BYTES = 256
"""More than the message has around its payload."""


class PayloadSubscription:
    """Hands each payload of a topic on; what is refused is counted and logged by the node.

    A message that is too long is looked at no further. Fast DDS keeps the memory of messages
    for later ones: after `RUBBISH_BYTES` of them the topic is left for a moment, which frees it.

    Args:
        node: Subscribes; its diagnostics count.
        topic: Of type ByteMultiArray.
        qos: Quality of service.
        on_payload: Raises GeoOrbitError for a payload that can't be used.
        longest: Bytes of the longest payload that can be used.
    """

    def __init__(
        self,
        node: GeoOrbitNode[Any],
        topic: str,
        qos: QoSProfile,
        on_payload: Callable[[bytes], None],
        longest: int = MAX_PAYLOAD_BYTES,
    ) -> None:
        self._node, self._topic, self._qos = node, topic, qos
        self._on_payload, self._longest = on_payload, longest
        self._place = node.resolve_topic_name(topic)
        self._rubbish_bytes = 0
        self._timer: Any = None
        self._subscribe()

    def _subscribe(self) -> None:
        self._subscription = self._node.create_subscription(
            ByteMultiArray, self._topic, self._receive, self._qos, raw=True
        )

    def _receive(self, cdr: bytes) -> None:
        start = time.perf_counter()
        try:
            if len(cdr) > self._longest + _FRAMING_BYTES:
                self._count_rubbish(len(cdr))
                expected = f"{self._longest} at most"
                raise MessageError(self._place, f"a payload of {len(cdr)} bytes", expected)
            self._on_payload(decode_byte_array(cdr, self._place))
        except GeoOrbitError as error:
            self._node.diagnostics.refuse(error)
        self._node.diagnostics.took(time.perf_counter() - start)

    def _count_rubbish(self, size: int) -> None:
        self._rubbish_bytes += size
        if self._rubbish_bytes >= RUBBISH_BYTES and self._timer is None:
            # Not here: the executor still holds the subscription whose message this is.
            self._timer = self._node.create_timer(0.0, self._leave)

    def _leave(self) -> None:
        self._node.destroy_subscription(self._subscription)
        self._after(RELEASE_S, self._come_back)

    def _come_back(self) -> None:
        with suppress(AttributeError):  # another C library than glibc gives it back by itself
            ctypes.CDLL(None).malloc_trim(0)
        self._node.destroy_timer(self._timer)
        self._timer, self._rubbish_bytes = None, 0
        self._subscribe()

    def _after(self, wait_s: float, do: Callable[[], None]) -> None:
        self._node.destroy_timer(self._timer)
        self._timer = self._node.create_timer(wait_s, do)


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
