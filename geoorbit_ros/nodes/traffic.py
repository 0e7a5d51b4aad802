"""Node `traffic`: vehicles per lane and interval, from the tracks of a camera."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from std_msgs.msg import String

from geoorbit_ros.conversions import decode_string
from geoorbit_ros.core.errors import GeoOrbitError, ParameterError
from geoorbit_ros.core.tables import TRACK_DTYPE, one_frame
from geoorbit_ros.core.wall_clock import RetentionClock
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.lane_reader import LaneReader
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED_ALL
from geoorbit_ros.nodes.support.table_stream import TableStream
from geoorbit_ros.nodes.support.traffic_publisher import TrafficPublisher
from geoorbit_ros.storage.database.traffic import TrafficDatabase
from geoorbit_ros.traffic.class_schemes import named_scheme
from geoorbit_ros.traffic.follower import STEP_BATCHES, TrafficFollower
from geoorbit_ros.traffic.interval_clock import NS, IntervalClock, checked_zone
from geoorbit_ros.traffic.lane_maps import MapShelf
from geoorbit_ros.traffic.live import LiveTraffic

STEP_PERIOD_S = 0.5
"""Between two looks into the database, in wall time, which changes no result. Chosen: as often as
the recorder commits."""


@dataclass(frozen=True, slots=True)
class TrafficParameters:
    """See params/traffic.yaml."""

    database: str
    camera_id: str
    interval_s: int
    timezone: str
    class_scheme: str
    calibration_file: str
    camera_info_file: str
    retention_days: float
    frame_id: str
    reliability: str
    queue_depth: int
    restart_jump_s: float


class TrafficNode(GeoOrbitNode[TrafficParameters]):
    """Publishes `traffic/{intervals,vehicles,crossings,events}` and two texts for people.

    With a database it counts the tracks that the recorder stores there, and stores intervals,
    vehicles and events beside them: after a restart it goes on with the first that is not stored.
    Without one it counts the topics `tracks` and `lanes/geojson`.
    """

    name = "traffic"
    struct = TrafficParameters
    optional = True

    def setup(self) -> None:
        """Find the place to go on, or subscribe."""
        p = self.p
        place = f"node '{self.get_fully_qualified_name()}', parameter"
        self._camera = p.camera_id or self.camera_id
        self._interval_clock = IntervalClock(
            p.interval_s, checked_zone(p.timezone, f"{place} 'timezone'")
        )
        self._scheme = named_scheme(p.class_scheme, f"{place} 'class_scheme'")
        self._follower: TrafficFollower | None = None
        self.published = TrafficPublisher(
            self, p.frame_id, self._camera, self._scheme, self._interval_clock
        )
        if p.database:
            if not self._camera:
                found = "nothing, in the root namespace"
                raise ParameterError(f"{place} 'camera_id'", found, "the camera's name")
            self._follow(Path(p.database))
        else:
            self._subscribe()

    def close(self) -> None:
        """Give the database up; intervals that are not finished are counted again later."""
        if self._follower is not None:
            self._database.close()

    def _reads_lanes(self, place: str) -> LaneReader:
        return LaneReader(self.p.calibration_file, place, self.p.camera_info_file)

    def diagnostic_values(self) -> Mapping[str, object]:
        """How far it is."""
        live = self._live if self._follower is None else self._follower.live
        used = live.map_in_use if live else None
        return {
            "intervals": self.published.intervals,
            "vehicles": self.published.vehicles,
            "events": self.published.events,
            "events_now": len(live.watch.lasting) if live and live.watch else 0,
            "lanes": len(used.lanes) if used else "not received yet",
            "map_stamp_s": used.map_ns / NS if used else "",
            "newest_s": live.newest_ns / NS if live and live.newest_ns else "",
            "unfinished_since_s": live.waits_since_ns / NS if used and live else "",
        }

    def _subscribe(self) -> None:
        self._shelf = MapShelf()
        self._restart()
        self._geojson_topic = self.resolve_topic_name("lanes/geojson")
        self._reader = self._reads_lanes(self._geojson_topic)
        TableStream(self, "tracks", TRACK_DTYPE, self.p, self._on_frame, self._restart)
        self.create_subscription(String, "lanes/geojson", self._on_lanes, LATCHED_ALL, raw=True)

    def _follow(self, path: Path) -> None:
        reader = self._reads_lanes(f"{path}, lane map of {self._camera}")
        self._database = TrafficDatabase(path)
        try:
            self._database.claim(self._camera, "traffic")
            newest_ns = self._database.newest_stored_ns(self._camera)
        except GeoOrbitError:
            self._database.close()
            raise
        self._retention = RetentionClock(self.p.retention_days, newest_ns)
        self.diagnostics.add_check(lambda: self._retention.doubt)
        self._follower = TrafficFollower(
            self._database,
            self._camera,
            self._scheme,
            self._interval_clock,
            reader.read,
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(STEP_PERIOD_S, self._step, clock=steady)

    def _restart(self) -> None:
        self._live = LiveTraffic(self._scheme, self._interval_clock, self._shelf.lanes_at)

    def _on_frame(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        self._live.add(one_frame(stamp_ns, rows))
        self._publish_new()

    def _on_lanes(self, cdr: bytes) -> None:
        try:
            text = decode_string(cdr, self._geojson_topic)
            self._shelf.put(self._reader.read(text))
            self._live.start()
            self._publish_new()
        except GeoOrbitError as error:
            self.diagnostics.refuse(error)

    def _publish_new(self) -> None:
        finished = self._live.finished()
        self.published.counts(self._live.gone(), finished)
        self.published.told(self._live, self._live.events())

    def _step(self) -> None:
        """Count what is stored; while more may wait, at every turn of the executor."""
        assert self._follower is not None
        try:
            told = self._follower.step(STEP_BATCHES)
            self.published.counts(told.counted, told.finished)
            self.diagnostics.received += told.batches
            live = self._follower.live
            if live is not None:
                self.published.told(live, told.events)
            if (before_ns := self._retention.cutoff_ns()) is not None:
                self._database.prune_traffic(self._camera, before_ns)
        except GeoOrbitError as error:  # a full disk may have room again later
            self.diagnostics.refuse(error)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(TrafficNode, args)


if __name__ == "__main__":
    sys.exit(main())
