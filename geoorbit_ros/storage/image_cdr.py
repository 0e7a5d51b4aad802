"""Images in serialised ROS messages, found without a Python object per byte."""

from __future__ import annotations

import struct

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.cdr import CdrReader
from geoorbit_ros.core.errors import MessageError

COMPRESSED = "sensor_msgs/msg/CompressedImage"
RAW = "sensor_msgs/msg/Image"

_SHAPE = struct.Struct("<II")  # height, width
_CONVERSIONS: dict[str, tuple[int, int | None]] = {
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "8UC4": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "mono8": (1, cv2.COLOR_GRAY2BGR),
    "8UC1": (1, cv2.COLOR_GRAY2BGR),
}
"""Channels and how they become BGR, by sensor_msgs/image_encodings."""

StampedPicture = tuple[int, str, NDArray[np.uint8]]
"""Capture time in nanoseconds, frame id, and (H, W, 3) blue, green, red."""


def decode_compressed_image(cdr: bytes, place: str) -> StampedPicture:
    """The image of a serialised `sensor_msgs/CompressedImage`: JPEG, PNG, WebP, ….

    Grey becomes three equal channels; of 16 bits a channel the upper eight are kept.

    Args:
        cdr: The message.
        place: Topic, for the error.

    Raises:
        MessageError: A message cut short, or bytes that are no whole image.
    """
    stamp_ns, frame_id, kind, data = _compressed(cdr, place)
    decoded = None
    if len(data):
        # A rotated camera would say so in the file: pixels stay where control points expect them.
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        try:
            decoded = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error:  # a header that claims an absurd size
            decoded = None
    if decoded is None:
        found = f"{len(data)} bytes of '{kind}' that are no whole image"
        raise MessageError(place, found, "a JPEG, PNG or other image")
    return stamp_ns, frame_id, np.asarray(decoded, dtype=np.uint8)


_REDUCED = {
    1: cv2.IMREAD_GRAYSCALE,
    2: cv2.IMREAD_REDUCED_GRAYSCALE_2,
    4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
    8: cv2.IMREAD_REDUCED_GRAYSCALE_8,
}


def decode_reduced(
    cdr: bytes, place: str, size: tuple[int, int], step: int
) -> StampedPicture | None:
    """A compressed image in grey, reduced while it is decoded: a third of the time of the whole.

    Args:
        cdr: A serialised `sensor_msgs/CompressedImage`.
        place: Topic, for the error.
        size: (width, height) that the whole image is expected to have.
        step: 1, 2, 4 or 8.

    Returns:
        Stamp, frame id and (H // step, W // step) of whole pixels; None for an image that can't be
        decoded, or of another size.

    Raises:
        MessageError: A message cut short.
    """
    stamp_ns, frame_id, _, data = _compressed(cdr, place)
    if not len(data):
        return None
    flag = _REDUCED[step] | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        small = cv2.imdecode(np.frombuffer(data, np.uint8), flag)
    except cv2.error:
        return None
    width, height = size
    if small is None or small.shape != (-(-height // step), -(-width // step)):
        return None
    return stamp_ns, frame_id, np.asarray(small[: height // step, : width // step], np.uint8)


def _compressed(cdr: bytes, place: str) -> tuple[int, str, str, memoryview]:
    reader = CdrReader(cdr, place, f"a {COMPRESSED}")
    stamp_ns, frame_id = reader.header()
    return stamp_ns, frame_id, reader.text(), reader.data()


def decode_image(cdr: bytes, place: str) -> StampedPicture:
    """The image of a serialised `sensor_msgs/Image` of 8 bits a channel.

    Raises:
        MessageError: A message cut short, another encoding, or sizes that contradict each other.
    """
    reader = CdrReader(cdr, place, f"a {RAW}")
    stamp_ns, frame_id = reader.header()
    height, width = reader.unpack(_SHAPE)
    encoding = reader.text()
    reader.number("B")  # is_bigendian, which 8 bits a channel don't need
    step, data = reader.whole("I"), reader.data()
    channels, code = _CONVERSIONS.get(encoding, (0, None))
    if not channels:
        raise MessageError(place, f"encoding '{encoding}'", f"one of {', '.join(_CONVERSIONS)}")
    if not (height and width) or step < width * channels or len(data) < height * step:
        found = f"{width}x{height} in rows of {step} bytes, {len(data)} bytes of data"
        raise MessageError(place, found, f"rows of {width * channels} bytes, all of them")
    rows = np.frombuffer(data, np.uint8, height * step).reshape(height, step)
    pixels = rows[:, : width * channels].reshape(height, width, channels)
    if code is None:
        return stamp_ns, frame_id, np.ascontiguousarray(pixels)
    return stamp_ns, frame_id, np.asarray(cv2.cvtColor(pixels, code), dtype=np.uint8)
