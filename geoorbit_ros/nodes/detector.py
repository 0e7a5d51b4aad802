"""Node `detector`: images become boxes of vehicles."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PolygonStamped
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2

from geoorbit_ros.conversions import encode_table, pixel_polygon
from geoorbit_ros.detection.detector import (
    Detector,
    DetectorSettings,
    doubt_of,
    make_detector,
    remarks_on,
)
from geoorbit_ros.detection.road_segments import Contour, RoadSegments
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.image_stream import ImageStream
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED, stream_qos
from geoorbit_ros.nodes.support.road_paint import RoadImagePublisher


@dataclass(frozen=True, slots=True)
class DetectorParameters:
    """See params/detector.yaml."""

    model: str
    class_names: str
    min_score: float
    max_iou: float
    any_class: bool
    providers: str
    threads: int
    only_on_road: bool
    road_image_period_s: float
    reliability: str
    queue_depth: int
    restart_jump_s: float


class DetectorNode(GeoOrbitNode[DetectorParameters]):
    """Subscribes `image/compressed` and `image`; publishes `detections`, one table per image.

    Where vehicles drive is learnt and published, latched, as `road_segments/segment_<k>` in pixels.
    The road without vehicles is published now and then, latched, as `road_image/compressed`.

    Attributes:
        detections: The publisher of tables.
        stream: Where the images come from.

    Raises:
        GeoOrbitError: A parameter or the model can't be used.
    """

    name = "detector"
    struct = DetectorParameters

    def setup(self) -> None:
        """Load the model, then start."""
        p = self.p
        self._detector = self._make()
        self.get_logger().info(f"vehicles are found by {self._detector.name}")
        self._segments: RoadSegments | None = None
        self._outlines: list[Publisher] = []
        self._drawn: tuple[Contour, ...] = ()
        self.detections = self.create_publisher(
            PointCloud2, "detections", stream_qos(p.reliability, p.queue_depth)
        )
        self._found = 0
        self._road = (
            RoadImagePublisher(self, p.road_image_period_s) if p.road_image_period_s else None
        )
        self.stream = ImageStream(self, p, self._on_image, self._on_restart)
        self.diagnostics.add_check(self._fault)
        self.diagnostics.add_check(lambda: doubt_of(self._detector) or None)

    def diagnostic_values(self) -> Mapping[str, object]:
        """What detects, and what became of images and boxes."""
        segments = self._segments
        return {
            "detector": self._detector.name,
            "boxes": self._found,
            "boxes_outside_road_segments": segments.outside if segments else 0,
            "road_segments": len(self._drawn),
            "dropped": self.stream.dropped,
            "road_images": self._road.published if self._road else 0,
            "detections_subscribers": self.detections.get_subscription_count(),
        }

    def close(self) -> None:
        """End the threads."""
        self.stream.stop()
        if self._road is not None:
            self._road.close()

    def _make(self) -> Detector:
        p = self.p
        settings = DetectorSettings(
            p.min_score,
            p.max_iou,
            p.any_class,
            _words(p.class_names),
            _words(p.providers),
            p.threads,
        )
        detector = make_detector(Path(p.model) if p.model else None, settings)
        for note in remarks_on(detector, settings):
            self.get_logger().warning(note)
        return detector

    def _on_image(self, stamp_ns: int, frame_id: str, image: NDArray[np.uint8]) -> None:
        rows = self._detector.detect(stamp_ns, image)
        if self._road is not None:
            self._road.add(stamp_ns, frame_id, image)
        if self._segments is None:
            self._segments = RoadSegments((image.shape[1], image.shape[0]))
        inside = self._segments.add(stamp_ns, rows)
        self._found += len(rows)
        kept = rows[inside] if self.p.only_on_road else rows
        self.publish_stream(self.detections, encode_table(stamp_ns, frame_id, kept))
        if self._segments.contours is not self._drawn:
            self._drawn = self._segments.contours
            self._publish_segments(stamp_ns, frame_id)

    def _publish_segments(self, stamp_ns: int, frame_id: str) -> None:
        """One latched polygon per segment; a segment that is gone becomes an empty one."""
        for k in range(len(self._outlines), len(self._drawn)):
            topic = f"road_segments/segment_{k}"
            self._outlines.append(self.create_publisher(PolygonStamped, topic, LATCHED))
        for k, publisher in enumerate(self._outlines):
            contour = self._drawn[k] if k < len(self._drawn) else None
            publisher.publish(pixel_polygon(stamp_ns, frame_id, contour))

    def _on_restart(self) -> None:
        """The road stays where it is, but stamps begin anew."""
        if self._road is not None:
            self._road.restart()

    def _fault(self) -> str | None:
        error = self.stream.error
        return f"stopped by a defect: {type(error).__name__}: {error}" if error else None


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(DetectorNode, args)


if __name__ == "__main__":
    sys.exit(main())
