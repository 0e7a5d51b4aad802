"""Publishes what was counted: vehicles, crossings, intervals and events, and texts for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from geoorbit_ros.conversions import encode_string, encode_table
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import LATCHED, LATCHED_ALL
from geoorbit_ros.traffic.class_schemes import ClassScheme
from geoorbit_ros.traffic.counter import Counted
from geoorbit_ros.traffic.event_records import count_begun
from geoorbit_ros.traffic.interval_clock import IntervalClock
from geoorbit_ros.traffic.live import Finished, LiveTraffic
from geoorbit_ros.traffic.messages import events_json, intervals_json, point_table


class TrafficPublisher:
    """Topics `traffic/…` of one camera.

    Args:
        node: Publishes.
        frame_id: Of the tables.
        camera_id: In the texts.
        scheme: Of the classes in the texts.
        clock: Of the times in the texts.

    Attributes:
        intervals: How many were published.
        vehicles: How many were counted.
        events: How many began.
    """

    def __init__(
        self,
        node: GeoOrbitNode[Any],
        frame_id: str,
        camera_id: str,
        scheme: ClassScheme,
        clock: IntervalClock,
    ) -> None:
        self.intervals = self.vehicles = self.events = 0
        self._node, self._frame_id, self._camera = node, frame_id, camera_id
        self._scheme, self._clock = scheme, clock
        self._tables = {
            topic: node.create_publisher(PointCloud2, f"traffic/{topic}", LATCHED_ALL)
            for topic in ("intervals", "vehicles", "crossings", "events")
        }
        self._json: Publisher = node.create_publisher(String, "traffic/intervals_json", LATCHED)
        self._now: Publisher = node.create_publisher(String, "traffic/events_json", LATCHED)
        self._told_now = ""

    def counts(self, counted: Counted, finished: Sequence[Finished]) -> None:
        """Vehicles that are gone, and intervals that are over."""
        self.vehicles += counted.vehicles
        for topic, rows, stamp in (
            ("vehicles", counted.passages, "last_ns"),
            ("crossings", counted.crossings, "stamp_ns"),
        ):
            if len(rows):
                self._publish(topic, int(rows[stamp].max()), rows)
        for part in finished:
            self._publish("intervals", int(part.edges_ns[-1]), part.measures)
            self.intervals += len(part.edges_ns) - 1
            self._node.diagnostics.published += 1
        if finished:
            text = intervals_json(finished[-1], self._scheme, self._clock, self._camera)
            self._json.publish(encode_string(text))

    def told(self, live: LiveTraffic, rows: NDArray[np.void]) -> None:
        """What was told of events, and all that last now, where that has changed."""
        if len(rows):
            self._publish("events", int(rows["stamp_ns"][-1]), rows)
            self.events += count_begun(rows)
        if live.watch is None:
            return
        text = events_json(live.watch.lasting, self._clock, self._camera)
        if text != self._told_now:
            self._now.publish(encode_string(text))
            self._told_now = text

    def _publish(self, topic: str, stamp_ns: int, rows: NDArray[np.void]) -> None:
        self._tables[topic].publish(encode_table(stamp_ns, self._frame_id, point_table(rows)))
