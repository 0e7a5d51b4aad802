"""Writes images as a video file."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

import cv2

from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.storage.frames import opencv as _quiet  # noqa: F401  # before FFmpeg is used
from geoorbit_ros.storage.frames.source import Image

CODECS = {".mp4": "mp4v", ".mkv": "mp4v", ".avi": "MJPG", ".webm": "VP80"}
"""By suffix. MPEG-4 part 2 takes 5 ms a frame at 720p and every player shows it, browsers don't;
they show WebM, which takes 35 ms. H.264 is not in OpenCV's wheels, for its patents."""


class VideoWriter:
    """A context manager that writes images of one size at a constant rate.

    Args:
        path: The file; its suffix decides on the format.
        fps: Frames per second.

    Raises:
        ParameterError: A suffix that is none of `CODECS`.
        InputFileError: Nothing can be written there, by `write`.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        self._path, self._fps = Path(path), fps
        self._code = CODECS.get(self._path.suffix.lower(), "")
        if not self._code:
            raise ParameterError("video file", str(path), f"a name in {', '.join(CODECS)}")
        self._writer: cv2.VideoWriter | None = None

    def write(self, image: Image) -> None:
        """Append one image, of the same size as the first."""
        if self._writer is None:
            size, code = (image.shape[1], image.shape[0]), cv2.VideoWriter.fourcc(*self._code)
            self._writer = cv2.VideoWriter(str(self._path), cv2.CAP_FFMPEG, code, self._fps, size)
            if not self._writer.isOpened():
                raise InputFileError(str(self._path), "no way to write it", "a writable folder")
        self._writer.write(image)

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
