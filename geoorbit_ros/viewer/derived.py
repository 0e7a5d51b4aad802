"""Channels that show a topic in another form: boxes over the image, lanes on a map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import foxglove
from foxglove.channels import GeoJsonChannel, ImageAnnotationsChannel
from foxglove.messages import GeoJson

from geoorbit_ros.conversions import decode_string, decode_table
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE
from geoorbit_ros.viewer.annotations import box_annotations


@dataclass(frozen=True, slots=True)
class Derived:
    """One such channel.

    Attributes:
        topic: Its name.
        send: Takes a serialised message of the topic it comes from, and the time in nanoseconds;
            raises MessageError for one that can't be used.
        close: Withdraws it.
    """

    topic: str
    send: Callable[[bytes, int], None]
    close: Callable[[], None]


def derive(topic: str, context: foxglove.Context) -> Derived | None:
    """The further channel of a topic; None for most."""
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
