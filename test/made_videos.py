"""Small video files with one property each, made from what OpenCV writes."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from mjpeg_server import grey_image

FPS = 10.0
SIZE = (160, 120)
CODES = {".mp4": "mp4v", ".avi": "MJPG", ".webm": "VP80", ".mkv": "VP80"}
SINCE_1904_S = 2_082_844_800


def write_video(path: Path, count: int = 20, fps: float = FPS, *, noise: bool = False) -> Path:
    """A film whose images become brighter, or are noise and so all of one size in the file."""
    random = np.random.default_rng(1)
    code = cv2.VideoWriter.fourcc(*CODES[path.suffix])
    writer = cv2.VideoWriter(str(path.absolute()), cv2.CAP_FFMPEG, code, fps, SIZE)
    for k in range(count):
        shape = (SIZE[1], SIZE[0], 3)
        plain = grey_image(10 + 200 * k // count, SIZE)
        writer.write(random.integers(0, 255, shape, dtype=np.uint8) if noise else plain)
    writer.release()
    return path


def write_jpeg_stream(path: Path, count: int = 20) -> Path:
    """JPEG images one after the other, as `ffmpeg -c:v mjpeg film.mjpeg` writes them."""
    images = [cv2.imencode(".jpg", grey_image(10 * k, SIZE))[1].tobytes() for k in range(count)]
    path.write_bytes(b"".join(images))
    return path


def patched(path: Path, name: bytes, offset: int, value: bytes) -> Path:
    """The file with `value` written `offset` bytes after the first place of a box's name."""
    data = bytearray(path.read_bytes())
    at = data.index(name) + len(name) + offset
    data[at : at + len(value)] = value
    path.write_bytes(bytes(data))
    return path


def cut(path: Path, share: float) -> Path:
    """The file without its end."""
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    return path


def boxes(data: bytes, start: int, end: int) -> list[tuple[bytes, int, int]]:
    """Name, start and end of the boxes of an MP4 file."""
    found = []
    while start + 8 <= end:
        size, name = struct.unpack_from(">I4s", data, start)
        found.append((name, start, start + size))
        start += size
    return found


def with_edit_list(path: Path, first_s: float, length_s: float) -> Path:
    """As `ffmpeg -ss … -c copy` trims: all images are there, an edit list says which are shown."""
    data = path.read_bytes()
    _, start, end = next(b for b in boxes(data, 0, len(data)) if b[0] == b"moov")
    moov = data[start:end]
    _, a, b = next(box for box in boxes(moov, 8, len(moov)) if box[0] == b"trak")
    (scale,) = struct.unpack_from(">I", moov, moov.index(b"mvhd") + 4 + 12)
    (ticks,) = struct.unpack_from(">I", moov, moov.index(b"mdhd") + 4 + 12)
    entry = struct.pack(">IiI", round(length_s * scale), round(first_s * ticks), 1 << 16)
    edits = struct.pack(">I4sI4sII", 8 + 8 + 8 + 12, b"edts", 8 + 8 + 12, b"elst", 0, 1) + entry
    inside = [moov[s:e] for name, s, e in boxes(moov, a + 8, b) if name != b"edts"]
    track = inside[0] + edits + b"".join(inside[1:])
    track = struct.pack(">I4s", len(track) + 8, b"trak") + track
    moov = moov[8:a] + track + moov[b:]
    path.write_bytes(data[:start] + struct.pack(">I4s", len(moov) + 8, b"moov") + moov + data[end:])
    return path


def with_index_first(path: Path) -> Path:
    """As `-movflags +faststart` writes: a file that is cut then lacks images, and not its index."""
    data = path.read_bytes()
    parts = {name: data[a:b] for name, a, b in boxes(data, 0, len(data))}
    moov = bytearray(parts[b"moov"])
    at = moov.index(b"stco") + 4
    (count,) = struct.unpack_from(">I", moov, at + 4)
    for k in range(count):
        (place,) = struct.unpack_from(">I", moov, at + 8 + 4 * k)
        struct.pack_into(">I", moov, at + 8 + 4 * k, place + len(moov))
    rest = [parts[name] for name in parts if name not in (b"ftyp", b"moov")]
    path.write_bytes(parts[b"ftyp"] + bytes(moov) + b"".join(rest))
    return path
