"""Holds the lanes of running cameras against the network, beside the simulation."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.lanes.geojson import parse_lane_file
from geoorbit_ros.twin.alignment import Alignment
from geoorbit_ros.twin.network import RoadNetwork
from geoorbit_ros.twin.validation import Validation, validate

STEADY_M = 0.15
"""An alignment in use stays while a new one differs by less: vehicles are not to tremble."""

Checked = Validation | GeoOrbitError


class MapWatch:
    """Validates lane maps as they come, in a thread of its own: one takes up to 0.3 s.

    Args:
        network: The network, in the twin's map frame.
        period_s: By the stamps of the lane maps, no camera's is looked at more often.

    Attributes:
        validations: The last of each camera.
        alignments: Those in use, by camera; a camera that fits the map has none.
    """

    def __init__(self, network: RoadNetwork, period_s: float) -> None:
        self._network, self._period_ns = network, round(period_s * 1e9)
        self._worker = ThreadPoolExecutor(1, "map_watch")
        self._waiting: dict[str, str] = {}
        self._running: tuple[str, Future[tuple[int, Validation] | None]] | None = None
        self._stamp_ns: dict[str, int] = {}
        self.validations: dict[str, Validation] = {}
        self.alignments: dict[str, Alignment] = {}

    def offer(self, camera: str, text: str) -> None:
        """A camera's lane map as GeoJSON; of several that wait only the newest is looked at."""
        self._waiting[camera] = text
        self._start()

    def collect(self) -> list[tuple[str, Checked]]:
        """What has been found since the last call, by camera."""
        if self._running is None or not self._running[1].done():
            return []
        camera, job = self._running
        self._running = None
        self._start()
        try:
            done = job.result()
        except GeoOrbitError as error:
            return [(camera, error)]
        if done is None:
            return []
        self._stamp_ns[camera], self.validations[camera] = done
        return [(camera, done[1])]

    def realigned(self, camera: str) -> Alignment | None:
        """The alignment to use from now on, None when it stays as it is."""
        new, old = self.validations[camera].alignment.applied, self.alignments.get(camera)
        centre = new.centre_m[None, :]
        before = centre if old is None else old.points(centre)
        if float(np.hypot(*(new.points(centre) - before)[0])) < STEADY_M:
            return None
        self.alignments[camera] = new
        return new

    def close(self) -> None:
        """Wait for what is being looked at, no longer than that takes."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _start(self) -> None:
        if self._running is None and self._waiting:
            camera = next(iter(self._waiting))
            text = self._waiting.pop(camera)
            self._running = (camera, self._worker.submit(self._look, camera, text))

    def _look(self, camera: str, text: str) -> tuple[int, Validation] | None:
        file = parse_lane_file(text, f"lanes of '{camera}'", self._network.datum)
        stamp_ns, last_ns = file.lane_map.stamp_ns, self._stamp_ns.get(camera)
        if last_ns is not None and 0 <= stamp_ns - last_ns < self._period_ns:
            return None
        if not file.lane_map.confirmed:
            return None
        return stamp_ns, validate(file.lane_map.lanes, self._network)
