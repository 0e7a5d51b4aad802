"""Reads a source in a thread of its own, so that a camera never waits for the frames to be used."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator

from geoorbit_ros.storage.frames.source import FrameSource, StampedImage

_MAX_LATE_S = 1.0
"""After a longer hold-up (a suspended process), time goes on from there without a burst. Chosen:
shorter loses time on a busy machine, longer sends larger bursts."""
_MAX_WAIT_S = 5.0
"""Longer silences in a recording are cut to this. Chosen: long enough for a gap in the traffic."""
_EARLY_RATIO = 0.25
"""Share of the period by which a frame may come early, so that jitter drops none at full rate.
Chosen: larger lets frames come unevenly."""


class Pace:
    """Lets the stamps of a recording pass at a multiple of real time.

    Args:
        rate: Speed relative to the recording; 0 makes every frame due at once.

    Attributes:
        anchors: How often time began anew: at the first frame, and after hold-ups and silences;
            once, and before that frame, when all are due at once.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self.anchors = int(rate == 0.0)
        self._anchor: tuple[int, float] | None = None

    def wait_s(self, stamp_ns: int, wall_s: float) -> float:
        """Time from `wall_s` (of any steady clock) until the frame is due; 0 when it is.

        The first frame is due when it is asked about.
        """
        if self._rate == 0.0:
            return 0.0
        if self._anchor is None:
            self._anchor = stamp_ns, wall_s
            self.anchors += 1
        first_ns, start_s = self._anchor
        wait_s = start_s + (stamp_ns - first_ns) / 1e9 / self._rate - wall_s
        if not -_MAX_LATE_S <= wait_s <= _MAX_WAIT_S:
            wait_s = min(max(wait_s, 0.0), _MAX_WAIT_S)
            self._anchor = stamp_ns, wall_s + wait_s
            self.anchors += 1
        return max(wait_s, 0.0)


class Thinning:
    """Keeps at most so many frames per second of their own time, evenly.

    Attributes:
        max_fps: Frames per second; 0 keeps all. May be changed at any time.
        left_out: Frames not kept so far.
    """

    def __init__(self, max_fps: float) -> None:
        self.max_fps = max_fps
        self.left_out = 0
        self._due_ns: float | None = None

    def keep(self, stamp_ns: int) -> bool:
        """Whether to use the frame; call it once for each."""
        if self.max_fps == 0.0:
            return True
        period_ns = 1e9 / self.max_fps
        due_ns = self._due_ns
        if due_ns is None or not stamp_ns - period_ns < due_ns < stamp_ns + 2 * period_ns:
            due_ns = float(stamp_ns)  # the first one, after a gap, or after a step of the clock
        if stamp_ns < due_ns - _EARLY_RATIO * period_ns:
            self.left_out += 1
            return False
        self._due_ns = due_ns + period_ns
        return True


STOP_TIMEOUT_S = 2.0
"""How long `stop` waits for a source that is inside a system call. Its thread is a daemon: it ends
with the call, or with the process. Chosen: longer holds up the end of the node."""


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
        dropped: Frames dropped because they were not taken in time.
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
        except Exception as error:  # kept for the caller, who asks for it
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
            first, self._anchors = not self._anchors, self._pace.anchors
            shift_ns = self._clock_ns() + round(1e9 * wait_s) - stamp_ns
            # Stamps never go back: those of a recording that is played faster run ahead.
            self._shift_ns = shift_ns if first else max(shift_ns, self._shift_ns)
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


TAKE_TIMEOUT_S = 0.2
"""Time between two looks whether the source was closed. Chosen: longer ends later."""


class LiveFrames(FrameSource):
    """Frames of a stream, stamped when they arrive, not when they are taken.

    What comes while the caller is busy is left out, all but the newest few. A second iteration goes
    on where the first stopped: the stream is opened once.

    Args:
        source: A live source, which this closes.

    Raises:
        FrameSourceError: As the source, while iterating.
    """

    live = True

    def __init__(self, source: FrameSource) -> None:
        super().__init__(source.name)
        self.fps, self.remarks = source.fps, source.remarks
        self._feed = FrameFeed(source)
        self._started = False

    @property
    def left_out(self) -> int:
        """Frames for which there was no time."""
        return self._feed.dropped

    def __iter__(self) -> Iterator[StampedImage]:
        """Stamps and images as they are taken, until the source ends or is closed."""
        if not self._started:
            self._started = True
            self._feed.start()
        while not (self._feed.finished or self._closed.is_set()):
            if (frame := self._feed.take(TAKE_TIMEOUT_S)) is not None:
                yield frame
        if self._feed.error is not None and not self._closed.is_set():
            raise self._feed.error

    def close(self) -> None:
        """End the reading."""
        super().close()
        if self._started:
            self._feed.stop()
