"""One file of a rosbag2 bag: what MCAP and SQLite files have in common, and the SQLite ones.

Files are read as far as they go. What can't be read is left out, counted, and told with its place.
"""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import pyarrow as pa

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import InputReport, Treatment

MCAP_MAGIC = b"\x89MCAP0\r\n"
"""Begin and end of an MCAP file (https://mcap.dev/spec)."""
SQLITE_MAGIC = b"SQLite format 3\0"
"""Begin of a SQLite file (https://sqlite.org/fileformat2.html#the_database_header)."""
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""Begin of what is packed with zstd (RFC 8878, section 3.1.1)."""
EXPECTED = "a rosbag2 bag (a folder with .mcap or .db3 files, or one such file)"
_PIECE = 1 << 12
"""Bytes unpacked at once. Chosen: larger loses more before a break, smaller takes longer."""

_FOREIGN = (
    (b"#ROSBAG V", "a ROS 1 bag", "; rosbags-convert --src FILE.bag --dst FOLDER makes one of it"),
    (b"version https://git-lfs", "a pointer of Git LFS", "; git lfs pull fetches the file itself"),
    (b"PK\x03\x04", "a zip archive", ", unpacked"),
    (b"\x1f\x8b", "a gzip archive", ", unpacked"),
    (b"\x04\x22\x4d\x18", "a file packed with lz4", ", unpacked"),
    (b"\xfd7zXZ", "an xz archive", ", unpacked"),
    (b"BZh", "a bzip2 archive", ", unpacked"),
)
"""Beginnings of files that people take for bags: what they are, and what to do about it."""


@dataclass(slots=True)
class Channel:
    """Messages of one topic from one source.

    Attributes:
        topic: Its name.
        message_type: As in ROS 2, `package/msg/Name`; empty if not known.
        encoding: Of the messages; `cdr` in ROS 2.
        messages: How many.
    """

    topic: str
    message_type: str
    encoding: str
    messages: int = 0

    @property
    def readable(self) -> bool:
        """Whether its messages are ROS 2 messages of a known type."""
        return self.encoding == "cdr" and bool(self.message_type)


class Stored(NamedTuple):
    """One message of a file: time of receipt, number of its channel, content."""

    time_ns: int
    channel: int
    data: bytes


@dataclass(slots=True)
class Faults:
    """What was wrong with the files of a bag, each kind with its count and first place.

    Attributes:
        counts: Messages left out, by kind.
        places: Where each kind was found first.
        notes: On the bag as a whole.
        absent: How many of the messages left out are not in the files at all.
    """

    counts: Counter[str] = field(default_factory=Counter)
    places: dict[str, str] = field(default_factory=dict)
    notes: dict[str, Treatment] = field(default_factory=dict)
    absent: int = 0
    _seen: set[tuple[str, str]] = field(default_factory=set)

    def leave_out(self, count: int, text: str, place: str, absent: bool = False) -> None:
        """Count messages that are left out; a place that is read again counts once."""
        if (text, place) not in self._seen:
            self._seen.add((text, place))
            self.counts[text] += count
            self.absent += count if absent else 0
            self.places.setdefault(text, place)

    def note(self, text: str, treatment: Treatment = Treatment.REPAIRED) -> None:
        """Tell something about the bag as a whole, once."""
        self.notes.setdefault(text, treatment)

    def report(self, place: str, total: int) -> InputReport:
        """All of it, of `total` messages in the files."""
        report = InputReport(place, "messages", total + self.absent)
        for text, treatment in self.notes.items():
            report.note(treatment, text)
        for text, count in self.counts.items():
            report.add(Treatment.LEFT_OUT, count, text, self.places[text])
            if not count:
                report.note(Treatment.LEFT_OUT, text, self.places[text])
        return report


def printable(text: str) -> str:
    """A text out of a file that may be damaged, for a line of a terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


class BagFile(Protocol):
    """One opened file of a bag.

    Attributes:
        channels: By number.
        start_ns: Time of the first message; 0 without one.
        end_ns: Time of the last.
    """

    channels: dict[int, Channel]
    start_ns: int
    end_ns: int

    def messages(self, channels: Collection[int]) -> Iterator[Stored]:
        """Messages of these channels in the order of their time."""
        ...

    def close(self) -> None:
        """Close the file; no more messages can be read."""
        ...


