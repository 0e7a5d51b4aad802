"""Tracked boxes as a file has them, before anything is checked: what every format reads into."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from geoorbit_ros.core.input_report import InputReport

Array = NDArray[np.float64]

HEAD_BYTES = 1 << 16
"""A format is recognised by this much of a file. Chosen: metadata of OTVision files, the longest
of all formats, takes 3 KB; more only costs reading."""


@dataclass(slots=True)
class RawTracks:
    """Rows of a file, N boxes; NaN where a number can't be read or is not there.

    Attributes:
        format_name: The format, as people call it.
        row: (N,) where each box stands in the file: a line, or a count of boxes.
        row_word: What `row` counts: `line` or `box`.
        x: (N,) pixel, middle of the box.
        y: (N,) pixel, middle of the box.
        width: (N,) pixels.
        height: (N,) pixels.
        ground_point: (N,) the pixel is already on the ground, and the box has no size.
        track_id: (N,) identity as the file writes it, number or word; empty for none.
        class_name: (N,) class as the file writes it, number or word; empty for none.
        score: (N,) the detector's score, on whatever scale.
        frame: (N,) number of the image; None where the format has none.
        stamp_ns: (N,) capture time; -1 where it can't be read; None where the format has none.
        time_text: (N,) the times as the file writes them, for what can't be read.
        first_frame: Number of the first image of the recording.
        fps: Images per second, where the file says so.
        image_size: (width, height), where the file says so.
        flags: (N,) as in `PIXEL_TRACK_DTYPE`, where the format has them.
        report: What has been found so far.
    """

    format_name: str
    row: NDArray[np.int64]
    row_word: str
    x: Array
    y: Array
    width: Array
    height: Array
    ground_point: NDArray[np.bool_]
    track_id: pa.StringArray
    class_name: pa.StringArray
    score: Array
    report: InputReport
    frame: Array | None = None
    stamp_ns: NDArray[np.int64] | None = None
    time_text: pa.StringArray | None = None
    first_frame: int = 0
    fps: float | None = None
    image_size: tuple[int, int] | None = None
    flags: NDArray[np.uint32] | None = None

    def __len__(self) -> int:
        return len(self.row)

    def place(self, k: int) -> str:
        """Where box `k` stands in the file."""
        return f"{self.row_word} {self.row[k]}"


class TrackFormat(Protocol):
    """Reads one format of tracked boxes."""

    name: str
    """As people call it."""
    expected: str
    """What such a file looks like, for errors."""

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether a file that begins with `head` has this format, by its content."""
        ...

    def read(self, path: Path, columns: dict[str, str]) -> RawTracks:
        """All boxes.

        Args:
            path: The file.
            columns: Names of columns by what they mean, for formats that have a header.

        Raises:
            InputFileError: Nothing can be made of the file.
        """
        ...
