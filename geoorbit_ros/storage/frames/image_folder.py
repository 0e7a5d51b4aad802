"""Frames of a folder of images, in the order of their names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.storage.frames.source import (
    FrameCheck,
    FrameSource,
    FrameSourceError,
    SourceOptions,
    StampedImage,
)

SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
_DIGITS = re.compile(r"(\d+)")
_TIME = re.compile(r"(?:^|\D)(\d{10}(?:[._]\d{1,9})?|\d{13}|\d{16}|\d{19})$")
"""A time since 1970 at the end of a name: seconds with up to nine decimals, milli-, micro- or
nanoseconds; ten digits are the years 2001 to 2286."""


class ImageFolder(FrameSource):
    """Images of a folder sorted by name, numbers in it by value; or a single image.

    Hidden files, such as macOS's `._1.jpg`, are no images.

    Stamp = `options.start_ns` + index / `options.fps`, or without `fps` the time since 1970 that
    each name ends with: `1767225600.040.jpg`, `north_1767225600040000000.png`.

    Raises:
        FrameSourceError: No image, names that are no times, one that can't be read or has another
            size than the first.
    """

    def __init__(self, path: str | Path, options: SourceOptions) -> None:
        super().__init__(str(path))
        self._files = _images(Path(path), self.name)
        self.frame_count = len(self._files)
        self.fps, self._on_bad_frame = options.fps, options.on_bad_frame
        if options.fps is not None or Path(path).is_file():
            period_ns = 1e9 / (options.fps or 1.0)
            self._stamps = [options.start_ns + round(k * period_ns) for k in range(len(self))]
        else:
            self._stamps = _times_in_names(self.name, self._files)

    def __len__(self) -> int:
        return len(self._files)

    def __iter__(self) -> Iterator[StampedImage]:
        """Stamps and images from the beginning."""
        check = FrameCheck(self.name, self._on_bad_frame)
        if _is_turned(self._files[0]):
            text = "images are turned as their EXIF entries say; control points must be those of"
            self._note(f"{text} the turned images")
        for stamp_ns, path in zip(self._stamps, self._files, strict=True):
            if self._closed.is_set():
                return
            usable = check.usable(_decoded(path), str(path))
            if usable is not None:
                yield stamp_ns, usable


def _images(path: Path, name: str) -> list[Path]:
    """The images that a path stands for, in order.

    Raises:
        FrameSourceError: There is none, or the folder can't be read.
    """
    expected = f"files in {', '.join(SUFFIXES)}"
    try:
        entries = [path] if path.is_file() else sorted(path.iterdir(), key=_natural)
        files = [p for p in entries if is_image(p) and p.is_file()]
    except OSError as error:
        raise FrameSourceError(name, error.strerror or str(error), expected) from None
    if not files:
        inside = [p.name for p in entries if not p.name.startswith(".")]
        more = f", but {len(inside)} other entries ({inside[0]}, …)" if inside else ""
        raise FrameSourceError(name, f"no image{more}", expected)
    return files


def is_image(path: Path) -> bool:
    """Whether a path names an image, and not a hidden file."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


_AS_STORED = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
"""Grey or colour, 8 or 16 bits a channel, without opacity."""


def _is_turned(path: Path) -> bool:
    """Whether an image's EXIF entry says that it is to be turned."""
    shown = _decoded(path)
    stored = _decoded(path, _AS_STORED | cv2.IMREAD_IGNORE_ORIENTATION)
    return shown is not None and stored is not None and not np.array_equal(shown, stored)


def _decoded(path: Path, how: int = _AS_STORED) -> NDArray[np.generic] | None:
    """The image of a file, turned as its EXIF entry says; None when it can't be read.

    Read here and decoded from memory: OpenCV takes some names for patterns, and can't take all.
    """
    try:
        content = np.fromfile(path, np.uint8)
        return cv2.imdecode(content, how) if content.size else None
    except (OSError, cv2.error):
        return None


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key by which `frame_9` comes before `frame_10`."""
    return [(int(p), "") if p.isdigit() else (-1, p) for p in _DIGITS.split(path.name) if p]


def _times_in_names(folder: str, files: Sequence[Path]) -> list[int]:
    """Stamps in nanoseconds from the names' ends.

    Raises:
        FrameSourceError: A name without a time, or one that is not later than the one before.
    """
    stamps: list[int] = []
    for path in files:
        match = _TIME.search(path.stem)
        if match is None:
            expected = "frames per second for this folder (--fps), or names that end with a time"
            found = f"the file {path.name}"
            raise FrameSourceError(folder, found, f"{expected} since 1970")
        whole, _, decimals = match[1].replace("_", ".").partition(".")
        digits = decimals.ljust(9, "0") if len(whole) == 10 else "0" * (19 - len(whole))
        stamps.append(int(whole + digits))
        if len(stamps) > 1 and stamps[-1] <= stamps[-2]:
            found = f"{path.name} after {files[len(stamps) - 2].name}"
            raise FrameSourceError(folder, found, "names whose order is that of their times")
    return stamps
