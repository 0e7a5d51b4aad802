"""An MCAP file, record by record (https://mcap.dev/spec): complete, without index, or cut off.

A recorder that is killed leaves a file without its end. The readers of rosbags and rosbag2 need
that end, or the index in it; this one needs the records alone, and uses the summary at the end to
be quick where there is one.
"""

from __future__ import annotations

import re
import struct
import zlib
from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import pyarrow as pa

from geoorbit_ros.storage.bag_file import (
    MCAP_MAGIC,
    Channel,
    Faults,
    Stored,
    printable,
    ros_type,
    unpack_beginning,
)

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
"""Codes of records; other ones are passed over, as the specification says."""
CHUNK_INDEX, STATISTICS = 0x08, 0x0B
"""Codes of records in the summary."""
MAX_CHUNK_BYTES = 1 << 30
"""Chunks that say they are larger are damaged. Chosen: rosbag2 writes 768 KiB, other programs some
megabytes; larger lets a damaged number take all memory."""
DAMAGED = "messages in a damaged chunk"
SEARCHED_BYTES = 1 << 22
"""So far behind a damage the next message is looked for. Chosen: more takes seconds."""
NEAR_NS = 86_400 * 10**9
"""The next message is of the same day: other bytes that look like one are not."""
_RUN = 1000
"""Messages outside of chunks that are put in order at once. Chosen: more take memory."""
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, time of receipt, time of publication
_CHUNK = struct.Struct("<QQQI")  # start, end, size and checksum of the unpacked records
_INDEX = struct.Struct("<HI")  # channel, bytes of its entries
_ENTRY = struct.Struct("<QQ")  # time, place in the unpacked chunk
_FOOTER_BYTES = 20 + _RECORD.size + len(MCAP_MAGIC)


@dataclass(slots=True)
class _Block:
    """Messages that stand together in a file: a chunk, or a run of messages outside of chunks.

    Attributes:
        at: Where the chunk's content begins.
        size: Its bytes that are there.
        start_ns: Time of the earliest message.
        whole: Whether all of it is there.
        counts: Messages by channel, None if not known.
        index: Channel of each of its index records, where its entries stand, and their bytes.
        loose: Time, channel, place and size of each message of a run.
    """

    at: int
    size: int
    start_ns: int
    whole: bool = True
    counts: Counter[int] | None = None
    index: list[tuple[int, int, int]] = field(default_factory=list)
    loose: list[tuple[int, int, int, int]] = field(default_factory=list)