def ros_type(name: str) -> str:
    """A message type as ROS 2 spells it, from the ways in which other programs do."""
    parts = [part for part in re.split(r"::|/", name) if part]
    if "dds_" in parts:  # as DDS names them on the wire
        parts.remove("dds_")
        parts[-1] = parts[-1].removesuffix("_")
    return "/".join([parts[0], "msg", parts[1]] if len(parts) == 2 else parts)


def recognise(path: Path) -> bytes:
    """Which of the three magics of this module a file begins with.

    Raises:
        InputFileError: None of them: what it is instead. Or it can't be read.
    """
    try:
        with path.open("rb") as file:
            head = file.read(512)
    except OSError as error:
        raise InputFileError(str(path), error.strerror or str(error), EXPECTED) from None
    for magic in (MCAP_MAGIC, SQLITE_MAGIC, ZSTD_MAGIC):
        if head.startswith(magic):
            return magic
    if not head:
        raise InputFileError(str(path), "an empty file", EXPECTED)
    for begin, kind, hint in _FOREIGN:
        if head.startswith(begin):
            raise InputFileError(str(path), kind, EXPECTED + hint)
    if not head.strip(b"\0"):
        raise InputFileError(str(path), "a file that begins with zeros, no bag's", EXPECTED)
    if b"\0" not in head:
        raise InputFileError(
            str(path),
            "a text file",
            f"{EXPECTED}; track files go to --tracks, or `bag from-csv` makes a bag of them",
        )
    raise InputFileError(str(path), "a file that is neither MCAP nor SQLite", EXPECTED)


def unpack(data: bytes | memoryview) -> bytes:
    """All of something packed with zstd, of unknown size.

    Raises:
        OSError: It isn't, or not all of it is there.
    """
    return bytes(pa.CompressedInputStream(pa.BufferReader(data), "zstd").read())


def unpack_beginning(data: bytes | memoryview, codec: str) -> bytes:
    """As much as can be unpacked of something that is cut off."""
    parts: list[bytes] = []
    try:
        stream = pa.CompressedInputStream(pa.BufferReader(data), codec)
        while part := stream.read(_PIECE):
            parts.append(part)
    except OSError:  # where it is cut off
        pass
    return b"".join(parts)


def unpacked_file(path: Path, folder: Path, faults: Faults) -> Path:
    """A file packed as a whole with zstd, unpacked into a folder as far as it goes."""
    target = folder / path.name.removesuffix(".zstd").removesuffix(".zst")
    try:
        with (
            target.open("wb") as file,
            pa.CompressedInputStream(pa.OSFile(str(path)), "zstd") as stream,
        ):
            while part := stream.read(_PIECE):
                file.write(part)
    except OSError as error:
        if error.errno:  # not of the packed data, but of the disk
            raise InputFileError(str(target), error.strerror, "room to unpack the bag") from None
        faults.note(f"{path.name} is cut off or damaged; it is read as far as it can be unpacked")
    return target


