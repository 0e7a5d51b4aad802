"""Reads a source in a thread of its own, so that a camera never waits for whoever takes frames."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator

from geoorbit_ros.storage.frames.pace import Pace, Thinning
from geoorbit_ros.storage.frames.source import FrameSource, StampedImage

STOP_TIMEOUT_S = 2.0
"""How long `stop` waits for a source that is inside a system call. Its thread is a daemon: it ends
with the call, or with the process."""


class FrameFeed:
    """Frames of a source, the newest few of them.

    Frames come at the pace of the camera, or of the recording times `rate`. When more than `depth`
    wait to be taken, the oldest is dropped and counted. With `rate` 0 a recording waits instead.

    Args:
        source: The source, which the feed closes.
        rate: Speed relative to the recording; live sources have their own.
        loop: Start a recording again at its end; its stamps go on.
        max_fps: Frames per second at most, 0 for all.
        depth: Frames that may wait to be taken.
        clock_ns: A recording's frames are stamped with the times at which they are due by this
            clock, as a camera's are; None: they keep their own.

    Attributes:
        captured: Frames read so far.
        dropped: Frames dropped because nobody took them in time.
        thinning: Counts what `max_fps` leaves out.
        error: What ended the reading, if it was not the end of the recording.
    """

    def __init__(
        self,
        source: FrameSource,
        *,
        rate: float = 1.0,
        loop: bool = False,
        max_fps: float = 0.0,
        depth: int = 3,
        clock_ns: Callable[[], int] | None = None,
    ) -> None:
        self.captured = self.dropped = 0
        self.thinning = Thinning(max_fps)
        self.error: Exception | None = None
        self._source, self._loop, self._depth = source, loop and not source.live, depth
        self._pace = Pace(0.0 if source.live else rate)
        self._clock_ns = None if source.live else clock_ns
        self._anchors = self._shift_ns = 0
        self._lossless = rate == 0.0 and not source.live
        self._waiting: deque[StampedImage] = deque()
        self._changed = threading.Condition()
        self._stopping = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    @property
    def finished(self) -> bool:
        """Whether no frame waits and none will come."""
        with self._changed:
            return self._ended and not self._waiting

    def take(self, timeout_s: float) -> StampedImage | None:
        """The oldest frame that waits; None when none has come in time, or none will."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._ended, timeout_s)
            if not self._waiting:
                return None
            frame = self._waiting.popleft()
            self._changed.notify_all()
            return frame

    def stop(self) -> bool:
        """End the reading; whether its thread has ended."""
        self._stopping.set()
        self._source.close()
        with self._changed:
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(STOP_TIMEOUT_S)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            for stamp_ns, image in self._frames():
                self.captured += 1
                if self._wanted(stamp_ns):
                    self._put((stamp_ns + self._shift_ns, image))
                if self._stopping.is_set():
                    break
        except Exception as error:  # handed to whoever watches the feed
            self.error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _frames(self) -> Iterator[StampedImage]:
        """Frames of the source; of a loop with stamps that go on."""
        offset_ns = 0
        while True:
            stamps: list[int] = []  # first, last but one, last
            for stamp_ns, image in self._source:
                stamps = [*stamps[:1], *stamps[-1:], stamp_ns]
                yield stamp_ns + offset_ns, image
            if not self._loop or len(stamps) < 2 or self._stopping.is_set():
                return
            offset_ns += 2 * stamps[-1] - stamps[-2] - stamps[0]

    def _wanted(self, stamp_ns: int) -> bool:
        """Wait until the frame is due; False when it isn't wanted."""
        if not self.thinning.keep(stamp_ns):
            return False
        wait_s = self._pace.wait_s(stamp_ns, time.monotonic())
        if self._clock_ns and self._pace.anchors != self._anchors:
            self._anchors = self._pace.anchors
            self._shift_ns = self._clock_ns() + round(1e9 * wait_s) - stamp_ns
        return not (wait_s > 0.0 and self._stopping.wait(wait_s))

    def _put(self, frame: StampedImage) -> None:
        with self._changed:
            if self._lossless:
                self._changed.wait_for(
                    lambda: len(self._waiting) < self._depth or self._stopping.is_set()
                )
            elif len(self._waiting) >= self._depth:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(frame)
            self._changed.notify_all()
