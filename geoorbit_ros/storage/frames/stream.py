"""Frames of a network camera, which comes and goes."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import cv2
from numpy.typing import NDArray

from geoorbit_ros.core.addresses import check_address, masked
from geoorbit_ros.storage.frames.source import (
    FrameCheck,
    FrameSource,
    FrameSourceError,
    SourceOptions,
    StampedImage,
)
from geoorbit_ros.storage.frames.video_file import open_capture

FIRST_WAIT_S = 0.5
"""Pause before the first attempt to open a lost stream again; doubled every time, and back to this
after a frame. Chosen: shorter disturbs a camera that starts."""
LONGEST_WAIT_S = 30.0
"""Longest such pause. Chosen: longer misses traffic when the camera is back, shorter floods the
network of a camera that is gone."""


class Stream(FrameSource):
    """Stamp = `options.clock_ns()` when the frame arrived.

    A stream that ends, stalls or can't be reached is opened again after a pause that doubles every
    time, for ever or until `options.give_up_s` have passed without a frame.

    Raises:
        ParameterError: An address that can't be used.
        FrameSourceError: Given up.
    """

    live = True

    def __init__(self, address: str, options: SourceOptions) -> None:
        super().__init__(masked(address))
        check_address(address)
        self._address, self._options = address, options
        self._note_unused(options.fps, "a stream's images are stamped when they arrive")

    def __iter__(self) -> Iterator[StampedImage]:
        """Stamps and images as they arrive, until the source is closed."""
        options, check = self._options, FrameCheck(self.name, self._options.on_bad_frame)
        limit_s = math.inf if options.give_up_s is None else options.give_up_s
        wait_s, last_ns = FIRST_WAIT_S, -(2**62)
        seen_s = time.monotonic()
        while True:
            fault = "no answer"
            for stamp_ns, image in self._frames_until_lost():
                if fault == "no answer":
                    fault, wait_s = "no more frames", FIRST_WAIT_S
                    options.report(f"{self.name}: receiving frames")
                last_ns = max(stamp_ns, last_ns + 1)
                usable = check.usable(image)
                if usable is not None:
                    yield last_ns, usable
                seen_s = time.monotonic()  # the time that the caller took is not the stream's
            if self._closed.is_set():
                return
            silent_s = time.monotonic() - seen_s
            if silent_s + wait_s > limit_s:
                found = f"{fault} for {silent_s:.0f} s"
                raise FrameSourceError(self.name, found, "a stream that FFmpeg can open")
            options.report(f"{self.name}: {fault}, opening it again in {wait_s:g} s")
            if self._closed.wait(wait_s):
                return
            wait_s = min(2.0 * wait_s, LONGEST_WAIT_S)
            self.reconnects += 1

    def _frames_until_lost(self) -> Iterator[tuple[int, NDArray[Any]]]:
        """Frames of one connection."""
        options = self._options
        capture = open_capture(
            self._address,
            (
                cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
                round(1e3 * options.open_timeout_s),
                cv2.CAP_PROP_READ_TIMEOUT_MSEC,
                round(1e3 * options.stall_timeout_s),
                # With several threads FFmpeg holds back a frame for each of them.
                cv2.CAP_PROP_N_THREADS,
                1,
            ),
        )
        try:
            while not self._closed.is_set() and capture.grab():
                stamp_ns = options.clock_ns()
                readable, image = capture.retrieve()
                if not readable:
                    return
                yield stamp_ns, image
        finally:
            capture.release()
