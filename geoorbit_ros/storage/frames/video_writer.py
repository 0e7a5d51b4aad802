"""A video file, written frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.storage.atomic import atomic_output

CODECS = MappingProxyType({".mp4": "mp4v", ".avi": "MJPG"})
"""What OpenCV's own wheels can encode: MPEG-4 part 2, and a JPEG per frame. They hold no H.264."""


class VideoWriter:
    """An open video.

    Args:
        path: Where it is written; the suffix chooses the encoding.
        fps: Frames per second.
        image_size: Width and height in pixels.

    Raises:
        InputFileError: Another suffix than `CODECS` has, or OpenCV can't write there.
    """

    def __init__(self, path: Path, fps: float, image_size: tuple[int, int]) -> None:
        check_suffix(path)
        codec = CODECS[path.suffix.lower()]
        # By its absolute path: FFmpeg takes what stands before a colon for a protocol.
        name, code = str(path.absolute()), cv2.VideoWriter.fourcc(*codec)
        self._writer = cv2.VideoWriter(name, cv2.CAP_FFMPEG, code, fps, image_size)
        if not self._writer.isOpened():
            found = f"no encoder for {codec} of {image_size[0]}x{image_size[1]} pixels"
            raise InputFileError(str(path), found, "an OpenCV that writes video")

    def write(self, image: NDArray[np.uint8]) -> None:
        """Add an image (H, W, 3) blue, green, red."""
        self._writer.write(image)

    def close(self) -> None:
        """Finish the file."""
        self._writer.release()


def is_video(path: Path) -> bool:
    """Whether a path names a video that can be written."""
    return path.suffix.lower() in CODECS


def check_suffix(path: Path) -> None:
    """Refuse a file that is no video by its name.

    Raises:
        InputFileError: The suffix is none of `CODECS`.
    """
    if not is_video(path):
        raise InputFileError(str(path), f"'{path.suffix}'", f"a name in {' or '.join(CODECS)}")


@contextmanager
def new_video(path: str | Path, fps: float, image_size: tuple[int, int]) -> Iterator[VideoWriter]:
    """A video that is there when the block ends, and not at all when it fails.

    Raises:
        InputFileError: See `VideoWriter`; or nothing can be written there.
    """
    check_suffix(Path(path))
    with atomic_output(path) as temporary:
        video = VideoWriter(temporary, fps, image_size)
        try:
            yield video
        finally:
            video.close()
