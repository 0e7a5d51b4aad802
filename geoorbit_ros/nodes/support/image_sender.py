"""A thread that publishes the frames of a feed as compressed images."""

from __future__ import annotations

import threading
import time
from typing import Any

from rclpy.publisher import Publisher

from geoorbit_ros.conversions import encode_jpeg
from geoorbit_ros.core.errors import MessageError
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.storage.frames.feed import STOP_TIMEOUT_S, FrameFeed
from geoorbit_ros.storage.frames.source import Image

TAKE_TIMEOUT_S = 0.2
"""How long the sender waits for a frame before it looks whether it should end. Chosen: larger, the
node ends later; smaller, an idle camera wakes the processor more often."""


class ImageSender:
    """Takes frames from a feed as long as there are any.

    Encoding does not hold Python's lock, so a camera costs the nodes beside it little.

    Args:
        node: Publishes, and counts in its diagnostics.
        publisher: Of CompressedImage.
        feed: Where the frames come from.
        frame_id: Optical frame of the camera.
        jpeg_quality: 1 to 100.

    Attributes:
        error: What ended the sending, if it was not the end of the feed.
    """

    def __init__(
        self,
        node: GeoOrbitNode[Any],
        publisher: Publisher,
        feed: FrameFeed,
        frame_id: str,
        jpeg_quality: int,
    ) -> None:
        self.error: Exception | None = None
        self._node, self._publisher, self._feed = node, publisher, feed
        self._frame_id, self._jpeg_quality = frame_id, jpeg_quality
        self._seen_s = time.monotonic()
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
        start_s = time.perf_counter()
        cdr = encode_jpeg(stamp_ns, self._frame_id, image, self._jpeg_quality)
        try:
            self._node.publish_stream(self._publisher, cdr)
        except MessageError as error:
            self._node.diagnostics.refuse(error)
        self._node.diagnostics.took(time.perf_counter() - start_s)
