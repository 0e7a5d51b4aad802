"""Topic `<camera>/twin/side_by_side/compressed`: what the camera saw, the twin, the difference."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from sensor_msgs.msg import CompressedImage, PointCloud2

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.conversions import decode_table, encode_jpeg
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE
from geoorbit_ros.mapcheck.alignment import Alignment
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import stream_qos
from geoorbit_ros.storage.image_cdr import decode_compressed_image
from geoorbit_ros.twin.cameras import CameraView
from geoorbit_ros.twin.placement import TwinStep, track_rows
from geoorbit_ros.twin.side_by_side import TwinCamera

QUALITY = 80
"""Of the JPEGs. Chosen: larger, more bytes; smaller, thin lines and letters blur."""


class SideBySide:
    """Makes an image now and then, in a thread of its own: no frame of the twin waits for it.

    While one is made, the next ones are left out.

    Args:
        node: Subscribes `<camera>/image/compressed` and `<camera>/tracks_px`, and publishes.
        network: The network's file.
        datum: Origin of the twin's map frame.
        views: Of the cameras whose calibrations are known.
        period_s: Time between two images, by the stamps of the twin; 0 makes none.
        alignments: What each camera's tracks are moved by.

    Attributes:
        published: Images so far.
    """

    def __init__(
        self,
        node: GeoOrbitNode[Any],
        network: str,
        datum: Datum,
        views: Mapping[str, CameraView],
        period_s: float,
        alignments: Mapping[str, Alignment],
    ) -> None:
        self._node, self._network, self._datum, self._views = node, network, datum, views
        self._period_ns, self._alignments = round(period_s * 1e9), alignments
        self._due_ns, self.published = 0, 0
        self._cameras: dict[str, TwinCamera] = {}
        self._image: dict[str, bytes] = {}
        self._boxes: dict[str, NDArray[np.void]] = {}
        self._publishers: dict[str, Publisher] = {}
        self._worker = ThreadPoolExecutor(1, "side_by_side")
        self._work: Future[None] | None = None
        qos = stream_qos("best_effort", 1)
        for camera in views if period_s > 0.0 else ():
            on_image = partial(self._on_image, camera)
            on_boxes = partial(self._on_boxes, camera)
            image_topic = f"{camera}/image/compressed"
            node.create_subscription(CompressedImage, image_topic, on_image, qos, raw=True)
            node.create_subscription(PointCloud2, f"{camera}/tracks_px", on_boxes, qos, raw=True)
            topic = f"{camera}/twin/side_by_side/compressed"
            self._publishers[camera] = node.create_publisher(CompressedImage, topic, qos)

    def add(self, step: TwinStep) -> None:
        """Take one step of the twin."""
        if not self._publishers or 0 <= self._due_ns - step.stamp_ns <= self._period_ns:
            return
        if self._work is not None:
            if not self._work.done():
                return
            error = self._work.exception()
            if isinstance(error, GeoOrbitError):
                self._node.diagnostics.refuse(error)
            elif error is not None:
                raise error
        self._due_ns = step.stamp_ns + self._period_ns
        self._work = self._worker.submit(
            self._make, step.stamp_ns, track_rows(step), dict(self._image), dict(self._boxes)
        )

    def close(self) -> None:
        """Finish the image that is being made."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _on_image(self, camera: str, cdr: bytes) -> None:
        self._image[camera] = cdr

    def _on_boxes(self, camera: str, cdr: bytes) -> None:
        place = self._node.resolve_topic_name(f"{camera}/tracks_px")
        try:
            self._boxes[camera] = decode_table(cdr, PIXEL_TRACK_DTYPE, place)[2]
        except GeoOrbitError as error:
            self._node.diagnostics.refuse(error)

    def _make(
        self,
        stamp_ns: int,
        rows: NDArray[np.void],
        images: Mapping[str, bytes],
        boxes: Mapping[str, NDArray[np.void]],
    ) -> None:
        for camera, publisher in self._publishers.items():
            view = self._views[camera]
            if camera not in self._cameras:
                self._cameras[camera] = TwinCamera(
                    view.homography, view.image_size, self._network, view.datum
                )
            image, _ = self._cameras[camera].beside(
                self._decoded(camera, images),
                boxes.get(camera),
                rows,
                self._datum,
                self._alignments.get(camera),
            )
            publisher.publish(encode_jpeg(stamp_ns, f"{camera}_optical", image, QUALITY))
            self.published += 1

    def _decoded(self, camera: str, images: Mapping[str, bytes]) -> NDArray[np.uint8] | None:
        """The camera's latest image; None where there is none that can be used."""
        if camera not in images:
            return None
        place = self._node.resolve_topic_name(f"{camera}/image/compressed")
        try:
            return decode_compressed_image(images[camera], place)[2]
        except GeoOrbitError as error:
            self._node.diagnostics.refuse(error)
            return None
