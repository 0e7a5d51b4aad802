"""Tracks as MOTChallenge text: `frame,id,x,y,w,h,conf,class,-1,-1`, no header.

`x,y` is the upper left corner. Commas or blanks between the values; 6 to 10 of them. Sources:
Leal-Taixé et al. 2015, arXiv:1504.01942, table 3; the eighth column as in its ground truth files.
Results of trackers have -1 there, which says no class.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.storage.tracks.csv_text import as_numbers, decode
from geoorbit_ros.storage.tracks.raw_tracks import RawTracks

MIN_VALUES, MAX_VALUES = 6, 10
"""Frame, id and box; the confidence and what follows may be missing."""


class MotChallenge:
    """`TrackFormat` for MOTChallenge text."""

    name = "MOTChallenge"
    expected = "MOTChallenge text, lines frame,id,x,y,w,h,conf,class,-1,-1"

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether the first lines are six to ten numbers."""
        try:
            lines = _lines(decode(head, str(path), self.expected))
        except InputFileError:
            return False
        checked = [values for _, values in lines[:20]]
        good = [v for v in checked if MIN_VALUES <= len(v) <= MAX_VALUES and _numeric(v)]
        return bool(checked) and 2 * len(good) > len(checked)

    def read(self, path: Path, columns: dict[str, str]) -> RawTracks:
        """See `TrackFormat.read`; there is no header, so `columns` mean nothing."""
        report = InputReport(str(path), "boxes")
        lines = _lines(decode(path.read_bytes(), str(path), self.expected))
        report.total = len(lines)
        counts = [len(values) for _, values in lines]
        usual = int(np.bincount(counts).argmax())
        good = [(k, v) for k, v in lines if len(v) == usual]
        wrong = [k for k, v in lines if len(v) != usual]
        if wrong:
            text = f"not {usual} values as in most lines"
            report.add(Treatment.LEFT_OUT, len(wrong), text, f"line {wrong[0]}")
        columns_text = [pa.array(c, pa.string()) for c in zip(*(v for _, v in good), strict=True)]
        numbers = [as_numbers(column) for column in columns_text]
        frame, left, top, width, height = numbers[0], *numbers[2:6]
        nothing = pa.array([""] * len(good), pa.string())
        kind = columns_text[7] if usual > 7 else nothing
        return RawTracks(
            self.name,
            np.array([k for k, _ in good], dtype=np.int64),
            "line",
            left + 0.5 * width, top + 0.5 * height, width, height,
            np.zeros(len(good), dtype=np.bool_),
            _known(columns_text[1]),
            _known(kind),
            numbers[6] if usual > 6 else np.full(len(good), np.nan),
            report,
            frame=frame,
            # Frames count from 1 in the format; files that begin with frame 0 count from there.
            first_frame=0 if np.nanmin(frame, initial=1.0) <= 0.0 else 1,
        )  # fmt: skip


def _lines(text: str) -> list[tuple[int, list[str]]]:
    """Line number and values of every line with content."""
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip().rstrip(",;")
        if stripped and not stripped.startswith("#"):
            found.append((number, _values(stripped)))
    return found


def _values(line: str) -> list[str]:
    """The values of a line; a comma is a decimal one between semicolons and tabs."""
    for delimiter in (";", "\t"):
        values = [value.strip() for value in line.split(delimiter)]
        if len(values) >= MIN_VALUES and "," in line:
            return [value.replace(",", ".") for value in values]
    return re.split(r"\s*[,;]\s*|\s+", line)


def _numeric(values: list[str]) -> bool:
    return all(re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|nan|inf", v) for v in values)


def _known(text: pa.StringArray) -> pa.StringArray:
    """A column in which -1 stands for nothing."""
    missing = pc.is_in(text, value_set=pa.array(["-1", "-1.0"]))
    return pc.if_else(missing, "", text)
