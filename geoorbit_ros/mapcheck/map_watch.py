"""What the cameras' lanes change in the twin: where tracks are laid, where lanes are driven.

`MapCheck` decides it, for `geoorbit twin replay` and for the node `sumo_bridge`; `MapWatch` runs
the checks of the node in a thread beside the simulation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.lanes.geojson import parse_lane_file
from geoorbit_ros.mapcheck.alignment import Alignment
from geoorbit_ros.mapcheck.driven_lanes import DrivenLane, DrivenNetwork, as_driven, merged
from geoorbit_ros.mapcheck.validation import Validation, validate
from geoorbit_ros.roadnet.network import RoadNetwork

STEADY_M = 0.15
"""An alignment or a driven lane is kept until a new one differs by this. Chosen: larger follows the
cameras later; smaller moves vehicles of the running twin sideways with every check."""

Checked = Validation | GeoOrbitError


@dataclass(frozen=True, slots=True)
class MapCheck:
    """What the lanes of all cameras say about a network. `with_lanes` adds those of a camera.

    Attributes:
        network: The network, in the twin's map frame.
        steady_m: What is in use stays while something new differs by less.
        validations: The last one of each camera.
        alignments: Lay cameras' tracks on the network, by camera; a camera that fits has none.
        driven: The network with its lanes where they are driven; None until a camera finds a lane
            out of place.
    """

    network: RoadNetwork
    steady_m: float = 0.0
    validations: Mapping[str, Validation] = field(default_factory=lambda: MappingProxyType({}))
    alignments: Mapping[str, Alignment] = field(default_factory=lambda: MappingProxyType({}))
    driven: DrivenNetwork | None = None
    _driven_lanes: Mapping[str, DrivenLane] = field(default_factory=lambda: MappingProxyType({}))

    def with_lanes(self, camera: str, lanes: Sequence[Lane]) -> MapCheck:
        """The same after a camera's lanes have been compared with the network.

        Args:
            camera: Its name; its earlier lanes no longer count.
            lanes: In the network's map frame.

        Raises:
            NoTrafficError: No confirmed lane.
            RoadNetworkError: The network lies elsewhere.
        """
        found = validate(lanes, self.network)
        validations = {**self.validations, camera: found}
        alignments, new = dict(self.alignments), found.alignment.applied
        if _moves_by(new, alignments.get(camera)) >= max(self.steady_m, 1e-9):
            alignments[camera] = new
        lanes_now = merged(validations[name].discrepancies.driven for name in sorted(validations))
        before, driven = self._driven_lanes, self.driven
        if lanes_now.keys() != before.keys() or any(
            abs(lane.middle_m - before[name].middle_m) >= self.steady_m
            for name, lane in lanes_now.items()
        ):
            before, driven = lanes_now, as_driven(self.network, lanes_now)
        return replace(
            self,
            validations=validations,
            alignments=alignments,
            driven=driven,
            _driven_lanes=before,
        )


def _moves_by(new: Alignment, old: Alignment | None) -> float:
    """Metres between where two alignments lay the middle of the lanes."""
    centre = new.centre_m[None, :]
    before = centre if old is None else old.points(centre)
    return float(np.hypot(*(new.points(centre) - before)[0]))


_Done = tuple[int, MapCheck]


class MapWatch:
    """Checks lane maps as they come, in a thread of its own: one check takes up to 0.3 s.

    Args:
        network: The network, in the twin's map frame.
        period_s: Least time between two checks of a camera's lanes, by the maps' stamps.

    Attributes:
        check: The state after the checks collected so far.
        alignments: Those in use, by camera; a camera that fits the map has none.
    """

    def __init__(self, network: RoadNetwork, period_s: float) -> None:
        self._network, self._period_ns = network, round(period_s * 1e9)
        self._worker = ThreadPoolExecutor(1, "map_watch")
        self._waiting: dict[str, str] = {}
        self._running: tuple[str, Future[_Done | None]] | None = None
        self._stamp_ns: dict[str, int] = {}
        self.check = MapCheck(network, STEADY_M)
        self.alignments: dict[str, Alignment] = {}

    @property
    def validations(self) -> Mapping[str, Validation]:
        """The last validation of each camera."""
        return self.check.validations

    @property
    def driven(self) -> DrivenNetwork | None:
        """The network with its lanes where they are driven; see `MapCheck`."""
        return self.check.driven

    def offer(self, camera: str, text: str) -> None:
        """Take a camera's lane map as GeoJSON; of several that wait only the newest is checked."""
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
            self._stamp_ns[camera], self.check = done
        self._start()
        return [] if done is None else [(camera, self.validations[camera])]

    def realigned(self, camera: str) -> Alignment | None:
        """The alignment to use from now on; None where it stays as it is."""
        new = self.check.alignments.get(camera)
        if new is None or new is self.alignments.get(camera):
            return None
        self.alignments[camera] = new
        return new

    def close(self) -> None:
        """Wait for the check that runs; those that wait are dropped."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _start(self) -> None:
        if self._running is None and self._waiting:
            camera = next(iter(self._waiting))
            text = self._waiting.pop(camera)
            self._running = (camera, self._worker.submit(self._checked, camera, text))

    def _checked(self, camera: str, text: str) -> _Done | None:
        """The map's stamp and the state after it; None where it comes too early or is empty."""
        file = parse_lane_file(text, f"lanes of '{camera}'", self._network.datum)
        stamp_ns, last_ns = file.lane_map.stamp_ns, self._stamp_ns.get(camera)
        if last_ns is not None and 0 <= stamp_ns - last_ns < self._period_ns:
            return None
        if not file.lane_map.confirmed:
            return None
        return stamp_ns, self.check.with_lanes(camera, file.lane_map.lanes)
