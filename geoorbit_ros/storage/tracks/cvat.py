"""Tracks as CVAT's XML for video: `<track id label><box frame outside xtl ytl xbr ybr/>`.

A box with `outside="1"` says that the object is no longer in the image. Source: CVAT's XML
annotation format 1.1.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as Xml

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import Treatment
from geoorbit_ros.storage.tracks.box_list import BoxList, as_size, parse_xml
from geoorbit_ros.storage.tracks.raw_tracks import RawTracks


class Cvat:
    """`TrackFormat` for CVAT for video."""

    name = "CVAT for video"
    expected = "CVAT XML for video, <annotations> with <track>s"

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether the root is `<annotations>`."""
        return b"<annotations" in head

    def read(self, path: Path, columns: dict[str, str]) -> RawTracks:
        """See `TrackFormat.read`; there are no columns."""
        root = parse_xml(path, self.expected)
        if root.find("track") is None and root.find("image") is not None:
            found = "CVAT's format for images, which has no tracks"
            raise InputFileError(str(path), found, self.expected)
        boxes, shapes = BoxList(), 0
        for track in root.iter("track"):
            for box in track:
                if box.get("outside") == "1":
                    continue
                if box.tag != "box":
                    shapes += 1
                    continue
                corners = tuple(box.get(name) for name in ("xtl", "ytl", "xbr", "ybr"))
                boxes.add(box.get("frame"), track.get("id"), track.get("label"), None, corners)  # type: ignore[arg-type]
        raw = boxes.raw(self.name, str(path))
        if shapes:
            raw.report.note(Treatment.NOTED, f"{shapes} shapes are no boxes and are not used")
        raw.image_size = _image_size(root)
        return raw


def _image_size(root: Xml.Element) -> tuple[int, int] | None:
    size = root.find(".//original_size")
    if size is None:
        return None
    return as_size(size.findtext("width"), size.findtext("height"))
