"""Frames of a folder of images, in the order of their names."""

from __future__ import annotations

import re
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

SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
_DIGITS = re.compile(r"(\d+)")
_TIME = re.compile(r"(?:^|\D)(\d{10}(?:[._]\d{1,9})?|\d{13}|\d{16}|\d{19})$")
"""A time since 1970 at the end of a name: seconds with up to nine decimals, milli-, micro- or
nanoseconds; ten digits are the years 2001 to 2286."""


class ImageFolder(FrameSource):
    """Images sorted by name, numbers in it by value.

    Stamp = `options.start_ns` + index / `options.fps`, or without `fps` the time since 1970 that
    each name ends with: `1767225600.040.jpg`, `north_1767225600040000000.png`.

    Raises:
        FrameSourceError: No image, names that are no times, one that can't be read or has another
            size than the first.
    """

    def __init__(self, folder: str | Path, options: SourceOptions) -> None:
        super().__init__(str(folder))
        self._files = sorted(
            (p for p in Path(folder).iterdir() if p.suffix.lower() in SUFFIXES and p.is_file()),
            key=_natural,
        )
        if not self._files:
            raise FrameSourceError(self.name, "no image", f"files in {', '.join(SUFFIXES)}")
        self.frame_count = len(self._files)
        self.fps, self._on_bad_frame = options.fps, options.on_bad_frame
        if options.fps is not None:
            period_ns = 1e9 / options.fps
            self._stamps = [options.start_ns + round(k * period_ns) for k in range(len(self))]
        else:
            self._stamps = _times_in_names(self.name, self._files)

    def __len__(self) -> int:
        return len(self._files)

    def __iter__(self) -> Iterator[StampedImage]:
        """Stamps and images from the beginning."""
        check = FrameCheck(self.name, self._on_bad_frame)
        for stamp_ns, path in zip(self._stamps, self._files, strict=True):
            if self._closed.is_set():
                return
            usable = check.usable(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), str(path))
            if usable is not None:
                yield stamp_ns, usable


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
            expected = "frames per second for this folder, or names that end with a time since 1970"
            raise FrameSourceError(folder, f"the file {path.name}", expected)
        whole, _, decimals = match[1].replace("_", ".").partition(".")
        digits = decimals.ljust(9, "0") if len(whole) == 10 else "0" * (19 - len(whole))
        stamps.append(int(whole + digits))
        if len(stamps) > 1 and stamps[-1] <= stamps[-2]:
            found = f"{path.name} after {files[len(stamps) - 2].name}"
            raise FrameSourceError(folder, found, "names whose order is that of their times")
    return stamps
