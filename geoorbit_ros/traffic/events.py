"""Events on the road, told while they last: what a control room wants to hear of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.traffic.event_records import EventLog
from geoorbit_ros.traffic.lane_flow import LaneFlow
from geoorbit_ros.traffic.moments import MomentCollector
from geoorbit_ros.traffic.queues import QueueWatch
from geoorbit_ros.traffic.standing import StandingWatch
from geoorbit_ros.traffic.watched_tracks import WatchedTracks
from geoorbit_ros.traffic.wrong_way import WrongWayWatch


class EventWatch:
    """Watches ground tracks for stopped and wrong-way vehicles, queues, unused lanes, speed drops.

    Only times of frames count, and frames without rows are watched time too: outages are no events.
    The same frames give the same rows, bit by bit, however they are handed over.

    Args:
        lanes: The lanes of the map, in the tracks' frame; at least one.
        log: Goes on with the numbers of an earlier watch; default: from 1.
    """

    def __init__(self, lanes: Sequence[Lane], log: EventLog | None = None) -> None:
        self._log = log or EventLog()
        self._moments = MomentCollector(lanes)
        self._tracks = WatchedTracks()
        self._flow = LaneFlow(self._log)
        self._standing = StandingWatch(self._log, self._flow)
        self._queues = QueueWatch(self._log)
        self._wrong_way = WrongWayWatch(self._log)
        self.use_lanes(lanes)

    def use_lanes(self, lanes: Sequence[Lane]) -> None:
        """Watch these lanes from the half second on that is not complete.

        What is known of a lane goes on under its id.
        """
        self._moments.use_lanes(lanes)
        self._tracks.forget_lanes()
        self._flow.use_lanes(lanes)
        self._standing.use_lanes(lanes, self._moments.place)
        self._queues.use_lanes(lanes)
        self._wrong_way.use_lanes(lanes)

    def add(self, frames: Frames) -> None:
        """Take frames of `TRACK_DTYPE`, later than those before.

        Raises:
            TableError: Rows of another kind, or earlier frames.
        """
        for tick, stamp_ns, moments in self._moments.add(frames):
            self._tracks.take(tick, moments)
            now = self._tracks.now
            self._flow.take(stamp_ns, now)
            self._standing.take(stamp_ns, self._tracks, self._moments.place)
            self._queues.take(stamp_ns, now)
            self._wrong_way.take(stamp_ns, now)

    def take(self) -> NDArray[np.void]:
        """(E,) `EVENT_DTYPE`: what began, changed or ended since the last call."""
        return self._log.take()

    @property
    def rows(self) -> int:
        """How many rows there were so far."""
        return self._log.rows

    @property
    def lasting(self) -> NDArray[np.void]:
        """(E,) `EVENT_DTYPE`: the newest row of each event that has not ended."""
        return self._log.lasting
