"""Encodes and publishes frames in a thread of its own."""

from __future__ import annotations

import threading
import time
from typing import Any

import cv2
from rclpy.publisher import Publisher

from geoorbit_ros.conversions import encode_compressed_image
from geoorbit_ros.core.errors import MessageError
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.storage.frames.feed import STOP_TIMEOUT_S, FrameFeed
from geoorbit_ros.storage.frames.source import Image

FORMAT = "bgr8; jpeg compressed bgr8"
"""As compressed_image_transport writes it."""
TAKE_TIMEOUT_S = 0.2


class ImageSender:
    """Takes frames from a feed as long as there are any.

    OpenCV encodes without holding Python's lock, so a camera costs the nodes beside it little.

    Args:
        node: Whose parameters and diagnostics to use.
        publisher: Of CompressedImage.
        feed: Where the frames come from.
        frame_id: Optical frame of the camera.

    Attributes:
        error: What ended the sending, if it was not the end of the feed.
    """

    def __init__(
        self, node: GeoOrbitNode[Any], publisher: Publisher, feed: FrameFeed, frame_id: str
    ) -> None:
        self.error: Exception | None = None
        self._node, self._publisher, self._feed = node, publisher, feed
        self._frame_id, self._seen_s = frame_id, time.monotonic()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="publish", daemon=True)

    def start(self) -> None:
        """Begin to send."""
        self._seen_s = time.monotonic()
        self._thread.start()

    def stop(self) -> None:
        """End the thread; one that waits for a reader ends with that."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(STOP_TIMEOUT_S)

    @property
    def ended(self) -> bool:
        """Whether a thread that was started has ended."""
        return not self._thread.is_alive()

    @property
    def silent_s(self) -> float:
        """Time since the last frame, or since the start."""
        return time.monotonic() - self._seen_s

    def _run(self) -> None:
        try:
            while not (self._stopping.is_set() or self._feed.finished):
                frame = self._feed.take(TAKE_TIMEOUT_S)
                if frame is not None:
                    self._seen_s = time.monotonic()
                    self._send(*frame)
        except Exception as error:  # for the node, which watches this thread
            self.error = error

    def _send(self, stamp_ns: int, image: Image) -> None:
        start_s, parameters = time.perf_counter(), self._node.p
        quality = (cv2.IMWRITE_JPEG_QUALITY, parameters.jpeg_quality)
        _, jpeg = cv2.imencode(".jpg", image, quality)
        cdr = encode_compressed_image(stamp_ns, self._frame_id, FORMAT, jpeg.tobytes())
        try:
            self._node.publish_stream(self._publisher, cdr)
        except MessageError as error:
            self._node.diagnostics.refuse(error)
        self._node.diagnostics.took(time.perf_counter() - start_s)
