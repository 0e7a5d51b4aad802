"""What every source of images is: an iterable of capture times and images that can be closed.

All images become 8-bit blue, green, red, and have one size.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.input_report import InputReport, Remark, Treatment

Image = NDArray[np.uint8]
"""(height, width, 3), blue green red."""
StampedImage = tuple[int, Image]
"""Capture time in nanoseconds, and the image."""

START_NS = 1_000_000_000
"""Stamp of the first frame of a recording without a start time: zero means 'unset' in ROS."""


class FrameSourceError(GeoOrbitError):
    """A video, stream, folder of images or scene that can't be used, or an image in it."""


def _raise(error: FrameSourceError) -> None:
    raise error


@dataclass(frozen=True, slots=True)
class SourceOptions:
    """How to open a source; each kind takes what concerns it.

    Attributes:
        fps: Frames per second of what has no times: a folder of images (None: the times are in the
            file names), a raw video stream (None: 25).
        start_ns: Stamp of the first frame of a recording …
        own_start: … unless this is set and the file says when it was made.
        open_timeout_s: Longest time to wait for a stream to answer.
        stall_timeout_s: Longest time between two frames of a stream before it is opened anew.
        give_up_s: Longest time without a frame before a stream is given up; None never does.
        clock_ns: What the frames of a stream are stamped with on arrival.
        report: Takes a sentence about every loss and return of a stream.
        on_bad_frame: Takes what is wrong with one image, after which the source goes on with the
            next; by default it raises.
        on_cut: Takes that a video lacks a large part of its end, after all that is there; by
            default it raises, and a video whose size shows it is refused before it is read.
    """

    fps: float | None = None
    start_ns: int = START_NS
    own_start: bool = False
    open_timeout_s: float = 10.0
    stall_timeout_s: float = 5.0
    give_up_s: float | None = 30.0
    clock_ns: Callable[[], int] = time.time_ns
    report: Callable[[str], None] = field(default=lambda _sentence: None)
    on_bad_frame: Callable[[FrameSourceError], None] = _raise
    on_cut: Callable[[FrameSourceError], None] = _raise

    @property
    def refuses_cut(self) -> bool:
        """Whether a video that breaks off is an error."""
        return self.on_cut is _raise


class LeftOut:
    """Collects what is wrong with images that are left out: an `on_bad_frame`.

    Attributes:
        count: How many there are.
    """

    def __init__(self) -> None:
        self.count = 0
        self._kinds: dict[str, list[FrameSourceError]] = {}

    def clear(self) -> None:
        """Forget what was left out: the source is read anew."""
        self.count = 0
        self._kinds.clear()

    def __call__(self, error: FrameSourceError) -> None:
        """Leave out one image."""
        self.count += 1
        self._kinds.setdefault(error.expected, []).append(error)

    def report_to(self, report: InputReport, used: int) -> None:
        """Add what was left out to a report on a source of which `used` images were used."""
        report.total = used + self.count
        for expected, errors in self._kinds.items():
            first = errors[0]
            example = f"{first.place}: {first.found}"
            report.add(Treatment.LEFT_OUT, len(errors), f"not {expected}", example)


class FrameSource(ABC):
    """Images of one camera in the order of their capture, each iteration from the beginning.

    A context manager, closed at its end. Iterating raises FrameSourceError when a frame can't be
    had.

    Args:
        name: The source as its user named it, without any password.

    Attributes:
        name: As above.
        live: Whether frames come when the camera makes them, and are lost when they are not taken.
        frame_count: How many there will be; None when that is not known.
        fps: Nominal frames per second; None when that is not known.
        reconnects: How often a lost stream has been opened again.
        remarks: What was assumed or found odd; grows while the source is read.
    """

    live: bool = False
    frame_count: int | None = None
    fps: float | None = None
    reconnects: int = 0

    def __init__(self, name: str) -> None:
        self.name = name
        self.remarks = InputReport(name, "images")
        self._closed = threading.Event()

    def _note(self, text: str) -> None:
        """Remark on the source as a whole, once also when it is read again."""
        remark = Remark(Treatment.NOTED, 0, text)
        if remark not in self.remarks.remarks:
            self.remarks.remarks.append(remark)

    def _note_unused(self, fps: float | None, why: str) -> None:
        if fps is not None:
            self._note(f"--fps {fps:g} is not used: {why}")

    @abstractmethod
    def __iter__(self) -> Iterator[StampedImage]:
        """Stamps, strictly increasing, and images."""

    def close(self) -> None:
        """End the iteration soon, also when it waits in another thread."""
        self._closed.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def check_name(name: str) -> None:
    """Refuse a name that can't be handed to FFmpeg or OpenCV, which may crash on it.

    Raises:
        FrameSourceError: It is no UTF-8.
    """
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        shown = name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
        raise FrameSourceError(
            shown, "a name that is not UTF-8", "a file of another name"
        ) from None


def utc_text(stamp_ns: int) -> str:
    """Date and time of a stamp that counts from 1970."""
    return f"{datetime.fromtimestamp(stamp_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S} UTC"


def to_bgr8(image: NDArray[Any], place: str) -> Image:
    """An image as uint8 (H, W, 3).

    Grey becomes three equal channels, a fourth channel (opacity) is dropped, 16-bit values keep
    their upper eight bits.

    Args:
        image: (H, W), or (H, W, C) with 1, 3 or 4 channels; uint8 or uint16.
        place: Where it came from, for the error.

    Raises:
        FrameSourceError: Other shapes or types.
    """
    channels = image.shape[2] if image.ndim == 3 else 1
    usable = image.ndim in (2, 3) and channels in (1, 3, 4) and image.size > 0
    if not usable or image.dtype not in (np.uint8, np.uint16):
        shape = "x".join(map(str, image.shape))
        found = f"an image of {shape} values, {image.dtype}"
        raise FrameSourceError(place, found, "grey or colour, 8 or 16 bits a channel")
    eight = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
    if channels == 3:
        return np.ascontiguousarray(eight)
    if channels == 4:
        return np.ascontiguousarray(eight[:, :, :3])
    return np.repeat(eight.reshape(*eight.shape[:2], 1), 3, axis=2)


class FrameCheck:
    """Turns what a source reads into images of one size, and skips what can't be used.

    Control points are pixels of one image size: boxes in an image of another size would land
    somewhere else on the road.

    Args:
        place: The source, for the error.
        on_bad_frame: Takes what is wrong with an image; may raise it.
    """

    def __init__(self, place: str, on_bad_frame: Callable[[FrameSourceError], None]) -> None:
        self._place, self._on_bad_frame = place, on_bad_frame
        self._size: tuple[int, int] | None = None

    def usable(self, image: NDArray[Any] | None, place: str = "") -> Image | None:
        """The image as 8-bit blue, green, red; None when it was skipped.

        Args:
            image: As read; None when it could not be.
            place: The file, where each image has its own.
        """
        try:
            if image is None:
                found, expected = "no readable image", "a complete one"
                raise FrameSourceError(place or self._place, found, expected)
            return self._checked(to_bgr8(image, place or self._place), place or self._place)
        except FrameSourceError as error:
            self._on_bad_frame(error)
            return None

    def _checked(self, image: Image, place: str) -> Image:
        size = (image.shape[1], image.shape[0])
        if self._size is None:
            self._size = size
        if size != self._size:
            found = f"a frame of {size[0]}x{size[1]} pixels"
            raise FrameSourceError(place, found, f"{self._size[0]}x{self._size[1]} as before")
        return image
