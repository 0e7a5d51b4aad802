"""Images in serialised ROS messages, found without a Python object per byte.

Layout: OMG DDS-RTPS 2.5 section 10 (plain CDR, little-endian) around sensor_msgs/CompressedImage
and sensor_msgs/Image. Alignment counts from after the 4-byte encapsulation header.
"""

from __future__ import annotations

import struct

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import MessageError

COMPRESSED = "sensor_msgs/msg/CompressedImage"
RAW = "sensor_msgs/msg/Image"

_CDR_LE = b"\x00\x01"
_U32 = struct.Struct("<I")
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


def stamp_of_image(cdr: bytes) -> int:
    """Capture time in nanoseconds of a serialised image of either kind, without looking further."""
    second, nanosecond = struct.unpack_from("<iI", cdr, 4)
    return int(second) * 1_000_000_000 + int(nanosecond)


def decode_compressed_image(cdr: bytes, place: str) -> StampedPicture:
    """The picture of a serialised `sensor_msgs/CompressedImage`: JPEG, PNG, WebP, ….

    Grey becomes three equal channels; of 16 bits a channel the upper eight are kept.

    Args:
        cdr: The message.
        place: Topic, for the error.

    Raises:
        MessageError: A message cut short, or bytes that are no whole picture.
    """
    try:
        stamp_ns, frame_id, at = _header(cdr, place, COMPRESSED)
        kind, at = _text(cdr, at)
        data, _ = _bytes(cdr, at)
    except (struct.error, UnicodeDecodeError):
        raise MessageError(place, f"{len(cdr)} bytes that break off", f"a {COMPRESSED}") from None
    picture = None
    if len(data):
        # A rotated camera would say so in the file: pixels stay where control points expect them.
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        try:
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error:  # a header that claims an absurd size
            picture = None
    if picture is None:
        found = f"{len(data)} bytes of '{kind}' that are no whole picture"
        raise MessageError(place, found, "a JPEG, PNG or other picture")
    return stamp_ns, frame_id, np.asarray(picture, dtype=np.uint8)


def decode_image(cdr: bytes, place: str) -> StampedPicture:
    """The picture of a serialised `sensor_msgs/Image` of 8 bits a channel.

    Raises:
        MessageError: A message cut short, another encoding, or sizes that contradict each other.
    """
    try:
        stamp_ns, frame_id, at = _header(cdr, place, RAW)
        height, width = struct.unpack_from("<II", cdr, at)
        encoding, at = _text(cdr, at + 8)
        at += 1 + -(at + 1 - 4) % 4  # is_bigendian, then the next number's alignment
        (step,) = _U32.unpack_from(cdr, at)
        data, _ = _bytes(cdr, at + 4)
    except (struct.error, UnicodeDecodeError):
        raise MessageError(place, f"{len(cdr)} bytes that break off", f"a {RAW}") from None
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


def _header(cdr: bytes, place: str, kind: str) -> tuple[int, str, int]:
    """Stamp, frame id, and where the next field begins, aligned to 4."""
    if cdr[:2] != _CDR_LE:
        raise MessageError(place, f"CDR encapsulation 0x{cdr[:2].hex()}", f"a little-endian {kind}")
    second, nanosecond = struct.unpack_from("<iI", cdr, 4)
    frame_id, at = _text(cdr, 12)
    return second * 1_000_000_000 + nanosecond, frame_id, at + -(at - 4) % 4


def _text(cdr: bytes, at: int) -> tuple[str, int]:
    """The string at `at`, which may need alignment, and where it ends."""
    data, end = _bytes(cdr, at + -(at - 4) % 4)
    return bytes(data[:-1]).decode(), end


def _bytes(cdr: bytes, at: int) -> tuple[memoryview, int]:
    """The sequence of bytes at `at`, which may need alignment, and where it ends."""
    at += -(at - 4) % 4
    (size,) = _U32.unpack_from(cdr, at)
    if len(cdr) < at + 4 + size:
        raise struct.error("cut short")
    return memoryview(cdr)[at + 4 : at + 4 + size], at + 4 + size
