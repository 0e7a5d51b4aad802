"""Tracks as KITTI tracking text: `frame id type truncated occluded alpha left top right bottom …`.

Values are separated by blanks, 17 or 18 of them; an 18th is a score. `DontCare` marks parts of the
image that are not labelled. KITTI's cameras take ten images per second. Source: the development
kit of the KITTI tracking benchmark (Geiger et al. 2012).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.storage.tracks.csv_text import decode
from geoorbit_ros.storage.tracks.raw_tracks import RawTracks

FPS = 10.0
"""Frame rate of the benchmark's recordings (Geiger et al. 2012, section 2.1)."""
_VALUES = (17, 18)
_UNLABELLED = "dontcare"


class Kitti:
    """`TrackFormat` for KITTI tracking labels and results."""

    name = "KITTI tracking"
    expected = "KITTI tracking text, 17 or 18 values per line"

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether the first line has as many values, the third of which is a word."""
        try:
            text = decode(head, str(path), self.expected)
        except InputFileError:
            return False
        line = next((s for s in text.splitlines() if s.strip()), "").split()
        return len(line) in _VALUES and line[0].isdigit() and line[2].replace("_", "").isalpha()

    def read(self, path: Path, columns: dict[str, str]) -> RawTracks:
        """See `TrackFormat.read`; there is no header, so `columns` mean nothing."""
        report = InputReport(str(path), "boxes")
        rows, numbers, broken, unlabelled = [], [], [], 0
        text = decode(path.read_bytes(), str(path), self.expected)
        for number, line in enumerate(text.splitlines(), 1):
            values = line.split()
            if not values:
                continue
            if len(values) not in _VALUES:
                broken.append(number)
            elif values[2].lower() == _UNLABELLED:
                unlabelled += 1
            else:
                rows.append(values)
                numbers.append(number)
        report.total = len(rows) + len(broken)
        if broken:
            text = "not 17 or 18 values"
            report.add(Treatment.LEFT_OUT, len(broken), text, f"line {broken[0]}")
        if unlabelled:
            report.note(Treatment.NOTED, f"{unlabelled} lines mark unlabelled parts of the image")
        left, top, right, bottom = (
            np.array([_number(row[k]) for row in rows]) for k in (6, 7, 8, 9)
        )
        return RawTracks(
            self.name,
            np.array(numbers, dtype=np.int64),
            "line",
            0.5 * (left + right), 0.5 * (top + bottom), right - left, bottom - top,
            np.zeros(len(rows), dtype=np.bool_),
            pa.array(["" if row[1] == "-1" else row[1] for row in rows], pa.string()),
            pa.array([row[2] for row in rows], pa.string()),
            np.array([_number(row[17]) if len(row) > 17 else np.nan for row in rows]),
            report,
            frame=np.array([_number(row[0]) for row in rows]),
            fps=FPS,
        )  # fmt: skip


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")
