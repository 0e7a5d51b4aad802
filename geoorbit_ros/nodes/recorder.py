"""Node `recorder`: tracks and lane maps go into the trajectory database."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from std_msgs.msg import String

from geoorbit_ros.conversions import decode_string
from geoorbit_ros.core.bounded_json import read_json
from geoorbit_ros.core.errors import GeoOrbitError, MessageError, ParameterError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.core.wall_clock import RetentionClock, refuse_ahead
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED_ALL
from geoorbit_ros.nodes.support.table_stream import TableStream
from geoorbit_ros.nodes.support.view_listener import listen_to_views
from geoorbit_ros.storage.database.reader import ViewEvent
from geoorbit_ros.storage.database.writer import TrajectoryDatabase
from geoorbit_ros.view.looks import ViewLook
from geoorbit_ros.view.timeline import ViewStretch, ViewTimeline

FLUSH_PERIOD_S = 0.5
"""A kill costs less than a second, also when the camera has fallen silent."""
VIEWS_AT_ONCE = 16
"""Stretches of the view's history that may change or be new between two flushes."""


@dataclass(frozen=True, slots=True)
class RecorderParameters:
    """See params/recorder.yaml."""

    database: str
    camera_id: str
    retention_days: float
    reliability: str
    queue_depth: int
    restart_jump_s: float


class RecorderNode(GeoOrbitNode[RecorderParameters]):
    """Subscribes `tracks`, `lanes/geojson`, `view` of its namespace; appends them to the database.

    Frames that are already in the database, as when a bag is played again, are refused, and so are
    those of the future. What is old is so by this computer's clock, never by a stamp.
    """

    name = "recorder"
    struct = RecorderParameters
    optional = True

    def setup(self) -> None:
        """Open the database, then subscribe."""
        self._camera = self.p.camera_id or self.camera_id
        if not self._camera:
            place = f"node '{self.get_fully_qualified_name()}', parameter 'camera_id'"
            raise ParameterError(place, "nothing, in the root namespace", "the camera's name")
        self.lane_maps = 0
        self._views, self._stored = ViewTimeline(), list[ViewStretch]()
        self._database = TrajectoryDatabase(Path(self.p.database))
        try:
            self._database.claim(self._camera)
            newest_ns = self._database.newest_stored_ns(self._camera)
        except GeoOrbitError:
            self._database.close()
            raise
        self._retention = RetentionClock(self.p.retention_days, newest_ns)
        self.diagnostics.add_check(lambda: self._retention.doubt)
        TableStream(self, "tracks", TRACK_DTYPE, self.p, self._on_frame, lambda: None)
        self._geojson_topic = self.resolve_topic_name("lanes/geojson")
        self.create_subscription(String, "lanes/geojson", self._on_lanes, LATCHED_ALL, raw=True)
        listen_to_views(self, self._on_view)
        self.create_timer(
            FLUSH_PERIOD_S, self._maintain, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def close(self) -> None:
        """Commit what is left."""
        try:
            self._store_views()
            self._database.close()
        except GeoOrbitError as error:
            self.get_logger().error(str(error))

    def _on_frame(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        refuse_ahead(stamp_ns, f"tracks of '{self._camera}'")
        self._database.append(self._camera, stamp_ns, rows)

    def _on_lanes(self, cdr: bytes) -> None:
        try:
            text = decode_string(cdr, self._geojson_topic)
            self._database.append_lanes(self._camera, self._map_stamp_ns(text), text)
            self.lane_maps += 1
        except GeoOrbitError as error:
            self.diagnostics.refuse(error)

    def _on_view(self, look: ViewLook) -> None:
        refuse_ahead(look.stamp_ns, self.resolve_topic_name("view"))
        self._views.add(look)

    def _store_views(self) -> None:
        """Store what is new of the view's history: the end of the last stretch, and later ones."""
        stretches = self._views.stretches[-VIEWS_AT_ONCE:]
        changed = [stretch for stretch in stretches if stretch not in self._stored]
        if changed:
            self._database.put_view_events(self._camera, [_event(k) for k in changed])
            self._stored = stretches

    def _map_stamp_ns(self, text: str) -> int:
        expected = "the lane map as GeoJSON"
        try:
            stamp_ns = read_json(text, self._geojson_topic, expected)["geoorbit"]["stamp_ns"]
        except (KeyError, TypeError):
            found = f"{len(text)} characters without geoorbit.stamp_ns"
            raise MessageError(self._geojson_topic, found, expected) from None
        if type(stamp_ns) is not int:
            raise MessageError(self._geojson_topic, f"stamp_ns {stamp_ns!r:.40}", "nanoseconds")
        refuse_ahead(stamp_ns, self._geojson_topic)
        return stamp_ns

    def _maintain(self) -> None:
        try:
            self._database.flush()
            self._store_views()
            if (before_ns := self._retention.cutoff_ns()) is not None:
                self._database.prune(self._camera, before_ns)
        except GeoOrbitError as error:  # a full disk may have room again later
            self.diagnostics.refuse(error)


def _event(stretch: ViewStretch) -> ViewEvent:
    return ViewEvent(
        stretch.first_ns,
        stretch.last_ns,
        stretch.state.name.lower(),
        stretch.blindness.name.lower(),
        stretch.view,
        stretch.moved_px,
        stretch.right_px,
        stretch.down_px,
        stretch.sway_px,
        stretch.found_s,
    )


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(RecorderNode, args)


if __name__ == "__main__":
    sys.exit(main())
