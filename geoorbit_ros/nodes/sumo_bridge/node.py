"""Node `sumo_bridge`: the tracks of all cameras move the vehicles of a SUMO simulation."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import NavSatFix

from geoorbit_ros.calibration.datum import given_datum
from geoorbit_ros.conversions import datum_from_fix
from geoorbit_ros.core.errors import GeoOrbitError, MessageError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.nodes.sumo_bridge.forecaster import Forecaster
from geoorbit_ros.nodes.sumo_bridge.map_validator import MapValidator
from geoorbit_ros.nodes.sumo_bridge.reference_publisher import ReferencePublisher
from geoorbit_ros.nodes.sumo_bridge.side_by_side import SideBySide
from geoorbit_ros.nodes.sumo_bridge.twin_publisher import TwinPublisher
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED, stream_qos
from geoorbit_ros.nodes.support.table_stream import TableStream
from geoorbit_ros.roadnet.network import load_network
from geoorbit_ros.twin.cameras import read_views, split_names
from geoorbit_ros.twin.placement import TwinStep
from geoorbit_ros.twin.runner import TwinRunner
from geoorbit_ros.twin.sumo_simulation import SumoSimulation, backend_of


@dataclass(frozen=True, slots=True)
class SumoBridgeParameters:
    """See params/sumo_bridge.yaml."""

    network: str
    cameras: str
    calibrations: str
    image_sizes: str
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
    map_check_period_s: float
    align: bool
    closed_lanes: str
    speed_limits: str
    forecast_minutes: float
    forecast_window_s: float
    forecast_limit_s: float
    side_by_side_period_s: float


class SumoBridgeNode(GeoOrbitNode[SumoBridgeParameters]):
    """Subscribes `<camera>/tracks` and `<camera>/datum`; publishes the twin on `twin/…`.

    `twin/vehicles`, `twin/tracks` (the same with ids, sizes and classes), `twin/datum`,
    `twin/health`, and for each camera whose datum has come the network's lanes in its view on
    `<camera>/reference/lane_<k>/…`. Cameras' lanes are compared with the network (`MapValidator`).

    Raises:
        GeoOrbitError: A parameter, the network or a calibration can't be used, or SUMO doesn't
            start.
    """

    name = "sumo_bridge"
    struct = SumoBridgeParameters

    def setup(self) -> None:
        """Load the network and start the simulation."""
        p = self.p
        place = f"node '{self.get_fully_qualified_name()}'"
        cameras = split_names(p.cameras, f"{place}, parameter 'cameras'")
        views = read_views(cameras, p.calibrations, p.image_sizes, f"{place}, parameter ")
        self._references = ReferencePublisher(self, p.network, views, p.frame_id)
        datum = given_datum(p.datum_latitude_deg, p.datum_longitude_deg, place)
        network = load_network(p.network, datum)
        backend = backend_of(p.backend, p.gui)
        start = partial(SumoSimulation, Path(p.network), p.step_s, backend=backend, gui=p.gui)
        qos = stream_qos(p.reliability, p.queue_depth)
        self.twin = TwinPublisher(
            self, network.datum, p.frame_id, qos, p.health_period_s, clock=p.publish_clock
        )
        self.forecaster = Forecaster(self, network, p.forecast_window_s)
        scenario = self.forecaster.changed(p)
        self.runner = TwinRunner(network, start, cameras, p.step_s, p.hold_s, self._on_step)
        self.runner.set_scenario(scenario)
        moves = (self.runner.set_alignment, self.runner.follow) if p.align else (None, None)
        period_s = p.map_check_period_s
        self.map = MapValidator(self, network, cameras, p.frame_id, period_s, *moves)
        self.known, self.unusable = self.map.datums, dict[str, GeoOrbitError]()
        aligned = self.map.watch.alignments if p.align else {}
        self.side_by_side = SideBySide(
            self, p.network, network.datum, views, p.side_by_side_period_s, aligned
        )
        for camera in cameras:
            datum_topic = self.resolve_topic_name(f"{camera}/datum")
            on_datum, on_frame = (
                partial(method, camera, datum_topic) for method in (self._on_datum, self._on_frame)
            )
            on_restart = partial(self.runner.restart, camera)
            TableStream(self, f"{camera}/tracks", TRACK_DTYPE, p, on_frame, on_restart)
            self.create_subscription(NavSatFix, datum_topic, on_datum, LATCHED)

    def on_parameters(self, changed: SumoBridgeParameters) -> None:
        """Close lanes and set limits; refused where the network has no such lane."""
        self.runner.set_scenario(self.forecaster.changed(changed))

    def diagnostic_values(self) -> Mapping[str, object]:
        """Size and speed of the twin, and what happened to tracks."""
        parts = (self.runner, self.twin, self.map, self.forecaster)
        return {name: value for part in parts for name, value in part.diagnostic_values().items()}

    def close(self) -> None:
        """End the simulation."""
        self.map.close()
        self.side_by_side.close()
        self.forecaster.close()
        self.runner.close()

    def _on_datum(self, camera: str, place: str, fix: NavSatFix) -> None:
        try:
            datum, before = datum_from_fix(fix, place), self.known.get(camera)
            self.runner.set_datum(camera, datum)
            self.known[camera] = datum
            if datum != before:
                self._references.refer(camera, datum)
        except GeoOrbitError as error:
            self.unusable[camera] = error
            self.diagnostics.refuse(error)

    def _on_step(self, step: TwinStep) -> None:
        self.twin.publish(step)
        self.forecaster.traffic.add(step)
        self.side_by_side.add(step)

    def _on_frame(self, camera: str, place: str, stamp_ns: int, rows: NDArray[np.void]) -> None:
        self.twin.arrived_s = time.perf_counter()
        if camera not in self.known:
            early = MessageError(place, "tracks before it", "where the tracks' map frame lies")
            raise self.unusable.get(camera, early)
        self.runner.add(camera, stamp_ns, rows)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(SumoBridgeNode, args)


if __name__ == "__main__":
    sys.exit(main())
