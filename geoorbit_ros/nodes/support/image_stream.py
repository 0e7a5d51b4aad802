"""Images of two topics, in the order of their stamps, worked on in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, Image

from geoorbit_ros.core.errors import GeoOrbitError, MessageError
from geoorbit_ros.core.frame_order import Arrival, FrameOrder, order_fault
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import stream_qos
from geoorbit_ros.nodes.support.table_stream import StreamParameters
from geoorbit_ros.storage.image_cdr import StampedPicture, decode_compressed_image, decode_image

LOSSLESS_DEPTH = 4
"""Messages held here when none may be lost; DDS holds the rest, and then the publisher waits."""
STOP_TIMEOUT_S = 10.0
"""For the image that is being worked on when the node ends. Chosen: longer than any model takes for
one image on a slow machine."""
_WAIT_S = 0.2
"""Between two looks whether the thread should end. Chosen: larger, it ends later."""

Decoder = Callable[[bytes, str], StampedPicture]
OnImage = Callable[[int, str, NDArray[np.uint8]], None]


class ImageStream:
    """Two subscriptions, `image/compressed` and `image`, and one thread that decodes and works.

    The executor stays free: parameters and diagnostics answer while a model runs.

    Args:
        node: Subscribes, and counts in its diagnostics.
        parameters: Quality of service, and what counts as a restart.
        on_image: Takes stamp, frame id and image of each frame in order, in the thread; may
            raise GeoOrbitError to refuse.
        on_restart: Called before the first image of a source that started again.

    Attributes:
        received: Frames that came.
        dropped: Of those, frames that newer ones replaced while the thread was busy.
        error: What ended the thread, if anything did.
    """

    def __init__(
        self,
        node: GeoOrbitNode[Any],
        parameters: StreamParameters,
        on_image: OnImage,
        on_restart: Callable[[], None],
    ) -> None:
        self.received = self.dropped = 0
        self.error: Exception | None = None
        self._node, self._on_image, self._on_restart = node, on_image, on_restart
        self._order = FrameOrder[tuple[str, NDArray[np.uint8], str]](parameters.restart_jump_s)
        self._lossless = parameters.queue_depth == 0
        self._depth = parameters.queue_depth or LOSSLESS_DEPTH
        self._waiting: deque[tuple[bytes, Decoder, str]] = deque()
        self._change = threading.Condition()
        self._stopping = False
        self._size: tuple[int, int] | None = None
        qos = stream_qos(parameters.reliability, parameters.queue_depth)
        for topic, kind, decoder in (
            ("image/compressed", CompressedImage, decode_compressed_image),
            ("image", Image, decode_image),
        ):
            place = node.resolve_topic_name(topic)
            take = partial(self._receive, decoder, place)
            node.create_subscription(kind, topic, take, qos, raw=True)
        self._thread = threading.Thread(target=self._run, name="images", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread after the image it is at."""
        with self._change:
            self._stopping = True
            self._change.notify_all()
        self._thread.join(STOP_TIMEOUT_S)

    def _receive(self, decoder: Decoder, place: str, cdr: bytes) -> None:
        with self._change:
            while self._lossless and len(self._waiting) >= self._depth and self._alive():
                self._change.wait(_WAIT_S)
            if len(self._waiting) >= self._depth:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append((cdr, decoder, place))
            self.received += 1
            self._change.notify_all()

    def _alive(self) -> bool:
        return not self._stopping and self.error is None

    def _run(self) -> None:
        try:
            while True:
                with self._change:
                    while not self._waiting and not self._stopping:
                        self._change.wait(_WAIT_S)
                    if self._stopping:
                        return
                    message = self._waiting.popleft()
                    self._change.notify_all()
                self._work(*message)
        except Exception as error:  # for the node, which watches this thread
            self.error = error

    def _work(self, cdr: bytes, decoder: Decoder, place: str) -> None:
        start_s, diagnostics = time.perf_counter(), self._node.diagnostics
        try:
            stamp_ns, frame_id, image = decoder(cdr, place)
            last_ns = self._order.last_ns
            for arrival, stamp, frame in self._order.take(stamp_ns, (frame_id, image, place)):
                self._pass_on(arrival, stamp, frame, last_ns)
        except GeoOrbitError as error:
            diagnostics.refuse(error)
        diagnostics.missing = max(self._order.missing - self.dropped, 0)
        diagnostics.took(time.perf_counter() - start_s)

    def _pass_on(
        self,
        arrival: Arrival,
        stamp_ns: int,
        frame: tuple[str, NDArray[np.uint8], str],
        last_ns: int | None,
    ) -> None:
        frame_id, image, place = frame
        try:
            if fault := order_fault(arrival, stamp_ns, last_ns, place):
                raise fault
            if arrival is Arrival.RESTART and last_ns is not None:
                jump = f"time went back by {(last_ns - stamp_ns) / 1e9:.1f} s, starting anew"
                self._node.get_logger().info(f"{place}: {jump}")
                self._on_restart()
            self._check_size(image, place)
            self._on_image(stamp_ns, frame_id, image)
            self._node.diagnostics.handled(stamp_ns)
        except GeoOrbitError as error:
            self._node.diagnostics.refuse(error)

    def _check_size(self, image: NDArray[np.uint8], place: str) -> None:
        """Control points are pixels of one size: other boxes would lie elsewhere on the road."""
        size = (image.shape[1], image.shape[0])
        self._size = self._size or size
        if size != self._size:
            found = f"an image of {size[0]}x{size[1]} pixels"
            raise MessageError(place, found, f"{self._size[0]}x{self._size[1]} as before")
