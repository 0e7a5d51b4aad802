"""A stream that is read in time, however long the work on a frame takes."""

from __future__ import annotations

from collections.abc import Iterator

from geoorbit_ros.storage.frames.feed import FrameFeed
from geoorbit_ros.storage.frames.source import FrameSource, StampedImage

TAKE_TIMEOUT_S = 0.2


class LiveFrames(FrameSource):
    """Frames of a stream, stamped when they arrive, not when somebody has time for them.

    What comes while its taker is busy is left out, all but the newest few. Whoever iterates again
    goes on where the last one stopped: the stream is opened once.

    Args:
        source: A live source, which this closes.

    Raises:
        FrameSourceError: As the source, while iterating.
    """

    live = True

    def __init__(self, source: FrameSource) -> None:
        super().__init__(source.name)
        self.fps = source.fps
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
