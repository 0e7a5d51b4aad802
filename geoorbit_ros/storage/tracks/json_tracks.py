"""Tracks in JSON: OTVision's `.ottrk`, supervision's JSONSink, Ultralytics' results.

OTVision compresses its files with bzip2. Ultralytics' `to_json()` gives one list of objects per
image: such lists are read one after another, in a list, or one per line. Sources: OTVision's
`dataformat.py`, supervision 0.30 `json_sink.py`, the documentation of Ultralytics' `Results`.
"""

from __future__ import annotations

import bz2
import json
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import Treatment
from geoorbit_ros.storage.tracks.box_list import BoxList, as_number, as_size
from geoorbit_ros.storage.tracks.csv_table import MAX_TIME_S
from geoorbit_ros.storage.tracks.csv_text import decode
from geoorbit_ros.storage.tracks.raw_tracks import RawTracks

_BZIP2 = b"BZh"
_FRAME_KEYS = ("frame", "frame_index", "frame_id", "frame_number", "frame_num", "frame_idx")
_NS = 10**9


class OtVision:
    """`TrackFormat` for OTVision's `.ottrk`."""

    name = "OTVision"
    expected = "an .ottrk file of OTVision"

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether it is compressed by bzip2, or has OTVision's metadata in plain JSON."""
        return head.startswith(_BZIP2) or b'"otdet_version"' in head or b'"ottrk_version"' in head

    def read(self, path: Path, columns: dict[str, str]) -> RawTracks:
        """See `TrackFormat.read`; there are no columns."""
        content = _load(path, self.expected)
        place = str(path)
        data = content.get("data") if isinstance(content, Mapping) else None
        rows = data.get("detections") if isinstance(data, Mapping) else None
        if rows is None and isinstance(data, Mapping):
            found = "OTVision's detections, which have no ids"
            raise InputFileError(place, found, f"{self.expected}: track them first")
        if not isinstance(rows, list):
            raise InputFileError(place, "no list data.detections", self.expected)
        boxes, moments, interpolated = BoxList(), [], 0
        for row in rows:
            if not isinstance(row, Mapping):
                continue
            x, y, w, h = (as_number(row.get(name)) for name in ("x", "y", "w", "h"))
            corners = (x - 0.5 * w, y - 0.5 * h, x + 0.5 * w, y + 0.5 * h)
            identity = row.get("track-id", row.get("track_id"))
            score = row.get("confidence")
            boxes.add(row.get("frame"), identity, row.get("class"), score, corners)
            moments.append(_moment_ns(row.get("occurrence")))
            interpolated += bool(row.get("interpolated-detection"))
        raw = boxes.raw(self.name, place)
        raw.stamp_ns = np.array(moments, dtype=np.int64)
        video = _part(_part(content, "metadata"), "video", "vid")
        fps = as_number(video.get("recorded_fps"))
        raw.fps = fps if fps > 0 else None
        raw.first_frame = 1
        raw.image_size = as_size(video.get("width"), video.get("height"))
        if len(set(moments)) * 2 < len(set(boxes.frame)):
            raw.stamp_ns = None  # times of whole seconds, or of the video's start
        if interpolated:
            raw.report.note(Treatment.NOTED, f"{interpolated} boxes were interpolated by OTVision")
        return raw


