"""Frames of a video file, stamped with its own times."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2

from geoorbit_ros.storage.frames.source import (
    FrameCheck,
    FrameSource,
    FrameSourceError,
    SourceOptions,
    StampedImage,
)

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
"""Quiet. OpenCV reads this once, when it first uses FFmpeg."""


def open_capture(name: str, settings: Sequence[int] = ()) -> cv2.VideoCapture:
    """A capture of a file or an address through FFmpeg; `isOpened()` says whether it works.

    FFmpeg and OpenCV otherwise print lines of their own about every fault, beside the one sentence
    that the caller makes of it. Set OPENCV_FFMPEG_LOGLEVEL to see FFmpeg's.

    Args:
        name: Path or address.
        settings: Pairs of property and value.
    """
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    return cv2.VideoCapture(name, cv2.CAP_FFMPEG, list(settings))


_COMPLETE_RATIO = 0.9
"""A video with less than this share of its announced length, less `_COMPLETE_SLACK_S`, breaks off.
Chosen: containers round, and some only estimate their length."""
_COMPLETE_SLACK_S = 1.0
"""Part of `_COMPLETE_RATIO`. Chosen: the last frames of a short video may have no times."""
_EXPECTED = "a video that FFmpeg can decode (MP4, MKV, AVI, WebM, …)"


class VideoFile(FrameSource):
    """Stamp = `options.start_ns` + presentation time of the frame, counted from the first.

    Raises:
        FrameSourceError: No such file, no video in it, not a single frame, it breaks off, or its
            frames change size.
    """

    def __init__(self, path: str | Path, options: SourceOptions) -> None:
        super().__init__(str(path))
        self._path, self._options = Path(path), options
        if not self._path.is_file():
            found = "a folder" if self._path.is_dir() else "no such file"
            raise FrameSourceError(self.name, found, _EXPECTED)
        capture = self._open()
        self.fps = capture.get(cv2.CAP_PROP_FPS)
        if not 0.0 < self.fps < 1000.0:
            self.fps = 25.0  # a raw stream without times of its own
        count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.frame_count = round(count) if count > 0 else None
        readable, _ = capture.read()
        capture.release()
        if not readable:
            raise FrameSourceError(self.name, "not a single readable frame", _EXPECTED)

    def __iter__(self) -> Iterator[StampedImage]:
        """Stamps and images from the beginning."""
        assert self.fps is not None
        capture = self._open()
        check = FrameCheck(self.name, self._options.on_bad_frame)
        period_ms, last_ms, first_ms = 1e3 / self.fps, 0.0, None
        try:
            while not self._closed.is_set():
                readable, image = capture.read()
                if not readable:
                    self._check_end(0.0 if first_ms is None else last_ms + period_ms)
                    return
                time_ms = capture.get(cv2.CAP_PROP_POS_MSEC)
                if first_ms is None:
                    first_ms = time_ms
                elif time_ms - first_ms <= last_ms:
                    # Some containers have no times, or the same one twice.
                    first_ms = time_ms - last_ms - period_ms
                last_ms = time_ms - first_ms
                usable = check.usable(image)
                if usable is not None:
                    yield self._options.start_ns + round(last_ms * 1e6), usable
        finally:
            capture.release()

    def _open(self) -> cv2.VideoCapture:
        capture = open_capture(str(self._path))
        if not capture.isOpened():
            size = self._path.stat().st_size
            raise FrameSourceError(self.name, f"{size} bytes that are no video", _EXPECTED)
        return capture

    def _check_end(self, seen_ms: float) -> None:
        """Tell the end of the video from a file that breaks off: to OpenCV they are the same."""
        if self.frame_count is None or self.fps is None:
            return
        announced_s, seen_s = self.frame_count / self.fps, seen_ms / 1e3
        if seen_s < _COMPLETE_RATIO * announced_s - _COMPLETE_SLACK_S:
            found = f"a video that breaks off after {seen_s:.1f} of {announced_s:.1f} s"
            raise FrameSourceError(self.name, found, "a complete one")
