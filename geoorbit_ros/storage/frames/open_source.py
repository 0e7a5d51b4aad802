"""Opens the source of images that a user names; a network camera, which comes and goes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any
from urllib.parse import unquote, urlsplit

import cv2
from numpy.typing import NDArray

from geoorbit_ros.core.addresses import check_address, is_address, masked
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.storage.frames.image_folder import ImageFolder, is_image
from geoorbit_ros.storage.frames.source import (
    FrameCheck,
    FrameSource,
    FrameSourceError,
    SourceOptions,
    StampedImage,
)
from geoorbit_ros.storage.frames.video_file import VideoFile, open_capture

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


SourceMaker = Callable[[str, SourceOptions], FrameSource]
"""Makes a source from the whole text that names it."""

_NONE: Mapping[str, SourceMaker] = MappingProxyType({})


def open_frame_source(
    spec: str, options: SourceOptions | None = None, more: Mapping[str, SourceMaker] = _NONE
) -> FrameSource:
    """Open a video file, a stream, a folder of images, or what a further scheme names.

    Args:
        spec: `recording.mp4`, `rtsp://…` or `http://…`, a folder, or `<scheme>:…` of `more`.
        options: How; default: all defaults.
        more: Makers of further sources by scheme; `rendering.frame_source.SCENES` for `scene:NAME`.

    Raises:
        FrameSourceError: Nothing that can be read. A stream says so only when it is iterated.
        ParameterError: An empty text, or a frame rate that is none.
    """
    options = options or SourceOptions()
    if not spec.strip():
        raise ParameterError("source", "nothing", "a video file, an address, a folder or a scene")
    if options.fps is not None and not 0.0 < options.fps <= 1000.0:
        raise ParameterError("fps", f"{options.fps:g}", "above 0 to 1000 frames per second")
    scheme, colon, _ = spec.partition(":")
    if colon and scheme in more:
        return more[scheme](spec, options)
    if is_address(spec):
        return Stream(spec, options)
    path = Path(local_path(spec))
    if masked(spec) != spec and not path.exists():
        # Plainly meant as an address, with a password that a file's name would show.
        check_address(spec)
    if path.is_dir() or (is_image(path) and path.is_file()):
        return ImageFolder(path, options)
    return VideoFile(path, options)


def local_path(spec: str) -> str:
    """The path of a file or folder that may be written as `file:///…` (RFC 8089)."""
    if spec.lower().startswith("file://") and not Path(spec).exists():
        return unquote(urlsplit(spec).path)
    return spec