class SqliteFile:
    """Messages in a SQLite file of rosbag2.

    Args:
        path: The file.
        folder: For a copy, where the file as it lies there can't be read as it is.
        faults: Takes what is wrong with it.

    Raises:
        InputFileError: Not a database of rosbag2.
    """

    def __init__(self, path: Path, folder: Path, faults: Faults) -> None:
        self.channels: dict[int, Channel] = {}
        self.start_ns = self.end_ns = 0
        self._name, self._faults = path.name, faults
        source = self._sound_copy(path, folder)
        # What lies beside the file (-shm, -wal) is another program's business: leave it alone.
        state = "mode=rw" if source != path else "mode=ro&immutable=1"
        self._connection = sqlite3.connect(f"{source.absolute().as_uri()}?{state}", uri=True)
        self._connection.text_factory = lambda text: text.decode(errors="replace")
        if source != path:  # else SQLite reads nothing at all of a file that is cut off
            self._connection.execute("PRAGMA writable_schema=ON")
        self._open(path)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def messages(self, channels: Collection[int]) -> Iterator[Stored]:
        """Messages of these channels in the order of their time."""
        wanted = ",".join(str(number) for number in channels)
        query = f"FROM messages WHERE topic_id IN ({wanted})"
        columns = "SELECT timestamp, topic_id, data, id"
        if bool(np.all(np.diff(self._times) >= 0)):
            yield from self._rows(f"{columns} {query} ORDER BY id")
            return
        for number in self._ids[np.argsort(self._times, kind="stable")].tolist():
            yield from self._rows(f"{columns} {query} AND id = ?", number)

    def _open(self, path: Path) -> None:
        """Topics, and number and time of every message."""
        try:
            tables = dict(self._connection.execute("SELECT name, type FROM sqlite_master"))
            if not {"topics", "messages"} <= set(tables):
                found = "a SQLite database without the tables of a bag"
                raise InputFileError(str(path), found, EXPECTED)
            topics = "SELECT id, name, type, serialization_format FROM topics"
            for number, name, kind, encoding in self._connection.execute(topics):
                self.channels[number] = Channel(
                    printable(str(name)), ros_type(printable(str(kind))), str(encoding or "cdr")
                )
        except (sqlite3.Error, UnicodeDecodeError) as error:
            found = f"a SQLite file that is damaged ({printable(str(error))})"
            raise InputFileError(str(path), found, EXPECTED) from error
        index: list[tuple[int, int, int]] = []
        # Not by the index on time, which may be damaged where the messages are not.
        query = "SELECT id, topic_id, timestamp FROM messages NOT INDEXED ORDER BY id"
        try:
            index.extend(self._connection.execute(query))
        except (sqlite3.Error, UnicodeDecodeError) as error:
            self._cut_off(error, index)
        good = [row for row in index if all(isinstance(value, int) for value in row)]
        if len(good) < len(index):
            text = "messages without a time or a topic"
            self._faults.leave_out(len(index) - len(good), text, self._name, absent=True)
        table = np.array(good, np.int64).reshape(-1, 3)
        self._ids, self._times = table[:, 0], table[:, 2]
        for number, count in Counter(table[:, 1].tolist()).items():
            self.channels.setdefault(number, Channel("", "", "cdr")).messages = count
        if len(table):
            self.start_ns, self.end_ns = int(self._times.min()), int(self._times.max())

    def _rows(self, query: str, *values: int) -> Iterator[Stored]:
        number = 0
        try:
            for row in self._connection.execute(query, values):
                number = row[3]
                if isinstance(row[2], bytes) and isinstance(row[0], int):
                    yield Stored(row[0], row[1], row[2])
                else:
                    place = f"{self._name}, message {number}"
                    self._faults.leave_out(1, "messages without content", place)
        except (sqlite3.Error, UnicodeDecodeError) as error:
            left = int(np.count_nonzero(self._ids > number))
            self._faults.leave_out(
                left,
                f"the file is damaged ({printable(str(error))})",
                f"{self._name}, message {number + 1}",
            )

    def _cut_off(self, error: Exception, index: list[tuple[int, int, int]]) -> None:
        """Note where reading ended. SQLite gives rows one by one, so those before it are there."""
        self._faults.leave_out(
            0,
            f"the file is damaged or cut off ({printable(str(error))}); read as far as it goes",
            f"{self._name}, after message {index[-1][0] if index else 0}",
        )

    def _sound_copy(self, path: Path, folder: Path) -> Path:
        """The file, or a copy that SQLite can repair: a log left beside it, or pages missing."""
        logs = [path.with_name(path.name + end) for end in ("-wal", "-journal")]
        logs = [log for log in logs if log.is_file() and log.stat().st_size]
        missing = self._missing_bytes(path)
        if not logs and not missing:
            return path
        copy = folder / path.name
        shutil.copyfile(path, copy)
        for log in logs:
            shutil.copyfile(log, folder / log.name)
            self._faults.note(
                f"messages in {log.name}, left by a recorder that was killed, are used"
            )
        if missing:
            size, page, announced = missing
            # A last page that is not whole would be filled with zeros and pass for messages.
            with copy.open("r+b") as file:
                file.truncate(size - size % page)
            self._faults.note(
                f"{path.name} is cut off ({size} of {announced} bytes); read as far as it goes"
            )
        return copy

    @staticmethod
    def _missing_bytes(path: Path) -> tuple[int, int, int] | None:
        """Size, page size and announced size of a file that is shorter than its header says."""
        with path.open("rb") as stream:
            header = stream.read(100)
        if len(header) < 100:
            return None
        page, pages = int.from_bytes(header[16:18]), int.from_bytes(header[28:32])
        page = 65536 if page == 1 else page
        current = header[24:28] == header[92:96]  # else an old SQLite wrote last and left `pages`
        size = path.stat().st_size
        return (size, page, pages * page) if current and page and size < pages * page else None
