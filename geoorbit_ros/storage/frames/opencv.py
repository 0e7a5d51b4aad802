"""OpenCV's video reading, without its own output on the terminal."""

from __future__ import annotations

import os
from collections.abc import Sequence

import cv2

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
