"""A camera's lens from its topic `camera_info`, for nodes that have control points."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo

from geoorbit_ros.calibration.camera_info import behind_lens, lens_of, whole_images
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.core.errors import GeoOrbitError

INFO_TOPIC = "camera_info"
AFTER_STAMP = 12
"""Bytes of a serialised message before what follows its stamp."""


class LensListener:
    """Takes the lens of the first message, where no file says it; tells when it is another one.

    Args:
        node: Subscribes and logs.
        points: The control points as they are.
        calibrate: Called with the points behind the lens.

    Attributes:
        remarks: What was done with the latest message that differs from the one before.
    """

    def __init__(
        self,
        node: Node,
        points: Callable[[], ControlPoints],
        calibrate: Callable[[ControlPoints], None],
    ) -> None:
        self.remarks: list[str] = []
        self._node, self._points, self._calibrate = node, points, calibrate
        self._info = b""
        node.create_subscription(
            CameraInfo, INFO_TOPIC, self._on_message, qos_profile_sensor_data, raw=True
        )

    def _on_message(self, cdr: bytes) -> None:
        if cdr[AFTER_STAMP:] == self._info:  # as with every image before
            return
        self._info, self.remarks = cdr[AFTER_STAMP:], []
        try:
            self._take(deserialize_message(cdr, CameraInfo))
        except (GeoOrbitError, RuntimeError) as error:
            self.remarks = [f"not used: {error}"]
        for sentence in self.remarks:
            self._node.get_logger().warning(sentence)

    def _take(self, info: CameraInfo) -> None:
        if not (info.width and info.height and info.k[0]):  # a camera that isn't calibrated
            return
        place = self._node.resolve_topic_name(INFO_TOPIC)
        size = (info.width, info.height)
        part = info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height
        whole_images(size, part, place)
        lens = lens_of(size, info.k.tolist(), info.distortion_model, info.d.tolist(), place)
        points = self._points()
        before = len(points.report.remarks)
        behind = behind_lens(points, lens, place)
        if behind is not points:
            self._calibrate(behind)
        found = points.report.remarks[before:]
        self.remarks = [r.sentence(len(points), "control points") for r in found]
