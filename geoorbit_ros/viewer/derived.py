"""Channels that show a topic in a form viewers can draw: boxes over the image, lanes on a map."""

from __future__ import annotations

from collections.abc import Callable
from colorsys import hsv_to_rgb
from dataclasses import dataclass

import foxglove
import numpy as np
from foxglove.channels import GeoJsonChannel, ImageAnnotationsChannel
from foxglove.messages import (
    Color,
    GeoJson,
    ImageAnnotations,
    Point2,
    PointsAnnotation,
    PointsAnnotationType,
    TextAnnotation,
    Timestamp,
)
from numpy.typing import NDArray

from geoorbit_ros.conversions import decode_string, decode_table
from geoorbit_ros.core.tables import FLAG_PREDICTED, PIXEL_TRACK_DTYPE

GOLDEN = 0.618034
"""Step of the hue from id to id: the golden ratio keeps successive ids far apart."""
THICKNESS_PX, FONT_PX = 2.0, 14.0
"""Of boxes and labels. Layout of the image."""


def box_annotations(stamp_ns: int, rows: NDArray[np.void]) -> ImageAnnotations:
    """One rectangle and one label per vehicle; predicted boxes are drawn thin.

    Args:
        stamp_ns: Capture time of the image.
        rows: (N,) `PIXEL_TRACK_DTYPE`.
    """
    stamp = Timestamp(stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
    shapes, labels = [], []
    for row in rows:
        colour = track_colour(int(row["track_id"]))
        x, y, w, h = (float(row[key]) for key in ("x", "y", "width", "height"))
        left, top, right, bottom = x - w / 2, y - h / 2, x + w / 2, y + h / 2
        corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
        predicted = bool(row["flags"] & FLAG_PREDICTED)
        shapes.append(
            PointsAnnotation(
                timestamp=stamp,
                type=PointsAnnotationType.LineLoop,
                points=[Point2(x=a, y=b) for a, b in corners],
                outline_color=colour,
                thickness=0.5 * THICKNESS_PX if predicted else THICKNESS_PX,
            )
        )
        labels.append(
            TextAnnotation(
                timestamp=stamp,
                position=Point2(x=left, y=top),
                text=str(row["track_id"]),
                font_size=FONT_PX,
                text_color=colour,
            )
        )
    return ImageAnnotations(timestamp=stamp, points=shapes, texts=labels)


def track_colour(track_id: int) -> Color:
    """The colour of a track: the same id has the same colour in all viewers."""
    r, g, b = hsv_to_rgb(track_id * GOLDEN % 1.0, 0.7, 1.0)
    return Color(r=r, g=g, b=b, a=1.0)


@dataclass(frozen=True, slots=True)
class Derived:
    """A channel made from another topic.

    Attributes:
        topic: Name of the channel.
        send: Takes a serialised message of the topic it comes from, and the time in nanoseconds;
            raises MessageError for one that can't be used.
        close: Removes it.
    """

    topic: str
    send: Callable[[bytes, int], None]
    close: Callable[[], None]


def derive(topic: str, context: foxglove.Context) -> Derived | None:
    """The derived channel of a topic; None for most topics."""
    camera, _, name = topic.removeprefix("/").partition("/")
    if name == "tracks_px":
        return _boxes(topic, f"/{camera}/image/annotations", context)
    if name == "lanes/geojson":
        return _lanes(topic, f"/{camera}/lanes/map", context)
    return None


def _boxes(topic: str, shown: str, context: foxglove.Context) -> Derived:
    channel = ImageAnnotationsChannel(shown, context=context)

    def send(cdr: bytes, time_ns: int) -> None:
        stamp_ns, _, rows = decode_table(cdr, PIXEL_TRACK_DTYPE, topic)
        channel.log(box_annotations(stamp_ns, rows), log_time=time_ns)

    return Derived(shown, send, channel.close)


def _lanes(topic: str, shown: str, context: foxglove.Context) -> Derived:
    channel = GeoJsonChannel(shown, context=context)

    def send(cdr: bytes, time_ns: int) -> None:
        channel.log(GeoJson(geojson=decode_string(cdr, topic)), log_time=time_ns)

    return Derived(shown, send, channel.close)
