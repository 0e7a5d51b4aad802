"""Node `sumo_bridge`: the tracks of all cameras move the vehicles of a SUMO simulation."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import NavSatFix

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.conversions import datum_from_fix
from geoorbit_ros.core.errors import MessageError, ParameterError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.nodes.base import GeoOrbitNode
from geoorbit_ros.nodes.latched import LATCHED
from geoorbit_ros.nodes.process import run_node
from geoorbit_ros.nodes.reference_publisher import publish_references
from geoorbit_ros.nodes.table_stream import TableStream, stream_qos
from geoorbit_ros.nodes.twin_publisher import TwinPublisher
from geoorbit_ros.twin.cameras import read_views, split_names
from geoorbit_ros.twin.network import load_network
from geoorbit_ros.twin.references import reference_lanes
from geoorbit_ros.twin.runner import TwinRunner
from geoorbit_ros.twin.simulation import SumoSimulation, backend_of


@dataclass(frozen=True, slots=True)
class SumoBridgeParameters:
    """See params/sumo_bridge.yaml."""

    network: str
    cameras: str
    calibrations: str
    image_width: int
    image_height: int
    datum_latitude_deg: float
    datum_longitude_deg: float
    step_s: float
    hold_s: float
    backend: str
    gui: bool
    publish_clock: bool
    health_period_s: float
    frame_id: str
    reliability: str
    queue_depth: int
    restart_jump_s: float


class SumoBridgeNode(GeoOrbitNode[SumoBridgeParameters]):
    """Subscribes `<camera>/tracks` and `<camera>/datum`; publishes the twin on `twin/…`.

    `twin/vehicles`, `twin/tracks` (the same with ids, sizes and classes), `twin/datum`,
    `twin/health`, and for each camera the network's lanes on `<camera>/reference/lane_<k>/…`.

    Raises:
        GeoOrbitError: A parameter, the network or a calibration can't be used, or SUMO doesn't
            start.
    """

    name = "sumo_bridge"
    struct = SumoBridgeParameters

    def setup(self) -> None:
        """Load the network, start the simulation, publish the references."""
        p = self.p
        place = f"node '{self.get_fully_qualified_name()}', parameter "
        cameras = split_names(p.cameras, f"{place}'cameras'")
        size = (p.image_width, p.image_height)
        views = read_views(cameras, p.calibrations, size, f"{place}'calibrations'")
        network = load_network(p.network, self._datum(place))
        self._references = []
        for view in views:
            lanes = reference_lanes(load_network(p.network, view.datum), view.polygon_m)
            self._references += publish_references(self, view.name, p.frame_id, lanes)
        backend = backend_of(p.backend, p.gui)
        start = partial(SumoSimulation, Path(p.network), p.step_s, backend=backend, gui=p.gui)
        qos = stream_qos(p.reliability, p.queue_depth)
        self.twin = TwinPublisher(
            self, network.datum, p.frame_id, qos, p.health_period_s, clock=p.publish_clock
        )
        self.runner = TwinRunner(network, start, cameras, p.step_s, p.hold_s, self.twin.publish)
        self.known: dict[str, Datum] = {}
        for camera in cameras:
            datum_topic = self.resolve_topic_name(f"{camera}/datum")
            on_datum, on_frame = (
                partial(method, camera, datum_topic) for method in (self._on_datum, self._on_frame)
            )
            on_restart = partial(self.runner.restart, camera)
            TableStream(self, f"{camera}/tracks", TRACK_DTYPE, p, on_frame, on_restart)
            self.create_subscription(NavSatFix, datum_topic, on_datum, LATCHED)

    def diagnostic_values(self) -> Mapping[str, object]:
        """Size and speed of the twin, and what happened to tracks."""
        latest, twin = self.twin.latest, self.runner.twin
        return {
            "vehicles": len(twin.fleet.slots),
            "steps": twin.steps,
            "steps_per_s": f"{latest.steps_per_s:.0f}" if latest else "",
            "error_m_p95": f"{latest.position_error_m_p95:.3f}" if latest else "",
            "other_lane_share": f"{latest.lane_error_share:.4f}" if latest else "",
            "vehicles_lost": twin.placement.lost,
            "simulation_restarts": self.runner.restarts,
            **asdict(twin.fusion.counts),
        }

    def close(self) -> None:
        """End the simulation."""
        if hasattr(self, "runner"):
            self.runner.close()

    def _datum(self, place: str) -> Datum | None:
        given = (self.p.datum_latitude_deg, self.p.datum_longitude_deg)
        if all(math.isnan(value) for value in given):
            return None
        if any(math.isnan(value) for value in given):
            raise ParameterError(
                f"{place}datum_…_deg", "one of them", "both latitude and longitude, or neither"
            )
        return Datum(*given)

    def _on_datum(self, camera: str, place: str, fix: NavSatFix) -> None:
        try:
            self.known[camera] = datum_from_fix(fix, place)
        except MessageError as error:
            self.diagnostics.refuse(error)
            return
        self.runner.set_datum(camera, self.known[camera])

    def _on_frame(self, camera: str, place: str, stamp_ns: int, rows: NDArray[np.void]) -> None:
        self.twin.arrived_s = time.perf_counter()
        if camera not in self.known:
            raise MessageError(place, "tracks before it", "where the tracks' map frame lies")
        self.runner.add(camera, stamp_ns, rows)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(SumoBridgeNode, args)


if __name__ == "__main__":
    sys.exit(main())
