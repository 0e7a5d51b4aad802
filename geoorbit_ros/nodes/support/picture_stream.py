"""Images of two topics for who looks at a few of them: the rest are not even decoded."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage, Image

from geoorbit_ros.core.cdr import stamp_of
from geoorbit_ros.core.errors import GeoOrbitError, MessageError
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.storage.image_cdr import decode_compressed_image, decode_image, decode_reduced
from geoorbit_ros.view.picture import Grey, picture_of, reduction

STOP_TIMEOUT_S = 10.0
"""For the picture that is being looked at when the node ends: longer than any look takes."""
HEAD_BYTES = 12
"""Of a message: encapsulation and stamp. What follows is the same where the image is."""
_WAIT_S = 0.2
"""Between two looks whether the thread should end. Chosen: larger, it ends later."""
OnPicture = Callable[[int, str, Grey, tuple[int, int]], None]


class PictureStream:
    """Two subscriptions, `image/compressed` and `image`, and one thread that looks.

    While the thread is busy, only the newest image waits.

    Args:
        node: Subscribes, and counts in its diagnostics.
        qos: Quality of service.
        on_bytes: Takes stamp and bytes of every image.
        due: Whether an image of a stamp should be looked at.
        on_picture: Takes stamp, frame id, picture and size of the image, in the thread.

    Attributes:
        received: Images that came.
        error: What ended the thread, if anything did.
    """

    def __init__(
        self,
        node: GeoOrbitNode[Any],
        qos: QoSProfile,
        on_bytes: Callable[[int, bytes | memoryview], None],
        due: Callable[[int], bool],
        on_picture: OnPicture,
    ) -> None:
        self.received = 0
        self.error: Exception | None = None
        self._node, self._on_bytes, self._due = node, on_bytes, due
        self._on_picture = on_picture
        self._waiting: tuple[bytes, bool, str] | None = None
        self._change = threading.Condition()
        self._stopping = False
        self._size: tuple[int, int] | None = None
        for topic, kind in (("image/compressed", CompressedImage), ("image", Image)):
            place = node.resolve_topic_name(topic)
            take = partial(self._receive, kind is CompressedImage, place)
            node.create_subscription(kind, topic, take, qos, raw=True)
        self._thread = threading.Thread(target=self._run, name="pictures", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread after the picture it is at."""
        with self._change:
            self._stopping = True
            self._change.notify_all()
        self._thread.join(STOP_TIMEOUT_S)

    def _receive(self, compressed: bool, place: str, cdr: bytes) -> None:
        self.received += 1
        start_s = time.perf_counter()
        if len(cdr) < HEAD_BYTES:
            found = f"{len(cdr)} bytes"
            self._node.diagnostics.refuse(MessageError(place, found, "an image with its stamp"))
            return
        stamp_ns = stamp_of(cdr)
        self._on_bytes(stamp_ns, memoryview(cdr)[HEAD_BYTES:])
        if self._due(stamp_ns):
            with self._change:
                self._waiting = (cdr, compressed, place)
                self._change.notify_all()
        self._node.diagnostics.took(time.perf_counter() - start_s)

    def _run(self) -> None:
        try:
            while True:
                with self._change:
                    while self._waiting is None and not self._stopping:
                        self._change.wait(_WAIT_S)
                    if self._stopping or self._waiting is None:
                        return
                    message, self._waiting = self._waiting, None
                self._work(*message)
        except Exception as error:  # for the node, which watches this thread
            self.error = error

    def _work(self, cdr: bytes, compressed: bool, place: str) -> None:
        try:
            stamp_ns, frame_id, picture = self._picture(cdr, compressed, place)
            assert self._size is not None
            self._on_picture(stamp_ns, frame_id, picture, self._size)
            self._node.diagnostics.handled(stamp_ns)
        except GeoOrbitError as error:
            self._node.diagnostics.refuse(error)

    def _picture(self, cdr: bytes, compressed: bool, place: str) -> tuple[int, str, Grey]:
        """Stamp, frame id and picture; a JPEG is reduced while it is decoded."""
        if compressed and self._size is not None:
            step = reduction(self._size[0])
            reduced = decode_reduced(cdr, place, self._size, step)
            if reduced is not None:
                stamp_ns, frame_id, grey = reduced
                return stamp_ns, frame_id, picture_of(grey, 1)
        decode = decode_compressed_image if compressed else decode_image
        stamp_ns, frame_id, image = decode(cdr, place)
        self._size = (image.shape[1], image.shape[0])
        return stamp_ns, frame_id, picture_of(image, reduction(image.shape[1]))
