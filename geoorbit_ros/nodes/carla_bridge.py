"""Node `carla_bridge`: the twin's vehicles in CARLA, and what roadside cameras see there."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, NavSatFix

from geoorbit_ros.conversions import datum_from_fix, encode_jpeg
from geoorbit_ros.core.errors import GeoOrbitError, MessageError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED, stream_qos
from geoorbit_ros.nodes.support.table_stream import TableStream
from geoorbit_ros.twin.cameras import read_carla_cameras, split_names
from geoorbit_ros.twin.carla.client import CarlaClient, CarlaVehicles
from geoorbit_ros.twin.carla.frame import read_opendrive


@dataclass(frozen=True, slots=True)
class CarlaBridgeParameters:
    """See params/carla_bridge.yaml."""

    opendrive: str
    host: str
    port: int
    timeout_s: float
    step_s: float
    cameras: str
    calibrations: str
    image_sizes: str
    jpeg_quality: int
    reliability: str
    queue_depth: int
    restart_jump_s: float


class CarlaBridgeNode(GeoOrbitNode[CarlaBridgeParameters]):
    """Subscribes `twin/tracks` and `twin/datum`; publishes `<camera>/carla/image/compressed`.

    Raises:
        CarlaError: No client library, no server, or one that refuses the road.
        GeoOrbitError: A file or a parameter can't be used.
    """

    name = "carla_bridge"
    struct = CarlaBridgeParameters

    def setup(self) -> None:
        """Load the road into the server and place the cameras."""
        p = self.p
        road, self._origin = read_opendrive(p.opendrive)
        place = f"node '{self.get_fully_qualified_name()}', parameter "
        names = split_names(p.cameras, f"{place}'cameras'") if p.cameras else []
        cameras = read_carla_cameras(names, p.calibrations, p.image_sizes, place, self._origin)
        self.server = CarlaClient(p.host, p.port, p.timeout_s, road, p.step_s)
        self.vehicles = CarlaVehicles(self.server)
        self._offset: NDArray[np.float64] | None = None
        self._stamp_ns, self._images = 0, 0
        qos = stream_qos(p.reliability, p.queue_depth)
        for camera in cameras:
            topic = f"{camera.name}/carla/image/compressed"
            publisher = self.create_publisher(CompressedImage, topic, qos)
            self.server.add_camera(camera, partial(self._on_image, publisher))
            if camera.left_out:
                self.get_logger().warning(camera.left_out)
        TableStream(self, "twin/tracks", TRACK_DTYPE, p, self._on_step, lambda: None)
        self.create_subscription(NavSatFix, "twin/datum", self._on_datum, LATCHED)

    def diagnostic_values(self) -> Mapping[str, object]:
        """Vehicles in CARLA, those without room, and images."""
        vehicles = self.vehicles
        return {
            "located": "no" if self._offset is None else "yes",
            "vehicles": len(vehicles.actors),
            "without_room": vehicles.refused,
            "images": self._images,
            "pictures": self._images,  # the old name, until 0.2
        }

    def close(self) -> None:
        """Leave the server as it was."""
        try:
            self.vehicles.close()
            self.server.close()
        except GeoOrbitError as error:
            self.get_logger().warning(str(error))

    def _on_datum(self, fix: NavSatFix) -> None:
        try:
            datum = datum_from_fix(fix, self.resolve_topic_name("twin/datum"))
        except MessageError as error:
            self.diagnostics.refuse(error)
            return
        self._offset = self._origin.to_local(datum.latitude_deg, datum.longitude_deg)[0]

    def _on_step(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        if self._offset is None:
            place = self.resolve_topic_name("twin/datum")
            raise MessageError(place, "tracks before it", "where the twin's map frame lies")
        self._stamp_ns = stamp_ns
        self.vehicles.update(rows, self._offset)

    def _on_image(
        self, publisher: object, name: str, time_s: float, image: NDArray[np.uint8]
    ) -> None:
        cdr = encode_jpeg(self._stamp_ns, f"{name}_optical", image, self.p.jpeg_quality)
        publisher.publish(cdr)  # type: ignore[attr-defined]  # an rclpy publisher
        self._images += 1


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(CarlaBridgeNode, args)


if __name__ == "__main__":
    sys.exit(main())
