"""Boxes of XML and JSON files, met one by one, as arrays; XML that can't be read."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import pyarrow as pa

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.storage.tracks.raw_tracks import RawTracks


@dataclass(slots=True)
class BoxList:
    """Boxes one by one, as elements of an XML or JSON file are met."""

    frame: list[float] = field(default_factory=list)
    track_id: list[str] = field(default_factory=list)
    class_name: list[str] = field(default_factory=list)
    score: list[float] = field(default_factory=list)
    corners: list[tuple[float, float, float, float]] = field(default_factory=list)

    def add(
        self,
        frame: object,
        track_id: object,
        class_name: object,
        score: object,
        corners: tuple[object, object, object, object],
    ) -> None:
        """Take one box; left, top, right, bottom. What is no number becomes NaN."""
        self.frame.append(as_number(frame))
        self.track_id.append("" if track_id in (None, "", -1, "-1") else str(track_id))
        self.class_name.append("" if class_name is None else str(class_name))
        self.score.append(as_number(score))
        left, top, right, bottom = (as_number(value) for value in corners)
        self.corners.append((left, top, right, bottom))

    def raw(self, name: str, place: str) -> RawTracks:
        """The boxes as arrays."""
        box = np.array(self.corners, dtype=np.float64).reshape(-1, 4)
        report = InputReport(place, "boxes", len(box))
        return RawTracks(
            name,
            np.arange(1, len(box) + 1),
            "box",
            0.5 * (box[:, 0] + box[:, 2]),
            0.5 * (box[:, 1] + box[:, 3]),
            box[:, 2] - box[:, 0],
            box[:, 3] - box[:, 1],
            np.zeros(len(box), dtype=np.bool_),
            pa.array(self.track_id, pa.string()),
            pa.array(self.class_name, pa.string()),
            np.array(self.score),
            report,
            frame=np.array(self.frame),
        )


MAX_SIDE_PX = 1e5
"""No image is larger: the largest cameras have 1e4 pixels in a row."""


def as_number(value: object) -> float:
    """A number, or NaN for what is none."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def as_size(width: object, height: object) -> tuple[int, int] | None:
    """Width and height of an image in pixels; None where they can't be those of one."""
    sides = as_number(width), as_number(height)
    if not all(0.0 < side <= MAX_SIDE_PX for side in sides):
        return None
    return int(sides[0]), int(sides[1])


def parse_xml(path: Path, expected: str) -> Xml.Element:
    """The root of an XML file.

    Raises:
        InputFileError: It can't be read, or breaks off.
    """
    try:
        return Xml.parse(path).getroot()
    except OSError as error:
        raise InputFileError(str(path), error.strerror or str(error), expected) from None
    except Xml.ParseError as error:
        raise InputFileError(str(path), f"XML that can't be read ({error})", expected) from None
