"""Tracks in JSON: OTVision's `.ottrk`, supervision's JSONSink, Ultralytics' results, COCO.

OTVision compresses its files with bzip2. Ultralytics' `to_json()` gives one list of objects per
image: such lists are read one after another, in a list, or one per line. Sources: OTVision's
`dataformat.py`, supervision 0.30 `json_sink.py`, the documentation of Ultralytics' `Results`,
COCO's "data format" and "results format" (cocodataset.org), with a track's id beside each box.
"""

from __future__ import annotations

import bz2
import json
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import Treatment
from geoorbit_ros.storage.tracks.box_list import BoxList, as_number, as_size
from geoorbit_ros.storage.tracks.csv_table import MAX_TIME_S, parse_times
from geoorbit_ros.storage.tracks.csv_text import decode
from geoorbit_ros.storage.tracks.raw_tracks import RawTracks

_BZIP2 = b"BZh"
_FRAME_KEYS = (
    "frame", "frame_index", "frame_id", "frame_number", "frame_num", "frame_idx", "image_id",
)  # fmt: skip
_BOX_KEYS = (
    "detections", "predictions", "results", "annotations", "tracks", "objects", "vehicles", "boxes",
)  # fmt: skip
"""Names of lists of boxes, in a file or in one image."""
_TIME_KEYS = (
    "time", "timestamp", "time_s", "timestamp_s", "time_ms", "timestamp_ms", "stamp_ns", "time_ns",
    "timestamp_ns", "datetime",
)  # fmt: skip
_COCO_NAMES = {
    1: "person",
    2: "bicycle",
    3: "car",
    4: "motorcycle",
    6: "bus",
    7: "train",
    8: "truck",
}
"""COCO's own category numbers of what is seen on roads; detectors count the same classes from 0."""
_NS = 10**9
NO_CORNERS_SHARE = 0.2
"""Where more boxes than this have their right side left of the left one, the numbers are no
corners. Chosen: of boxes with sizes it is nearly all, of corners the faulty ones."""


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
    """`TrackFormat` for JSON of supervision's JSONSink, of Ultralytics' results, or of COCO."""

    name = "JSON"
    expected = "JSON of supervision's JSONSink, of Ultralytics' results, or of COCO, with track ids"

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether it begins as a list or an object."""
        return head.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"[", b"{")

    def read(self, path: Path, columns: dict[str, str]) -> RawTracks:
        """See `TrackFormat.read`; there are no columns."""
        place, boxes = str(path), BoxList()
        content = _load(path, self.expected)
        images = _coco_images(content)
        rows = [*_rows(content)]
        coco = bool(images) or any("category_id" in row for _, row in rows)
        no_corners = sum(not _are_corners(row) for _, row in rows)
        corner_and_size = coco or no_corners > NO_CORNERS_SHARE * len(rows)
        name_of = _coco_names(content, rows)
        unnumbered, times = 0, list[str]()
        for number, row in rows:
            times.append(next((str(row[key]) for key in _TIME_KEYS if key in row), ""))
            frame = next((row[key] for key in _FRAME_KEYS if key in row), number)
            frame = images.get(frame, frame) if isinstance(frame, int | str) else frame
            unnumbered += frame is None
            kind = row.get("class_name", row.get("name", row.get("class_id", row.get("class"))))
            kind = (
                name_of.get(row.get("category_id"), row.get("category_id"))
                if kind is None
                else kind
            )
            score = next((row[key] for key in ("confidence", "conf", "score") if key in row), None)
            identity = _identity(row)
            if identity is None and not coco:  # in COCO it is the box's own
                identity = row.get("id")
            boxes.add(frame, identity, kind, score, _corners(row, corner_and_size))
        if not boxes.frame:
            raise InputFileError(place, "no boxes", self.expected)
        timed = sum(map(bool, times)) > 0.5 * len(times)
        if unnumbered == len(boxes.frame) and not timed:
            found = "boxes that don't say in which image they are"
            expected = f"a key {' or '.join(_FRAME_KEYS[:2])} (custom data of JSONSink)"
            raise InputFileError(place, found, expected)
        raw = boxes.raw(self.name, place)
        raw.image_size = _coco_size(content)
        if timed:
            raw.time_text = pa.array(times, pa.string())
            raw.stamp_ns = parse_times(raw.time_text, _time_key(rows), raw.report)
            raw.frame = None if unnumbered == len(boxes.frame) else raw.frame
        if coco:
            text = "COCO's boxes: x, y are the upper left corner, categories are COCO's"
            raw.report.note(Treatment.NOTED, text)
        elif corner_and_size:
            text = "bbox can't be corners: x, y, width, height from the upper left corner"
            raw.report.note(Treatment.REPAIRED, text)
        return raw


def _identity(row: Mapping[str, Any]) -> object:
    """A track's id, beside the box or among the attributes of CVAT's export."""
    attributes = row.get("attributes")
    places = (row, attributes if isinstance(attributes, Mapping) else {})
    keys = ("tracker_id", "track_id", "instance_id")
    return next((place[key] for place in places for key in keys if key in place), None)


def _time_key(rows: list[tuple[int | None, Mapping[str, Any]]]) -> str:
    return next(key for _, row in rows for key in _TIME_KEYS if key in row)


def _coco_images(content: Any) -> dict[int | str, object]:
    """Frame of each image by its id, for a file in COCO's data format."""
    listed = content.get("images") if isinstance(content, Mapping) else None
    images = [image for image in listed or () if isinstance(image, Mapping) and "id" in image]
    keys = [key for key in _FRAME_KEYS if images and all(key in image for image in images)]
    if keys:
        return {image["id"]: image[keys[0]] for image in images}
    names = sorted(images, key=lambda image: (str(image.get("file_name", "")), str(image["id"])))
    return {image["id"]: number for number, image in enumerate(names, 1)}