class McapFile:
    """One MCAP file, of any profile.

    Args:
        path: A file that begins with `MCAP_MAGIC`.
        faults: Takes what is wrong with it.

    Attributes:
        channels: By number, those of other encodings than ROS 2's included.
        start_ns: Time of the first message; 0 without one.
        end_ns: Time of the last.
    """

    def __init__(self, path: Path, faults: Faults) -> None:
        self.channels: dict[int, Channel] = {}
        self.start_ns = self.end_ns = 0
        self._path, self._faults = path, faults
        self._blocks: list[_Block] = []
        self._schemas: dict[int, tuple[str, str]] = {0: ("", "")}
        self._raw_channels: dict[int, tuple[int, str, str]] = {}
        self._statistics: tuple[int, int, int, Counter[int]] | None = None
        with path.open("rb") as file:
            self._walk(file)
            if not self._known():
                self._look_into_blocks(file)
        self._name_channels()

    def close(self) -> None:
        """Nothing is held open."""

    def messages(self, channels: Collection[int]) -> Iterator[Stored]:
        """Messages of these channels in the order of their time."""
        blocks = [
            block
            for block in self._blocks
            if block.counts is None or not block.counts.keys().isdisjoint(channels)
        ]
        blocks.sort(key=lambda block: block.start_ns)
        waiting: list[Stored] = []
        with self._path.open("rb") as file:
            for k, block in enumerate(blocks):
                waiting += [m for m in self._read(file, block) if m.channel in channels]
                waiting.sort(key=lambda message: message.time_ns)
                if k + 1 < len(blocks):
                    start_ns = blocks[k + 1].start_ns
                    ready = bisect_left(waiting, start_ns, key=lambda message: message.time_ns)
                    yield from waiting[:ready]
                    del waiting[:ready]
        yield from waiting

    def _walk(self, file: BinaryIO) -> None:
        """Find all records of the file, without looking into chunks."""
        end, at = self._path.stat().st_size, len(MCAP_MAGIC)
        while True:
            file.seek(at)
            head = file.read(_RECORD.size)
            if len(head) < _RECORD.size:
                self._cut_off(end)
                return
            code, size = _RECORD.unpack(head)
            at += _RECORD.size
            if code == FOOTER:
                file.seek(min(at + size, end))
                if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
                    self._cut_off(end)
                return
            if code == 0 or (at + size > end and code != CHUNK):
                resume = self._next_message(file, at, end) or self._after_damage(file, at, end)
                if resume is None:
                    self._cut_off(end)
                    return
                place = f"{self._path.name}, byte {at - _RECORD.size}"
                self._faults.leave_out(0, "records that can't be read are passed over", place)
                at = resume
                continue
            self._take(file, code, at, min(size, end - at), at + size <= end)
            if at + size > end:
                self._cut_off(end)
                return
            at += size

    def _take(self, file: BinaryIO, code: int, at: int, size: int, whole: bool) -> None:
        """One record of the file."""
        if code == MESSAGE:
            if size >= _MESSAGE.size:
                channel, _, time_ns, _ = _MESSAGE.unpack(file.read(_MESSAGE.size))
                self._loose(channel, time_ns, at, size)
        elif code == CHUNK:
            head = file.read(_CHUNK.size)
            if len(head) == _CHUNK.size:
                self._blocks.append(_Block(at, size, _CHUNK.unpack(head)[0], whole))
        elif code == MESSAGE_INDEX and size >= _INDEX.size:
            channel, length = _INDEX.unpack(file.read(_INDEX.size))
            if self._blocks and not self._blocks[-1].loose:
                block = self._blocks[-1]
                length = min(length, size - _INDEX.size)
                block.index.append((channel, at + _INDEX.size, length))
                block.counts = (block.counts or Counter()) + Counter({channel: length // 16})
        elif code in (SCHEMA, CHANNEL, STATISTICS):
            self._describe(code, file.read(size))

    def _loose(self, channel: int, time_ns: int, at: int, size: int) -> None:
        """A message outside of chunks."""
        last = self._blocks[-1] if self._blocks else None
        if last is None or not last.loose or len(last.loose) >= _RUN:
            last = _Block(at, 0, time_ns, counts=Counter())
            self._blocks.append(last)
        assert last.counts is not None
        last.counts[channel] += 1
        last.start_ns = min(last.start_ns, time_ns)
        last.loose.append((time_ns, channel, at + _MESSAGE.size, size - _MESSAGE.size))

    def _describe(self, code: int, data: bytes) -> None:
        """A schema, a channel or the statistics."""
        try:
            if code == SCHEMA:
                (number,) = struct.unpack_from("<H", data)
                name, at = _text(data, 2)
                self._schemas[number] = name, _text(data, at)[0]
            elif code == CHANNEL:
                number, schema = struct.unpack_from("<HH", data)
                topic, at = _text(data, 4)
                self._raw_channels[number] = schema, topic, _text(data, at)[0]
            else:
                messages, start_ns, end_ns = struct.unpack_from("<Q18xQQ", data)
                (length,) = struct.unpack_from("<I", data, 42)
                counts = Counter(dict(struct.iter_unpack("<HQ", data[46 : 46 + length])))
                self._statistics = messages, start_ns, end_ns, counts
        except (struct.error, UnicodeDecodeError):
            place = f"{self._path.name}, record of code {code}"
            self._faults.leave_out(0, "a record that can't be read", place)

    def _known(self) -> bool:
        """Whether the summary tells channels, counts and times, so that no chunk need be read."""
        if self._statistics is None:
            return False
        messages, start_ns, end_ns, counts = self._statistics
        self.start_ns, self.end_ns = (start_ns, end_ns) if messages else (0, 0)
        used = set(counts).union(*(block.counts or () for block in self._blocks))
        schemas = {self._raw_channels[n][0] for n in used if n in self._raw_channels}
        return (
            used <= self._raw_channels.keys()
            and schemas <= self._schemas.keys()
            and counts.total() == messages
            and all(block.whole for block in self._blocks)
        )

    def _look_into_blocks(self, file: BinaryIO) -> None:
        """Find channels, counts and times by reading all chunks."""
        times: list[int] = []
        for block in self._blocks:
            found = self._read(file, block)
            if found or not block.counts:  # else it is left out, and counted
                block.counts = Counter(message.channel for message in found)
            block.start_ns = min((m.time_ns for m in found), default=block.start_ns)
            times += [m.time_ns for m in found[:1]] + [max((m.time_ns for m in found), default=0)]
        counts = sum((block.counts or Counter() for block in self._blocks), Counter[int]())
        starts = [block.start_ns for block in self._blocks if block.counts]
        self.start_ns, self.end_ns = min(starts, default=0), max(times, default=0)
        self._statistics = counts.total(), self.start_ns, self.end_ns, counts

    def _name_channels(self) -> None:
        assert self._statistics is not None
        counts = self._statistics[3]
        for number in sorted(self._raw_channels.keys() | counts.keys()):
            schema, topic, encoding = self._raw_channels.get(number, (0, "", ""))
            name, written_in = self._schemas.get(schema, ("", ""))
            if not encoding and (written_in.startswith("ros2") or not topic):
                encoding = "cdr"
            if encoding == "cdr":
                name = ros_type(name)
            self.channels[number] = Channel(topic, name, encoding, counts[number])

    def _read(self, file: BinaryIO, block: _Block) -> list[Stored]:
        """Messages of a block, in the order of the file."""
        found = []
        if block.loose:
            for time_ns, channel, at, size in block.loose:
                file.seek(at)
                found.append(Stored(time_ns, channel, file.read(size)))
            return found
        data, at = self._unpacked(file, block), 0
        while at + _RECORD.size <= len(data):
            code, size = _RECORD.unpack_from(data, at)
            at += _RECORD.size
            if at + size > len(data):
                break
            if code == MESSAGE and size >= _MESSAGE.size:
                channel, _, time_ns, _ = _MESSAGE.unpack_from(data, at)
                found.append(Stored(time_ns, channel, data[at + _MESSAGE.size : at + size]))
            elif code in (SCHEMA, CHANNEL):
                self._describe(code, data[at : at + size])
            at += size
        expected = block.counts.total() if block.counts and data else len(found)
        if block.index and Counter(message.channel for message in found) != block.counts and data:
            found = self._by_index(file, block, data)
        place = f"{self._path.name}, byte {block.at}"
        if len(found) < expected:
            self._faults.leave_out(expected - len(found), DAMAGED, place)
        elif block.whole and at != len(data) and not block.index:
            self._faults.leave_out(0, DAMAGED, place)
        return found

    def _by_index(self, file: BinaryIO, block: _Block, data: bytes) -> list[Stored]:
        """Messages of a chunk with damaged records: those that are what its index says."""
        entries = []
        for channel, at, size in block.index:
            file.seek(at)
            content = file.read(size - size % _ENTRY.size)
            entries += [(at, time_ns, channel) for time_ns, at in _ENTRY.iter_unpack(content)]
        entries.sort()
        found = []
        ends = [at for at, _, _ in entries[1:]] + [len(data)]
        for (at, time_ns, channel), limit in zip(entries, ends, strict=True):
            begin = at + _RECORD.size
            if begin + _MESSAGE.size > limit:
                continue
            code, size = _RECORD.unpack_from(data, at)
            if code == MESSAGE and _MESSAGE.size <= size <= limit - begin:
                own, _, own_ns, _ = _MESSAGE.unpack_from(data, begin)
                if (own, own_ns) == (channel, time_ns):
                    content = data[begin + _MESSAGE.size : begin + size]
                    found.append(Stored(time_ns, channel, content))
        return found

    def _unpacked(self, file: BinaryIO, block: _Block) -> bytes:
        """A chunk's records; what can be had of one that is cut off, nothing of a damaged one."""
        file.seek(block.at)
        content = file.read(block.size)
        try:
            _, _, size, checksum = _CHUNK.unpack_from(content)
            packed_with, at = _text(content, _CHUNK.size)
            (length,) = struct.unpack_from("<Q", content, at)
        except (struct.error, UnicodeDecodeError):
            return self._lost(block, "a chunk whose head can't be read")
        packed = memoryview(content)[at + 8 : at + 8 + length]
        if packed_with not in ("", "lz4", "zstd") or size > MAX_CHUNK_BYTES:
            return self._lost(block, f"a chunk of {size} bytes packed with '{packed_with}'")
        if not block.whole:
            return unpack_beginning(packed, packed_with) if packed_with else bytes(packed)
        data = bytes(packed)
        if packed_with:
            try:
                data = pa.decompress(packed, size, codec=packed_with, asbytes=True)
            except OSError:
                return unpack_beginning(packed, packed_with) or self._lost(block, DAMAGED)
        damaged = bool(checksum) and zlib.crc32(data) != checksum
        return self._lost(block, "a chunk with a wrong checksum") if damaged else data

    def _lost(self, block: _Block, text: str) -> bytes:
        count = block.counts.total() if block.counts else 0
        self._faults.leave_out(count, text, f"{self._path.name}, byte {block.at}")
        return b""

    def _cut_off(self, size: int) -> None:
        """Note a file that ends before its end record."""
        self._faults.note(
            f"{self._path.name} has no end (cut off, or its recorder still runs); it is read as "
            f"far as it goes, {size} bytes"
        )

    def _next_message(self, file: BinaryIO, damaged: int, end: int) -> int | None:
        """The next message behind damaged records, in a file whose messages are in no chunks."""
        last = self._blocks[-1] if self._blocks else None
        if last is None or not last.loose:
            return None
        near_ns = last.loose[-1][0]
        file.seek(damaged)
        data = file.read(min(SEARCHED_BYTES, end - damaged))
        for found in re.finditer(bytes([MESSAGE]), data):
            at = found.start()
            if at + _RECORD.size + _MESSAGE.size > len(data):
                break
            _, size = _RECORD.unpack_from(data, at)
            channel, _, time_ns, _ = _MESSAGE.unpack_from(data, at + _RECORD.size)
            known = channel in self._raw_channels and abs(time_ns - near_ns) < NEAR_NS
            if known and _MESSAGE.size <= size <= end - damaged - at:
                return damaged + at
        return None

    def _after_damage(self, file: BinaryIO, damaged: int, end: int) -> int | None:
        """Where the next record stands behind damaged ones, by the index at the file's end."""
        file.seek(max(end - _FOOTER_BYTES, 0))
        footer = file.read()
        if len(footer) < _FOOTER_BYTES or not footer.endswith(MCAP_MAGIC) or footer[0] != FOOTER:
            return None
        (summary,) = struct.unpack_from("<Q", footer, _RECORD.size)
        starts = [summary] if damaged < summary < end else []
        at = summary
        while starts and at + _RECORD.size < end:
            file.seek(at)
            code, size = _RECORD.unpack(file.read(_RECORD.size))
            if code in (0, FOOTER) or at + _RECORD.size + size > end:
                break
            if code == CHUNK_INDEX:
                (start,) = struct.unpack_from("<16xQ", file.read(24))
                starts += [start] if damaged <= start < end else []
            at += _RECORD.size + size
        return min(starts, default=None)


def _text(data: bytes, at: int) -> tuple[str, int]:
    """A text with its length before it, and where the next field begins."""
    (length,) = struct.unpack_from("<I", data, at)
    if at + 4 + length > len(data):
        raise struct.error("a text that is longer than its record")
    return printable(data[at + 4 : at + 4 + length].decode()), at + 4 + length
