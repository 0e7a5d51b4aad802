"""Holds the lanes of running cameras against the network, beside the simulation."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.lanes.geojson import parse_lane_file
from geoorbit_ros.mapcheck.alignment import Alignment
from geoorbit_ros.mapcheck.driven_lanes import DrivenLane, DrivenNetwork, as_driven, merged
from geoorbit_ros.mapcheck.validation import Validation, validate
from geoorbit_ros.roadnet.network import RoadNetwork

STEADY_M = 0.15
"""What is in use stays while something new differs by less: vehicles are not to tremble."""

Checked = Validation | GeoOrbitError
_Looked = tuple[int, Validation, DrivenNetwork | None]


class MapWatch:
    """Validates lane maps as they come, in a thread of its own: one takes up to 0.3 s.

    Args:
        network: The network, in the twin's map frame.
        period_s: By the stamps of the lane maps, no camera's is looked at more often.

    Attributes:
        validations: The last of each camera.
        alignments: Those in use, by camera; a camera that fits the map has none.
        driven: The network's lanes where they are driven, as all cameras see them; None until a
            camera finds one out of place.
    """

    def __init__(self, network: RoadNetwork, period_s: float) -> None:
        self._network, self._period_ns = network, round(period_s * 1e9)
        self._worker = ThreadPoolExecutor(1, "map_watch")
        self._waiting: dict[str, str] = {}
        self._running: tuple[str, Future[_Looked | None]] | None = None
        self._stamp_ns: dict[str, int] = {}
        self.validations: dict[str, Validation] = {}
        self.alignments: dict[str, Alignment] = {}
        self.driven: DrivenNetwork | None = None
        self._followed: Mapping[str, DrivenLane] = {}

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
        try:
            done = job.result()
        except GeoOrbitError as error:
            self._start()
            return [(camera, error)]
        if done is not None:
            self._stamp_ns[camera], self.validations[camera], driven = done
            self.driven = driven or self.driven
        self._start()
        return [] if done is None else [(camera, done[1])]

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

    def _look(self, camera: str, text: str) -> _Looked | None:
        file = parse_lane_file(text, f"lanes of '{camera}'", self._network.datum)
        stamp_ns, last_ns = file.lane_map.stamp_ns, self._stamp_ns.get(camera)
        if last_ns is not None and 0 <= stamp_ns - last_ns < self._period_ns:
            return None
        if not file.lane_map.confirmed:
            return None
        found = validate(file.lane_map.lanes, self._network)
        return stamp_ns, found, self._newly_driven(camera, found)

    def _newly_driven(self, camera: str, found: Validation) -> DrivenNetwork | None:
        """Where lanes are driven with what one camera has just found; None for as before."""
        known = self.validations | {camera: found}
        driven = merged(known[name].discrepancies.driven for name in sorted(known))
        before = self._followed
        if driven.keys() == before.keys() and all(
            abs(lane.middle_m - before[name].middle_m) < STEADY_M for name, lane in driven.items()
        ):
            return None
        self._followed = driven
        return as_driven(self._network, driven)
