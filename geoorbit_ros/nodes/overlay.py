"""Node `overlay`: the camera's images with boxes, trails and lanes drawn into them, for people."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.subscription import Subscription
from sensor_msgs.msg import CompressedImage, PointCloud2
from std_msgs.msg import String

from geoorbit_ros.calibration.camera_info import read_calibration
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import Homography, fit_homography, plane_of_images
from geoorbit_ros.conversions import decode_string, decode_table, encode_jpeg
from geoorbit_ros.core.cdr import stamp_of
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE
from geoorbit_ros.lanes.geojson import parse_lane_file
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED, stream_qos
from geoorbit_ros.report.image_overlay import ImageOverlay
from geoorbit_ros.storage.image_cdr import decode_compressed_image

LOOK_S = 0.5
"""Between two looks for viewers. Chosen: larger, the first image comes later."""


@dataclass(frozen=True, slots=True)
class OverlayParameters:
    """See params/overlay.yaml."""

    calibration_file: str
    camera_info_file: str
    jpeg_quality: int
    waiting_images: int
    reliability: str
    queue_depth: int


class OverlayNode(GeoOrbitNode[OverlayParameters]):
    """Publishes `image/annotated/compressed`, and reads and draws only while it has a viewer.

    Subscribes `image/compressed`, `tracks_px` and `lanes/geojson`. An image is drawn when the
    tracks of its stamp come.

    Raises:
        GeoOrbitError: A parameter or the calibration file can't be used.
    """

    name = "overlay"
    struct = OverlayParameters
    optional = True

    def setup(self) -> None:
        """Make the topic, and wait for a viewer."""
        p = self.p
        self._datum: Datum | None = None
        self._overlay = ImageOverlay(None)
        self._plane: Homography | None = None
        if p.calibration_file:
            self._calibrate(None)
        self._qos = stream_qos(p.reliability, p.queue_depth)
        topic = "image/annotated/compressed"
        self._shown = self.create_publisher(CompressedImage, topic, self._qos)
        self._readers: list[Subscription] = []
        self._images: dict[int, bytes] = {}
        self._lanes: LaneMap | None = None
        self.create_timer(LOOK_S, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def diagnostic_values(self) -> Mapping[str, object]:
        """How many viewers there are."""
        return {"viewers": self._shown.get_subscription_count(), "waiting": len(self._images)}

    def _calibrate(self, datum: Datum | None) -> None:
        """Read the control points; those in metres need the lanes' datum."""
        points = read_calibration(self.p.calibration_file, self.p.camera_info_file, datum)
        self._datum = points.datum
        self._plane = fit_homography(points)
        self._overlay = ImageOverlay(self._plane)

    def _in_size_of(self, image: NDArray[np.uint8]) -> None:
        """Take the plane for images of this size, where the control points are of another."""
        if self._plane is not None:
            size = (image.shape[1], image.shape[0])
            plane = plane_of_images(self._plane, size)
            if plane is not self._plane:
                self._plane, self._overlay = plane, ImageOverlay(plane)

    def _look(self) -> None:
        """Subscribe when the first viewer comes, unsubscribe when the last one goes."""
        watched = self._shown.get_subscription_count() > 0
        if watched and not self._readers:
            for kind, topic, take, qos in (
                (CompressedImage, "image/compressed", self._on_image, self._qos),
                (PointCloud2, "tracks_px", self._on_tracks, self._qos),
                (String, "lanes/geojson", self._on_lanes, LATCHED),
            ):
                self._readers.append(self.create_subscription(kind, topic, take, qos, raw=True))
        elif not watched:
            while self._readers:
                self.destroy_subscription(self._readers.pop())
            self._images.clear()

    def _on_image(self, cdr: bytes) -> None:
        self._images[stamp_of(cdr)] = cdr
        while len(self._images) > self.p.waiting_images:
            del self._images[next(iter(self._images))]

    def _on_lanes(self, cdr: bytes) -> None:
        try:
            place = self.resolve_topic_name("lanes/geojson")
            found = parse_lane_file(decode_string(cdr, place), place, self._datum)
            if self._datum is None and self.p.calibration_file:
                self._calibrate(found.datum)
            self._lanes = found.lane_map
        except GeoOrbitError as error:
            self.diagnostics.refuse(error)

    def _on_tracks(self, cdr: bytes) -> None:
        start_s = time.perf_counter()
        try:
            place = self.resolve_topic_name("tracks_px")
            stamp_ns, _, tracks = decode_table(cdr, PIXEL_TRACK_DTYPE, place)
            if (image_cdr := self._images.pop(stamp_ns, None)) is None:
                return
            place = self.resolve_topic_name("image/compressed")
            _, frame_id, image = decode_compressed_image(image_cdr, place)
            self._in_size_of(image)
            caption = self._caption(len(tracks))
            drawn = self._overlay.draw(image, tracks, None, self._lanes, caption)
            shown = encode_jpeg(stamp_ns, frame_id, drawn, self.p.jpeg_quality)
            self.publish_stream(self._shown, shown)
            self.diagnostics.handled(stamp_ns)
        except GeoOrbitError as error:
            self.diagnostics.refuse(error)
        self.diagnostics.took(time.perf_counter() - start_s)

    def _caption(self, vehicles: int) -> str:
        lanes = len(self._lanes.confirmed) if self._lanes else 0
        return f"{self.camera_id}   {vehicles} vehicles   {lanes} lanes"


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(OverlayNode, args)


if __name__ == "__main__":
    sys.exit(main())
