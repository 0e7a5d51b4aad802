"""MCAP files byte by byte, as other programs and killed recorders leave them."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from geoorbit_ros.storage.pointcloud2 import MESSAGE_TYPE, encode_table

MAGIC = b"\x89MCAP0\r\n"
TRACKS = (MESSAGE_TYPE, "ros2msg", "cdr")
"""Schema name, schema encoding and message encoding of a topic of tracks."""


def record(code: int, content: bytes) -> bytes:
    return struct.pack("<BQ", code, len(content)) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


@dataclass
class MadeMcap:
    """Settings of an MCAP file; the defaults are those of rosbag2.

    Attributes:
        channels: Topic, schema name, schema encoding and message encoding by number; a schema
            name of None writes no schema.
        chunk: Messages per chunk; 0 writes no chunks.
    """

    channels: Mapping[int, tuple[str, str | None, str, str]]
    profile: str = "ros2"
    compression: str = "zstd"
    chunk: int = 100
    message_index: bool = True
    summary: bool = True
    statistics: bool = True
    chunk_index: bool = True
    footer: bool = True
    checksum: bool = True
    data: list[bytes] = field(default_factory=list)

    def content(self, messages: Iterable[tuple[int, int, bytes]]) -> bytes:
        """The file of messages: channel, time, content."""
        told = list(messages)
        head = record(1, text(self.profile) + text("another program"))
        names = self._names()
        parts = [MAGIC, head]
        if self.chunk:
            for k in range(0, len(told), self.chunk):
                parts += self._chunk(names, told[k : k + self.chunk])
        else:
            parts += [names, *(self._message(*one) for one in told)]
        self.data = list(parts)
        parts.append(record(0x0F, struct.pack("<I", 0)))
        if not self.footer:
            return b"".join(parts[:-1])
        start = len(b"".join(parts)) if self.summary else 0
        if self.summary:
            parts += [names, *([self._statistics(told)] if self.statistics else [])]
            parts += self._chunk_index() if self.chunk_index else []
        parts.append(record(2, struct.pack("<QQI", start, 0, 0)) + MAGIC)
        return b"".join(parts)

    def write(self, path: Path, messages: Iterable[tuple[int, int, bytes]]) -> Path:
        path.write_bytes(self.content(messages))
        return path

    def _names(self) -> bytes:
        parts = []
        for number, (topic, schema, written_in, encoding) in self.channels.items():
            if schema is not None:
                content = struct.pack("<H", number) + text(schema) + text(written_in) + text("x")
                parts.append(record(3, content))
            owner = 0 if schema is None else number
            content = struct.pack("<HH", number, owner) + text(topic) + text(encoding)
            parts.append(record(4, content + struct.pack("<I", 0)))
        return b"".join(parts)

    @staticmethod
    def _message(channel: int, time_ns: int, data: bytes) -> bytes:
        return record(5, struct.pack("<HIQQ", channel, 0, time_ns, time_ns) + data)

    def _chunk(self, names: bytes, told: list[tuple[int, int, bytes]]) -> list[bytes]:
        plain = names + b"".join(self._message(*one) for one in told)
        packed = plain
        if self.compression in ("zstd", "lz4"):
            packed = pa.compress(plain, codec=self.compression, asbytes=True)
        times = [time_ns for _, time_ns, _ in told]
        content = struct.pack("<QQQI", min(times), max(times), len(plain), self._checksum(plain))
        content += text(self.compression) + struct.pack("<Q", len(packed)) + packed
        index = self._message_index(len(names), told) if self.message_index else []
        return [record(6, content), *index]

    def _checksum(self, plain: bytes) -> int:
        return zlib.crc32(plain) if self.checksum else 0

    def _message_index(self, at: int, told: list[tuple[int, int, bytes]]) -> list[bytes]:
        entries: dict[int, bytes] = {number: b"" for number in self.channels}
        for channel, time_ns, data in told:
            entries[channel] += struct.pack("<QQ", time_ns, at)
            at += len(self._message(channel, time_ns, data))
        return [
            record(7, struct.pack("<HI", number, len(listed)) + listed)
            for number, listed in entries.items()
            if listed
        ]

    def _chunk_index(self) -> list[bytes]:
        found, at = [], 0
        for part in self.data:
            if part[:1] == b"\x06":
                place = struct.pack("<QQQQ", *struct.unpack_from("<QQ", part, 9), at, len(part))
                found.append(record(8, place + bytes(4 + 8) + text("") + bytes(16)))
            at += len(part)
        return found

    @staticmethod
    def _statistics(told: list[tuple[int, int, bytes]]) -> bytes:
        times = [time_ns for _, time_ns, _ in told] or [0]
        counts = {c: sum(one[0] == c for one in told) for c in {one[0] for one in told}}
        listed = b"".join(struct.pack("<HQ", c, n) for c, n in counts.items())
        head = struct.pack("<QHIIIIQQ", len(told), 0, len(counts), 0, 0, 0, min(times), max(times))
        return record(0x0B, head + struct.pack("<I", len(listed)) + listed)


def tables(
    stamps: Iterable[int], rows: Iterable[NDArray[np.void]], channel: int = 1
) -> list[tuple[int, int, bytes]]:
    """Messages of tracks, received when they were taken."""
    return [
        (channel, stamp, encode_table(stamp, "a_optical", table))
        for stamp, table in zip(stamps, rows, strict=True)
    ]
