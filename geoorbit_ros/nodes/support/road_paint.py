"""The road without vehicles, from the node that sees the images to the one that knows the lanes."""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Float64MultiArray

from geoorbit_ros.calibration.plane import RoadPlane
from geoorbit_ros.conversions import encode_png, plane_of
from geoorbit_ros.core.errors import MessageError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.markings.fusion import RoadPaint
from geoorbit_ros.markings.road_image import SPACING_S, RoadBackground
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import LATCHED, LOOKS
from geoorbit_ros.nodes.support.view_listener import listen_to_views
from geoorbit_ros.storage.image_cdr import decode_compressed_image
from geoorbit_ros.view.compensation import ViewMotions, image_in_reference
from geoorbit_ros.view.looks import ViewLook

TOPIC, PLANE_TOPIC = "road_image/compressed", "road_plane"
FIRST_S = 30.0
"""Time of the first background: 15 images. Chosen: earlier, vehicles are left in it."""


class RoadImagePublisher:
    """Publishes the median of the latest images now and then, latched.

    Args:
        node: Publishes.
        period_s: Data time between two of them.
    """

    def __init__(self, node: GeoOrbitNode[Any], period_s: float) -> None:
        self._node, self._period_s = node, period_s
        self._publisher = node.create_publisher(CompressedImage, TOPIC, LATCHED)
        self._due_s = min(FIRST_S, period_s)
        self._work: threading.Thread | None = None
        self.published = 0
        self._looks: deque[ViewLook] = deque(maxlen=LOOKS.depth)
        self._motions: ViewMotions | None = None
        listen_to_views(node, self._looks.append)
        self.restart()

    def restart(self) -> None:
        """Forget the images: the camera starts again, or shows another view."""
        self._background = RoadBackground()
        self._begin_ns: int | None = None
        self._last_ns = 0

    def add(self, stamp_ns: int, frame_id: str, image: NDArray[np.uint8]) -> None:
        """Take one image; every `period_s` the median is made in a thread of its own.

        Where the view is watched, the image is laid on the reference view first; one that does not
        show it is left out.
        """
        if self._begin_ns is None:
            self._begin_ns = stamp_ns
        elif stamp_ns - self._last_ns < SPACING_S * 1e9:
            return
        self._last_ns = stamp_ns
        shown = self._in_reference(stamp_ns, image)
        if shown is not None:
            self._background.add(shown)
        if stamp_ns - self._begin_ns < self._due_s * 1e9:
            return
        if self._work is not None and self._work.is_alive():
            return
        background, self._due_s = self._background, self._period_s
        self.restart()
        arguments = (stamp_ns, frame_id, background)
        self._work = threading.Thread(target=self._publish, args=arguments, name="road image")
        self._work.start()

    def _in_reference(self, stamp_ns: int, image: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
        """The image as the reference view shows it; None where it does not show that view."""
        if self._motions is None:
            self._motions = ViewMotions((image.shape[1], image.shape[0]))
        while self._looks:
            self._motions.add(self._looks.popleft())
        return image_in_reference(image, self._motions.at(stamp_ns))

    def close(self) -> None:
        """Wait until the one that is being made is out: tenths of a second."""
        if self._work is not None:
            self._work.join()

    def _publish(self, stamp_ns: int, frame_id: str, background: RoadBackground) -> None:
        image = background.image()
        if image is not None:
            self._node.publish_stream(self._publisher, encode_png(stamp_ns, frame_id, image))
            self.published += 1


class PaintListener:
    """Topics `road_plane` and `road_image/compressed` move lane boundaries to painted lines.

    Args:
        node: Subscribes, and is told about messages that can't be used.

    Attributes:
        sentence: What came of the last map.
    """

    def __init__(self, node: GeoOrbitNode[Any]) -> None:
        self._node = node
        self._plane: tuple[RoadPlane, tuple[int, int]] | None = None
        self._image: NDArray[np.uint8] | None = None
        self._paint: RoadPaint | None = None
        self._place = node.resolve_topic_name(PLANE_TOPIC)
        self._images = node.resolve_topic_name(TOPIC)
        self.images = 0
        node.create_subscription(Float64MultiArray, PLANE_TOPIC, self._on_plane, LATCHED)
        node.create_subscription(CompressedImage, TOPIC, self._on_image, LATCHED, raw=True)

    @property
    def plane(self) -> RoadPlane | None:
        """The camera's road plane, once it has come."""
        return None if self._plane is None else self._plane[0]

    @property
    def sentence(self) -> str:
        """What came of the last map, or what is missing."""
        if self._image is None:
            return "no image of the road yet: boundaries are where the traffic has them"
        if self._plane is None:
            return f"{self._place}: nothing received yet"
        return self._paint.sentence if self._paint else "not looked at yet"

    def follow(self, lane_map: LaneMap, *, anew: bool) -> LaneMap:
        """The map with boundaries on the lines, as it is where there is no image.

        Args:
            lane_map: Lanes by the traffic.
            anew: See `RoadPaint.follow`; a new image is always looked at anew.
        """
        if self._image is None or self._plane is None or not lane_map.lanes:
            return lane_map
        if self._paint is None:
            self._paint = RoadPaint(self._image, *self._plane)
            anew = True
        return self._paint.follow(lane_map, anew=anew)

    def _on_plane(self, message: Float64MultiArray) -> None:
        try:
            self._plane, self._paint = plane_of(message, self._place), None
        except MessageError as error:
            self._node.diagnostics.refuse(error)

    def _on_image(self, cdr: bytes) -> None:
        try:
            self._image, self._paint = decode_compressed_image(cdr, self._images)[2], None
            self.images += 1
        except MessageError as error:
            self._node.diagnostics.refuse(error)
