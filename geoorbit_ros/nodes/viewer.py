"""Node `viewer`: the topics of the graph, for Foxglove-compatible viewers."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from rclpy.clock import Clock, ClockType
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from geoorbit_ros.conversions import message_class
from geoorbit_ros.core.errors import GeoOrbitError, ParameterError
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED_ALL
from geoorbit_ros.viewer.server import ViewerServer

STREAM_DEPTH = 5
"""Messages kept while the server is busy. Chosen: larger, a slow viewer sees older images."""


@dataclass(frozen=True, slots=True)
class ViewerParameters:
    """See params/viewer.yaml."""

    host: str
    port: int
    topics: str
    discovery_period_s: float


class ViewerNode(GeoOrbitNode[ViewerParameters]):
    """Offers every topic that has a publisher; a stream is subscribed while a viewer looks at it.

    Boxes are also offered as shapes over the image (`image/annotations`), lane maps as GeoJSON
    (`lanes/map`).
    """

    name = "viewer"
    struct = ViewerParameters

    def setup(self) -> None:
        """Listen, and look at the graph."""
        try:
            self._pattern = re.compile(self.p.topics)
        except re.error as error:
            raise ParameterError(
                "node 'viewer', parameter 'topics'", self.p.topics, f"an expression ({error})"
            ) from error
        self.server = ViewerServer("geoorbit", self.p.host, self.p.port)
        self._types: dict[str, str] = {}
        self._readers: dict[str, Subscription] = {}
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(self.p.discovery_period_s, self.discover, clock=clock)
        self.discover()
        self.get_logger().info(f"viewers: ws://{self.p.host}:{self.server.port}")

    def diagnostic_values(self) -> Mapping[str, object]:
        """What is offered and looked at."""
        offered, read = len(self.server.topics), len(self._readers)
        return {"port": self.server.port, "topics": offered, "read": read}

    def close(self) -> None:
        """End the connections of all viewers."""
        self.server.close()

    def discover(self) -> None:
        """Offer new topics, withdraw those without publisher, read those that are looked at."""
        found = {
            topic: types[0]
            for topic, types in self.get_topic_names_and_types()
            if self._pattern.fullmatch(topic) and self.count_publishers(topic)
        }
        for topic in set(self._types) - set(found):
            self._stop_reading(topic)
            del self._types[topic]
            if topic in self.server.topics:
                self.server.withdraw(topic)
        for topic, type_name in found.items():
            if topic not in self._types:
                self._offer(topic, type_name)
        wanted = self.server.wanted()
        for topic in set(self._readers) - wanted:
            self._stop_reading(topic)
        for topic in wanted - set(self._readers):
            self._read(topic)
        self._guarded(self.server.send_kept, time.time_ns())

    def _offer(self, topic: str, type_name: str) -> None:
        self._types[topic] = type_name
        if message_class(type_name) is not None:
            self._guarded(self.server.offer, topic, type_name)

    def _read(self, topic: str) -> None:
        ends = self.get_publishers_info_by_topic(topic)
        latched = any(e.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for e in ends)
        stream = QoSProfile(depth=STREAM_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        message_type = message_class(self._types[topic])
        take = partial(self._take, topic, latched)
        self._readers[topic] = self.create_subscription(
            message_type, topic, take, LATCHED_ALL if latched else stream, raw=True
        )

    def _stop_reading(self, topic: str) -> None:
        if topic in self._readers:
            self.destroy_subscription(self._readers.pop(topic))
            self.server.forget(topic)

    def _take(self, topic: str, latched: bool, cdr: bytes) -> None:
        start = time.perf_counter()
        self._guarded(partial(self.server.send, keep=latched), topic, cdr, time.time_ns())
        self.diagnostics.published += 1
        self.diagnostics.took(time.perf_counter() - start)

    def _guarded(self, act: Callable[..., None], *arguments: object) -> None:
        try:
            act(*arguments)
        except GeoOrbitError as error:
            self.diagnostics.refuse(error)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(ViewerNode, args)


if __name__ == "__main__":
    sys.exit(main())
