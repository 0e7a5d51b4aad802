"""Subscribes to a stream of tables and hands on the frames that can be used, in order."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from geoorbit_ros.conversions import decode_table
from geoorbit_ros.core.errors import GeoOrbitError, MessageError
from geoorbit_ros.core.frame_order import Arrival, FrameOrder, order_fault
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import stream_qos

_TYPE = "sensor_msgs/msg/PointCloud2"


class StreamParameters(Protocol):
    """Parameters of every node that reads a stream of frames."""

    @property
    def reliability(self) -> str:
        """`best_effort` or `reliable`."""

    @property
    def queue_depth(self) -> int:
        """Frames kept while the node is busy; 0 keeps all."""

    @property
    def restart_jump_s(self) -> float:
        """A stamp earlier by more than this is a source that started again."""


class TableStream:
    """One subscription to tables. Unusable messages are refused one by one, with the reason.

    Args:
        node: Subscribes, and counts in its diagnostics.
        topic: Relative name.
        dtype: Rows wanted.
        parameters: Quality of service, and what counts as a restart.
        on_frame: Takes stamp and rows of each frame in order; may raise GeoOrbitError to refuse.
        on_restart: Called before the first frame of a source that started again.

    Attributes:
        frame_id: Coordinate frame of the latest table.
    """

    def __init__(
        self,
        node: GeoOrbitNode[Any],
        topic: str,
        dtype: np.dtype[np.void],
        parameters: StreamParameters,
        on_frame: Callable[[int, NDArray[np.void]], None],
        on_restart: Callable[[], None],
    ) -> None:
        self._node, self._dtype = node, dtype
        self._on_frame, self._on_restart = on_frame, on_restart
        self.frame_id = ""
        self._order = FrameOrder[NDArray[np.void]](parameters.restart_jump_s)
        self._place = node.resolve_topic_name(topic)
        qos = stream_qos(parameters.reliability, parameters.queue_depth)
        node.create_subscription(PointCloud2, topic, self._receive, qos, raw=True)
        node.diagnostics.add_check(self._foreign_type)

    def _receive(self, cdr: bytes) -> None:
        start = time.perf_counter()
        diagnostics = self._node.diagnostics
        try:
            self._handle(cdr)
        except GeoOrbitError as error:
            diagnostics.refuse(error)
        diagnostics.missing = self._order.missing
        diagnostics.took(time.perf_counter() - start)

    def _handle(self, cdr: bytes) -> None:
        stamp_ns, self.frame_id, rows = decode_table(cdr, self._dtype, self._place)
        last_ns = self._order.last_ns
        for arrival, stamp, frame in self._order.take(stamp_ns, rows):
            try:
                self._pass_on(arrival, stamp, frame, last_ns)
            except GeoOrbitError as error:
                self._node.diagnostics.refuse(error)

    def _pass_on(
        self, arrival: Arrival, stamp_ns: int, rows: NDArray[np.void], last_ns: int | None
    ) -> None:
        if fault := order_fault(arrival, stamp_ns, last_ns, self._place):
            raise fault
        if arrival is Arrival.RESTART and last_ns is not None:
            jump = f"time went back by {(last_ns - stamp_ns) / 1e9:.1f} s, starting anew"
            self._node.get_logger().info(f"{self._place}: {jump}")
            self._on_restart()
        self._on_frame(stamp_ns, rows)
        self._node.diagnostics.handled(stamp_ns)

    def _foreign_type(self) -> str | None:
        """A publisher of another type: DDS never delivers its messages, so look for it."""
        for end in self._node.get_publishers_info_by_topic(self._place):
            if end.topic_type != _TYPE:
                found = f"{end.topic_type} from node '{end.node_name}'"
                return str(MessageError(self._place, found, _TYPE))
        return None
