"""Node `camera`: a video, a network camera, images in a folder or a scene become a topic."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from sensor_msgs.msg import CompressedImage

from geoorbit_ros.core.addresses import read_password, with_password
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.image_sender import ImageSender
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import stream_qos
from geoorbit_ros.rendering.frame_source import SCENES
from geoorbit_ros.storage.frames.feed import FrameFeed
from geoorbit_ros.storage.frames.open_source import open_frame_source
from geoorbit_ros.storage.frames.source import START_NS, FrameSourceError, SourceOptions

OWN_START = -1.0
"""Value of `start_time_s` for the time that the file says."""
WATCH_S = 0.1
"""Between two looks at the threads. Chosen: larger, a start or an end is noticed later."""
SILENT_S = 3.0
"""A camera without a frame for this long is reported on /diagnostics. Chosen: larger, a stopped
camera is reported later; smaller, one frame in seconds counts as stopped."""
ACKNOWLEDGE_TIMEOUT = Duration(seconds=5)
"""At the end of a recording, for readers to take its last images. Chosen: larger, a reader that has
stopped holds up the end; smaller, one that is slow loses images."""


@dataclass(frozen=True, slots=True)
class CameraParameters:
    """See params/camera.yaml."""

    source: str
    password_file: str
    password_variable: str
    fps: float
    start_time_s: float
    rate: float
    loop: bool
    max_fps: float
    jpeg_quality: int
    frame_id: str
    open_timeout_s: float
    stall_timeout_s: float
    buffer_frames: int
    reliability: str
    queue_depth: int
    wait_for_subscribers: int
    wait_timeout_s: float
    exit_when_done: bool


class CameraNode(GeoOrbitNode[CameraParameters]):
    """Publishes `image/compressed`.

    One thread reads the source, another one encodes and publishes, so that neither a slow reader
    nor a busy executor holds up the camera. A stream that is lost is opened again, without end.

    Attributes:
        finished: Whether a recording has been published to its end.

    Raises:
        GeoOrbitError: A parameter or a recording can't be used.
    """

    name = "camera"
    struct = CameraParameters

    def setup(self) -> None:
        """Open the source and make the topic."""
        p = self.p
        self.finished = self._started = False
        options = SourceOptions(
            fps=p.fps or None,
            start_ns=START_NS if p.start_time_s == OWN_START else round(1e9 * p.start_time_s),
            own_start=p.start_time_s == OWN_START,
            open_timeout_s=p.open_timeout_s,
            stall_timeout_s=p.stall_timeout_s,
            give_up_s=None,
            clock_ns=lambda: int(self.get_clock().now().nanoseconds),
            report=self.get_logger().info,
            on_bad_frame=self.diagnostics.refuse,
            on_cut=self.diagnostics.refuse,
        )
        self._source = open_frame_source(self._address(), options, SCENES)
        self._said = 0
        self._say_remarks()
        clock_ns = None if p.start_time_s else options.clock_ns
        self._feed = FrameFeed(
            self._source, rate=p.rate, loop=p.loop, depth=p.buffer_frames, clock_ns=clock_ns
        )
        self.on_parameters(p)
        qos = stream_qos(p.reliability, p.queue_depth)
        self.images = self.create_publisher(CompressedImage, "image/compressed", qos)
        frame_id = p.frame_id or f"{self.camera_id or 'camera'}_optical_frame"
        self._sender = ImageSender(self, self.images, self._feed, frame_id, p.jpeg_quality)
        self._deadline_s = time.monotonic() + (0.0 if self._source.live else p.wait_timeout_s)
        self.diagnostics.add_check(self._silent)
        self.create_timer(WATCH_S, self._watch, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_parameters(self, changed: CameraParameters) -> None:
        """A new limit of the frame rate holds from the next frame on."""
        self._feed.thinning.max_fps = changed.max_fps

    def diagnostic_values(self) -> Mapping[str, object]:
        """What became of the frames."""
        return {
            "source": self._source.name,
            "captured": self._feed.captured,
            "dropped": self._feed.dropped,
            "left_out": self._feed.thinning.left_out,
            "reconnects": self._source.reconnects,
            "remarks": "; ".join(self._source.remarks.sentences()),
            "subscribers": self.images.get_subscription_count(),
        }

    def close(self) -> None:
        """End both threads; one that is inside a system call ends with it."""
        self._feed.stop()
        self._sender.stop()
        if not self.finished or self.told_to_end:
            return
        if not self.images.wait_for_all_acked(ACKNOWLEDGE_TIMEOUT):
            self.get_logger().warning("the last images were not acknowledged within 5 s")

    def _address(self) -> str:
        """The source with its password, wherever that is."""
        p, place = self.p, f"node '{self.get_fully_qualified_name()}', password"
        if p.password_file:
            return with_password(p.source, read_password(Path(p.password_file), place), place)
        if p.password_variable:
            password = os.environ.get(p.password_variable)
            if not password:
                found = f"no environment variable {p.password_variable}"
                raise ParameterError(place, found, "one with the password")
            return with_password(p.source, password, place)
        return p.source

    def _say_remarks(self) -> None:
        """Log what has been remarked on the source since the last time."""
        sentences = list(self._source.remarks.sentences())
        for sentence in sentences[self._said :]:
            self.get_logger().warning(f"{self._source.name}: {sentence}")
        self._said = len(sentences)

    def _silent(self) -> str | None:
        silent_s = self._sender.silent_s
        fault = f"{self._source.name}: no frame for {silent_s:.0f} s"
        return None if self.finished or silent_s < SILENT_S else fault

    def _watch(self) -> None:
        if not self._started:
            lonely = self.images.get_subscription_count() < self.p.wait_for_subscribers
            if lonely and time.monotonic() < self._deadline_s:
                return
            if lonely and not self._source.live:
                self.get_logger().warning(f"{self.images.topic}: starting without subscribers")
            self._started = True
            self._feed.start()
            self._sender.start()
        elif not self.finished and self._sender.ended:
            error = self._feed.error or self._sender.error
            if isinstance(error, FrameSourceError):
                self.diagnostics.refuse(error)
            elif error is not None:
                raise error
            self._say_remarks()
            self.get_logger().info(f"{self._source.name}: end of the recording")
            self.finished, self.done = True, self.p.exit_when_done


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(CameraNode, args)


if __name__ == "__main__":
    sys.exit(main())