def _coco_size(content: Any) -> tuple[int, int] | None:
    """Size of the images, of a file in COCO's data format."""
    images = content.get("images") if isinstance(content, Mapping) else None
    first = images[0] if isinstance(images, list) and images else None
    return as_size(first.get("width"), first.get("height")) if isinstance(first, Mapping) else None


def _coco_names(content: Any, rows: list[tuple[int | None, Mapping[str, Any]]]) -> dict[Any, str]:
    """Names of categories by their numbers: the file's own, or COCO's.

    Programs write COCO's numbers (car 3) or those of detectors (car 2); cars are the most common.
    """
    own = content.get("categories") if isinstance(content, Mapping) else None
    if isinstance(own, list) and own:
        return {c["id"]: str(c.get("name")) for c in own if isinstance(c, Mapping) and "id" in c}
    numbers = [row.get("category_id") for _, row in rows]
    return _COCO_NAMES if numbers.count(3) >= numbers.count(2) else {}


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
    except (ValueError, RecursionError) as whole:  # also a number of too many digits
        lines = [line for line in text.splitlines() if line.strip()]
        try:
            return [json.loads(line) for line in lines]
        except (ValueError, RecursionError):
            found = f"JSON that breaks off or has a fault: {whole}"
            raise InputFileError(place, found, expected) from None


def _rows(content: Any) -> Iterable[tuple[int | None, Mapping[str, Any]]]:
    """All objects with a box, with the number of the image where lists count images."""
    if isinstance(content, Mapping):
        inner = next(
            (content[k] for k in (*_BOX_KEYS, "frames", "images", "data")
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
                (item[k] for k in _BOX_KEYS if isinstance(item.get(k), list)), None,
            )  # fmt: skip
            if rows is None:
                yield None, item
                continue
            named = next((item[key] for key in _FRAME_KEYS if key in item), number)
            yield from ((named, row) for row in rows if isinstance(row, Mapping))


def _box(row: Mapping[str, Any]) -> Any:
    return row.get("box", row.get("bbox", row.get("xyxy", row)))


def _are_corners(row: Mapping[str, Any]) -> bool:
    """Whether a box of four numbers may be left, top, right, bottom; True for other boxes."""
    box = _box(row)
    if not isinstance(box, list | tuple) or len(box) != 4:
        return True
    left, top, right, bottom = (as_number(value) for value in box)
    return not (right < left or bottom < top)


def _corners(
    row: Mapping[str, Any], corner_and_size: bool
) -> tuple[object, object, object, object]:
    """Left, top, right, bottom; lists are that, or the upper left corner with the size."""
    box = _box(row)
    if isinstance(box, list | tuple) and len(box) == 4:
        if not corner_and_size:
            return (box[0], box[1], box[2], box[3])
        left, top, width, height = (as_number(value) for value in box)
        return (left, top, left + width, top + height)
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
