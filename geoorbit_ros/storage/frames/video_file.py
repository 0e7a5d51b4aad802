"""Frames of a video file, stamped with its own times."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.storage.frames.container import read_container
from geoorbit_ros.storage.frames.source import (
    FrameCheck,
    FrameSource,
    FrameSourceError,
    SourceOptions,
    StampedImage,
    check_name,
    utc_text,
)

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
"""Quiet. OpenCV reads this once, when it first uses FFmpeg."""


def open_capture(name: str, settings: Sequence[int] = ()) -> cv2.VideoCapture:
    """A capture of a file or an address through FFmpeg; `isOpened()` says whether it works.

    FFmpeg and OpenCV otherwise print lines of their own about every fault, beside the one sentence
    that the caller makes of it. Set OPENCV_FFMPEG_LOGLEVEL to see FFmpeg's.

    Args:
        name: Absolute path, or address: FFmpeg takes what stands before a colon for a protocol.
        settings: Pairs of property and value.
    """
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    return cv2.VideoCapture(name, cv2.CAP_FFMPEG, list(settings))


_COMPLETE_RATIO = 0.9
"""A video with less than this share of its announced length, less `_COMPLETE_SLACK_S`, breaks off.
Chosen: containers round, and some only estimate their length."""
_COMPLETE_SLACK_S = 1.0
"""Part of `_COMPLETE_RATIO`. Chosen: the last frames of a short video may have no times."""
_LEAST_SHARE = 0.5
"""Of a file that ends as it should, but of which less than this can be decoded, most is damaged.
Chosen: as `core.input_report.MAX_LEFT_OUT_SHARE`."""
ASSUMED_FPS = 25.0
"""Frames per second of a stream without times: what FFmpeg takes for raw H.264 and JPEG (option
`framerate` of its demuxers)."""
_MAX_NOMINAL_FPS = 120.0
"""A container that claims more counts in units of its clock, as browsers' WebM and some AVI do; the
first frames then tell. Chosen: above the rate of any camera on a pole."""
_RATE_FRAMES = 30
"""Frames that tell it. Chosen: larger takes longer to open, smaller is less sure."""
_STEPS = 10
"""Of the search for the place where a video breaks off: to a thousandth of its length."""
_EXPECTED = "a video that FFmpeg can decode (MP4, MKV, AVI, WebM, …)"
_CONVERT = "H.264, HEVC, MPEG-4, VP8, VP9 or JPEG: ffmpeg -i IN -c:v libx264 OUT.mp4 converts it"
_WHOLE = "a complete one (option --duration takes what there is)"


class VideoFile(FrameSource):
    """Stamp = `options.start_ns` + presentation time of the frame, counted from the first.

    A stream without times, such as raw H.264, has `options.fps` frames per second, else
    `ASSUMED_FPS`.

    Raises:
        FrameSourceError: No such file, no video in it, not a single frame, or it breaks off.
    """

    def __init__(self, path: str | Path, options: SourceOptions) -> None:
        super().__init__(str(path))
        self._path, self._options = Path(path).absolute(), options
        check_name(self.name)
        if not self._path.is_file():
            found = "a folder" if self._path.is_dir() else "no such file"
            raise FrameSourceError(self.name, found, _EXPECTED)
        self._container = read_container(self._path)
        capture = self._open()
        fps = capture.get(cv2.CAP_PROP_FPS)
        count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        turn = capture.get(cv2.CAP_PROP_ORIENTATION_META)
        looked_at = 1 if options.fps is None and 0.0 < fps <= _MAX_NOMINAL_FPS else _RATE_FRAMES
        frames = islice(_read(capture), looked_at)
        times_ms = [capture.get(cv2.CAP_PROP_POS_MSEC) for _ in frames]
        capture.release()
        if not times_ms:
            raise self._undecodable()
        self.fps = self._rate(fps, times_ms)
        length_s = self._container.length_s
        self._announced_s = length_s or (count / fps if count > 0 and fps > 0 else None)
        self.frame_count = round(self._announced_s * self.fps) if self._announced_s else None
        self._start_ns = options.start_ns
        self._say(turn)
        self._check_bytes()

    def __iter__(self) -> Iterator[StampedImage]:
        """Stamps and images from the beginning."""
        assert self.fps is not None
        capture = self._open()
        check = FrameCheck(self.name, self._options.on_bad_frame)
        period_ms, last_ms, first_ms, guessed, count = 1e3 / self.fps, 0.0, None, 0, 0
        try:
            for image in _read(capture):
                if self._closed.is_set():
                    return
                time_ms = capture.get(cv2.CAP_PROP_POS_MSEC)
                if not self._container.timed:
                    time_ms = count * 1e3 / self.fps
                if first_ms is None:
                    first_ms = time_ms
                elif time_ms - first_ms <= last_ms:
                    # Some containers have no times, or the same one twice.
                    first_ms, guessed = time_ms - last_ms - period_ms, guessed + 1
                elif not guessed:
                    period_ms = time_ms - first_ms - last_ms
                last_ms, count = time_ms - first_ms, count + 1
                usable = check.usable(image)
                if usable is not None:
                    yield self._start_ns + round(last_ms * 1e6), usable
        finally:
            capture.release()
        if not self._closed.is_set():
            self._check_end(0.0 if first_ms is None else (last_ms + period_ms) / 1e3)
            self._say_guessed(guessed, count, 1e3 / period_ms)

    def _open(self) -> cv2.VideoCapture:
        # By its absolute path, in which no colon can be a protocol's.
        capture = open_capture(str(self._path))
        if not capture.isOpened():
            raise self._unopened()
        return capture

    def _unopened(self) -> FrameSourceError:
        size, known = self._path.stat().st_size, self._container
        if not size:
            return FrameSourceError(self.name, "an empty file (0 bytes)", _EXPECTED)
        if known.video is False:
            what = "sound without images" if known.kind in _CONTAINERS else known.kind
            return FrameSourceError(self.name, f"{what}, {size} bytes", _EXPECTED)
        if known.kind in _CONTAINERS and not known.indexed:
            found = f"{size} bytes that are no video yet: the index of an MP4 file is missing"
            expected = "a recording that was ended properly, or a whole copy"
            return FrameSourceError(self.name, found, expected)
        if known.codec:
            return self._undecodable()
        return FrameSourceError(self.name, f"{size} bytes that are no video", _EXPECTED)

    def _undecodable(self) -> FrameSourceError:
        codec = self._container.codec
        if not codec:
            return FrameSourceError(self.name, "not a single readable frame", _EXPECTED)
        found = f"{codec} video, of which the installed FFmpeg decodes not a single readable frame"
        return FrameSourceError(self.name, found, _CONVERT)

    def _rate(self, nominal: float, times_ms: Sequence[float]) -> float:
        """Frames per second; says what was assumed, and whether the option is used."""
        wanted = self._options.fps
        if not self._container.timed:
            if wanted is None:
                text = f"{self._container.kind} has no times: {ASSUMED_FPS:g} images per second are"
                self._note(f"{text} assumed (--fps sets it)")
            return wanted or ASSUMED_FPS
        if wanted is not None and len(times_ms) > 1 and len(set(times_ms)) == 1:
            return wanted
        if not 0.0 < nominal <= _MAX_NOMINAL_FPS:
            steps: NDArray[np.float64] = np.diff(np.array(times_ms))
            steps = steps[steps > 0.0]
            nominal = 1e3 / float(np.median(steps)) if len(steps) else wanted or ASSUMED_FPS
        why = f"the file has times of its own, about {nominal:.4g} images per second"
        self._note_unused(wanted, why)
        return nominal

    def _say(self, turn_deg: float) -> None:
        """Note when it was made, and how its images are turned."""
        made_ns = self._container.created_ns
        if self._options.own_start and made_ns is not None:
            self._start_ns = made_ns
            text = f"starts at {utc_text(made_ns)}, as the file says (--start-time sets another)"
            self._note(text)
        elif self._options.own_start:
            text = "the file doesn't say when it was made: times count from its first image"
            self._note(f"{text} (--start-time sets another)")
        if turn_deg % 360.0:
            text = f"images are turned by {turn_deg:g}°, as the file says; control points must be"
            self._note(f"{text} those of the turned image")
        if self._container.whole is None and self._container.kind in ("Matroska", "WebM", "AVI"):
            text = "its size is left open, as by a recorder that was cut off; it is used to its end"
            self._note(text)

    def _check_bytes(self) -> None:
        """Refuse a file that plainly lacks a part, before anything is done with it."""
        size, announced = self._path.stat().st_size, self._container.announced_bytes
        if self._container.whole is not False or not announced:
            return
        text = f"{size} of {announced} bytes"
        if self._announced_s is None:
            lacks = size < _COMPLETE_RATIO * announced
            error = FrameSourceError(self.name, f"a video that breaks off after {text}", _WHOLE)
        else:
            seen_s = self._readable_s(self._announced_s)
            lacks, error = self._lacks_much(seen_s), self._cut(seen_s, f" ({text})")
        if lacks and self._options.refuses_cut:
            raise error
        if lacks:
            self._note(f"{error.found}; what is there is used")

    def _readable_s(self, announced_s: float) -> float:
        """About how much of it can be read, by looking for frames at one time after the other."""
        assert self.fps is not None
        low_s, high_s = 0.0, announced_s
        for _ in range(_STEPS):
            middle_s = 0.5 * (low_s + high_s)
            capture = self._open()
            capture.set(cv2.CAP_PROP_POS_MSEC, 1e3 * middle_s)
            readable, _image = capture.read()
            time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
            capture.release()
            if readable and time_s >= middle_s - 2.0 / self.fps:
                low_s = middle_s
            else:
                high_s = middle_s
        return low_s

    def _lacks_much(self, seen_s: float) -> bool:
        announced_s = self._announced_s or 0.0
        return seen_s < _COMPLETE_RATIO * announced_s - _COMPLETE_SLACK_S

    def _cut(self, seen_s: float, more: str = "") -> FrameSourceError:
        found = f"a video that breaks off after {seen_s:.1f} of {self._announced_s:.1f} s{more}"
        return FrameSourceError(self.name, found, _WHOLE)

    def _check_end(self, seen_s: float) -> None:
        """Tell the end of the video from a file that breaks off: to OpenCV they are the same.

        A length in the header alone proves nothing: trimmed files carry that of the whole one.
        """
        whole, announced_s = self._container.whole, self._announced_s
        exact = self._container.length_s is not None and self._container.kind != "AVI"
        if not self._lacks_much(seen_s):
            if whole is False:
                self._note(f"the file is cut off at its end; its {seen_s:.1f} s are used")
            return
        assert announced_s is not None
        if whole is False or (exact and seen_s < _LEAST_SHARE * announced_s):
            self._options.on_cut(self._cut(seen_s))
        else:
            text = f"the header announces {announced_s:.1f} s, the file has {seen_s:.1f} s of video"
            self._note(text)

    def _say_guessed(self, guessed: int, count: int, fps: float) -> None:
        if self._container.timed and guessed > _LEAST_SHARE * count:
            text = (
                f"{guessed} of {count} images have no time of their own, or that of the one before"
            )
            self._note(f"{text}: {fps:.4g} images per second are assumed (--fps sets it)")


_CONTAINERS = ("MP4", "Matroska", "WebM", "AVI", "sound")


def _read(capture: cv2.VideoCapture) -> Iterator[NDArray[np.generic]]:
    """Frames as they are decoded."""
    while True:
        readable, image = capture.read()
        if not readable:
            return
        yield image
