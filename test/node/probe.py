"""A node that tests listen and speak through."""

from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED_ALL, stream_qos
from geoorbit_ros.storage.pointcloud2 import decode_table, encode_table

LIMIT_S = 120.0
"""Longest wait without progress: ends a test that would hang, never one on a busy machine."""
KEEP_ALL = stream_qos("reliable", 0)
LOSSLESS = {"reliability": "reliable", "queue_depth": 0}


class Probe:
    """Publishes and subscribes in a camera's namespace.

    Attributes:
        heard: Messages by topic, as they came.
    """

    def __init__(self, nodes: Composition, namespace: str = "north", name: str = "probe") -> None:
        self.nodes = nodes
        self.node = nodes.add(Node(name, context=nodes.context, namespace=namespace))
        self.heard: dict[str, list[Any]] = {}

    def listen(self, topic: str, message: type, qos: QoSProfile | None = None) -> list[Any]:
        heard = self.heard.setdefault(topic, [])
        self.node.create_subscription(message, topic, heard.append, qos or LATCHED_ALL)
        return heard

    def listen_tables(self, topic: str, dtype: np.dtype[np.void]) -> list[Any]:
        """Decoded tables of a stream: (stamp_ns, frame_id, rows)."""
        heard = self.heard.setdefault(topic, [])

        def take(cdr: bytes) -> None:
            heard.append(decode_table(cdr, dtype, topic))

        self.node.create_subscription(PointCloud2, topic, take, KEEP_ALL, raw=True)
        return heard

    def table_publisher(self, topic: str) -> Callable[[int, NDArray[np.void]], None]:
        """A function that publishes one table, once somebody subscribes."""
        publisher = self.node.create_publisher(PointCloud2, topic, KEEP_ALL)
        self.until(lambda: publisher.get_subscription_count() > 0, f"a subscriber on {topic}")

        def send(stamp_ns: int, rows: NDArray[np.void]) -> None:
            publisher.publish(encode_table(stamp_ns, "probe", rows))

        return send

    def publisher(self, topic: str, message: type, qos: QoSProfile | None = None) -> Publisher:
        publisher = self.node.create_publisher(message, topic, qos or KEEP_ALL)
        self.until(lambda: publisher.get_subscription_count() > 0, f"a subscriber on {topic}")
        return publisher

    def until(self, met: Callable[[], bool], what: str) -> None:
        self.nodes.wait(met, LIMIT_S, what)

    def call(self, service: str, kind: type, request: Any) -> Any:
        client = self.node.create_client(kind, service)
        self.until(client.service_is_ready, f"service {service}")
        answer = client.call_async(request)
        self.until(answer.done, f"an answer of {service}")
        return answer.result()

    def status_of(self, name: str) -> dict[str, str]:
        """The next diagnostic values of a node, with `level` and `message`."""
        heard: list[DiagnosticArray] = []
        subscription = self.node.create_subscription(
            DiagnosticArray, "/diagnostics", heard.append, 10
        )

        def found() -> list[Any]:
            return [s for array in heard for s in array.status if s.name == name]

        self.until(lambda: bool(found()), f"a status of {name}")
        self.node.destroy_subscription(subscription)
        status = found()[-1]
        values = {pair.key: pair.value for pair in status.values}
        return values | {"level": str(status.level[0]), "message": status.message}
