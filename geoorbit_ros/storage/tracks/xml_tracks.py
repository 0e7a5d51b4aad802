"""Tracks in XML: CVAT's for video, and UA-DETRAC's.

CVAT: `<track id label><box frame outside xtl ytl xbr ybr/>`; a box with `outside="1"` says that the
object is no longer in the image. Source: CVAT's XML annotation format 1.1.

UA-DETRAC: `<frame num><target id><box left top width height/>`. Source: Wen et al. 2020, UA-DETRAC:
25 images per second, 960x540.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as Xml

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import Treatment
from geoorbit_ros.storage.tracks.box_list import BoxList, as_number, as_size, parse_xml
from geoorbit_ros.storage.tracks.raw_tracks import RawTracks

FPS = 25.0
"""Frame rate of UA-DETRAC's recordings (Wen et al. 2020, section 3.1)."""


class Cvat:
    """`TrackFormat` for CVAT for video."""

    name = "CVAT for video"
    expected = "CVAT XML for video, <annotations> with <track>s"

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether the root is `<annotations>`."""
        return b"<annotations" in _plain(head)

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


class UaDetrac:
    """`TrackFormat` for UA-DETRAC's annotations."""

    name = "UA-DETRAC"
    expected = "UA-DETRAC XML, <sequence> of <frame>s"

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether a `<sequence` holds a `<frame`."""
        text = _plain(head)
        return b"<sequence" in text and (b"<frame" in text or b"<ignored_region" in text)

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


def _plain(head: bytes) -> bytes:
    """The beginning of a file in UTF-16 as one in UTF-8."""
    return head.replace(b"\0", b"")
