"""What every source of images is: an iterable of capture times and images that can be closed."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import GeoOrbitError

Image = NDArray[np.uint8]
"""(height, width, 3), blue green red."""
StampedImage = tuple[int, Image]
"""Capture time in nanoseconds, and the image."""

START_NS = 1_000_000_000
"""Stamp of a recording's first frame when nobody says when it was made: zero means 'unset' in
ROS."""


class FrameSourceError(GeoOrbitError):
    """A video, stream, folder of images or scene that can't be used, or an image in it."""


def _raise(error: FrameSourceError) -> None:
    raise error


@dataclass(frozen=True, slots=True)
class SourceOptions:
    """How to open a source; each kind takes what concerns it.

    Attributes:
        fps: Frames per second of a folder of images; None reads the times from the file names.
        start_ns: Stamp of the first frame of a recording.
        open_timeout_s: Longest time to wait for a stream to answer.
        stall_timeout_s: Longest time between two frames of a stream before it is opened anew.
        give_up_s: Longest time without a frame before a stream is given up; None never does.
        clock_ns: What the frames of a stream are stamped with on arrival.
        report: Takes a sentence about every loss and return of a stream.
        on_bad_frame: Takes what is wrong with one image, after which the source goes on with the
            next; by default it raises.
    """

    fps: float | None = None
    start_ns: int = START_NS
    open_timeout_s: float = 10.0
    stall_timeout_s: float = 5.0
    give_up_s: float | None = 30.0
    clock_ns: Callable[[], int] = time.time_ns
    report: Callable[[str], None] = field(default=lambda _sentence: None)
    on_bad_frame: Callable[[FrameSourceError], None] = _raise


class FrameSource(ABC):
    """Images of one camera in the order of their capture, each iteration from the beginning.

    A context manager, closed at its end. Iterating raises FrameSourceError when a frame can't be
    had.

    Args:
        name: The source as its user named it, without any password.

    Attributes:
        name: As above.
        live: Whether frames come when the camera makes them, and are lost when nobody takes them.
        frame_count: How many there will be; None when that is not known.
        fps: Nominal frames per second; None when that is not known.
        reconnects: How often a lost stream has been opened again.
    """

    live: bool = False
    frame_count: int | None = None
    fps: float | None = None
    reconnects: int = 0

    def __init__(self, name: str) -> None:
        self.name = name
        self._closed = threading.Event()

    @abstractmethod
    def __iter__(self) -> Iterator[StampedImage]:
        """Stamps, strictly increasing, and images."""

    def close(self) -> None:
        """End the iteration soon, also when it waits in another thread."""
        self._closed.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
