"""Tracks as UA-DETRAC XML: `<frame num><target id><box left top width height/>`.

Source: Wen et al. 2020, UA-DETRAC: 25 images per second, 960x540.
"""

from __future__ import annotations

from pathlib import Path

from geoorbit_ros.storage.tracks.box_list import BoxList, as_number, parse_xml
from geoorbit_ros.storage.tracks.raw_tracks import RawTracks

FPS = 25.0
"""Frame rate of the benchmark's recordings (Wen et al. 2020, section 3.1)."""


class UaDetrac:
    """`TrackFormat` for UA-DETRAC's annotations."""

    name = "UA-DETRAC"
    expected = "UA-DETRAC XML, <sequence> of <frame>s"

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether a `<sequence` holds a `<frame`."""
        return b"<sequence" in head and (b"<frame" in head or b"<ignored_region" in head)

    def read(self, path: Path, columns: dict[str, str]) -> RawTracks:
        """See `TrackFormat.read`; there are no columns."""
        boxes = BoxList()
        for frame in parse_xml(path, self.expected).iter("frame"):
            for target in frame.iter("target"):
                box, attribute = target.find("box"), target.find("attribute")
                values = box.attrib if box is not None else {}
                left, top, width, height = (
                    as_number(values.get(name)) for name in ("left", "top", "width", "height")
                )
                kind = attribute.get("vehicle_type") if attribute is not None else None
                corners = (left, top, left + width, top + height)
                boxes.add(frame.get("num"), target.get("id"), kind, None, corners)
        raw = boxes.raw(self.name, str(path))
        raw.first_frame, raw.fps = 1, FPS
        return raw