class JsonBoxes:
    """`TrackFormat` for JSON written by supervision's JSONSink or from Ultralytics' results."""

    name = "JSON"
    expected = "JSON of supervision's JSONSink or of Ultralytics' results, with track ids"

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether it begins as a list or an object."""
        return head.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"[", b"{")

    def read(self, path: Path, columns: dict[str, str]) -> RawTracks:
        """See `TrackFormat.read`; there are no columns."""
        place, boxes = str(path), BoxList()
        unnumbered = 0
        for number, row in _rows(_load(path, self.expected)):
            frame = next((row[key] for key in _FRAME_KEYS if key in row), number)
            unnumbered += frame is None
            corners = _corners(row)
            identity = row.get("tracker_id", row.get("track_id", row.get("id")))
            kind = row.get("class_name", row.get("name", row.get("class_id", row.get("class"))))
            boxes.add(frame, identity, kind, row.get("confidence", row.get("conf")), corners)
        if not boxes.frame:
            raise InputFileError(place, "no boxes", self.expected)
        if unnumbered == len(boxes.frame):
            found = "boxes that don't say in which image they are"
            expected = f"a key {' or '.join(_FRAME_KEYS[:2])} (custom data of JSONSink)"
            raise InputFileError(place, found, expected)
        return boxes.raw(self.name, place)


def _part(content: Mapping[str, Any], *names: str) -> Mapping[str, Any]:
    """The first member of these names that has members itself; an empty one where none has."""
    parts = (content.get(name) for name in names)
    return next((part for part in parts if isinstance(part, Mapping)), {})


def _load(path: Path, expected: str) -> Any:
    """A JSON value, or a list of the values of JSON Lines."""
    place = str(path)
    try:
        data = path.read_bytes()
        if data.startswith(_BZIP2):
            data = bz2.decompress(data)
    except FileNotFoundError:
        raise InputFileError(place, "no such file", expected) from None
    except (OSError, EOFError, ValueError) as error:
        raise InputFileError(place, f"a file that can't be read ({error})", expected) from None
    text = decode(data, place, expected)
    try:
        return json.loads(text)
    except (json.JSONDecodeError, RecursionError) as whole:
        lines = [line for line in text.splitlines() if line.strip()]
        try:
            return [json.loads(line) for line in lines]
        except (json.JSONDecodeError, RecursionError):
            found = f"JSON that breaks off or has a fault: {whole}"
            raise InputFileError(place, found, expected) from None


def _rows(content: Any) -> Iterable[tuple[int | None, Mapping[str, Any]]]:
    """All objects with a box, with the number of the image where lists count images."""
    if isinstance(content, Mapping):
        inner = next(
            (content[k] for k in ("detections", "predictions", "results", "frames", "data")
             if isinstance(content.get(k), list | Mapping)), None,
        )  # fmt: skip
        if inner is not None:
            yield from _rows(inner)
        else:
            for key, value in content.items():
                if isinstance(value, list):
                    number = int(key) if str(key).isdigit() else None
                    yield from ((number, row) for row in value if isinstance(row, Mapping))
        return
    if not isinstance(content, list):
        return
    for number, item in enumerate(content):
        if isinstance(item, list):
            yield from ((number, row) for row in item if isinstance(row, Mapping))
        elif isinstance(item, Mapping):
            rows = next(
                (item[k] for k in ("detections", "predictions", "results", "boxes")
                 if isinstance(item.get(k), list)), None,
            )  # fmt: skip
            if rows is None:
                yield None, item
                continue
            named = next((item[key] for key in _FRAME_KEYS if key in item), number)
            yield from ((named, row) for row in rows if isinstance(row, Mapping))


def _corners(row: Mapping[str, Any]) -> tuple[object, object, object, object]:
    box = row.get("box", row.get("bbox", row.get("xyxy", row)))
    if isinstance(box, list | tuple) and len(box) == 4:
        return (box[0], box[1], box[2], box[3])
    if not isinstance(box, Mapping):
        return (None, None, None, None)
    for names in (("x1", "y1", "x2", "y2"), ("x_min", "y_min", "x_max", "y_max")):
        if all(name in box for name in names):
            return (box[names[0]], box[names[1]], box[names[2]], box[names[3]])
    x, y, w, h = (as_number(box.get(n, box.get(m))) for n, m in
                  (("x", "x"), ("y", "y"), ("width", "w"), ("height", "h")))  # fmt: skip
    return (x - 0.5 * w, y - 0.5 * h, x + 0.5 * w, y + 0.5 * h)


def _moment_ns(value: object) -> int:
    """Capture time of OTVision: seconds since 1970, or a date of its format; -1 for none."""
    number = as_number(value)
    if np.isfinite(number):
        return round(number * _NS) if 0 <= number <= MAX_TIME_S else -1
    try:
        moment = datetime.fromisoformat(str(value)).replace(tzinfo=UTC)
    except ValueError:
        return -1
    return int(moment.replace(microsecond=0).timestamp()) * _NS + moment.microsecond * 1000
