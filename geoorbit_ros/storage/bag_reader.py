"""Any rosbag2 bag as serialised messages, without a ROS installation.

Bags are read as far as they go: without metadata, cut off, with a part missing. What was left out
is counted and told.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.storage.bag_file import (
    EXPECTED,
    MCAP_MAGIC,
    SQLITE_MAGIC,
    ZSTD_MAGIC,
    BagFile,
    Channel,
    Faults,
    SqliteFile,
    recognise,
    unpack,
    unpacked_file,
)
from geoorbit_ros.storage.bag_folder import METADATA, bag_files
from geoorbit_ros.storage.mcap_file import McapFile

Storage = Literal["mcap", "sqlite3"]

_UNREADABLE = "a message that can't be unpacked"


class BagMessage(NamedTuple):
    """One recorded message: topic, type, recording time and serialised content."""

    topic: str
    message_type: str
    time_ns: int
    cdr: bytes


@dataclass(frozen=True, slots=True)
class BagTopic:
    """One topic of a bag; what several publishers or recorders wrote on it counts as one.

    Attributes:
        name: Full name.
        message_type: Empty if not known.
        messages: How many.
        encoding: Of the messages; those of ROS 2 are in `cdr`, others can't be read.
    """

    name: str
    message_type: str
    messages: int
    encoding: str = "cdr"

    @property
    def readable(self) -> bool:
        """Whether its messages are ROS 2 messages of a known type."""
        return self.encoding == "cdr" and bool(self.message_type)


@dataclass(frozen=True, slots=True)
class BagInfo:
    """What `ros2 bag info` would tell.

    Attributes:
        path: As the user named it.
        storage: How the messages are stored.
        start_ns: Time of the first message; 0 without one.
        duration_ns: From the first message to the last.
        size_bytes: All files of the bag together.
        messages: On all topics.
        topics: Ordered by name.
        report: What is wrong with the bag, as far as it shows before all messages are read.
    """

    path: Path
    storage: Storage
    start_ns: int
    duration_ns: int
    size_bytes: int
    messages: int
    topics: tuple[BagTopic, ...]
    report: InputReport


class Bag:
    """An open bag.

    Args:
        path: As the user named it.
        folder: For what must be unpacked or copied.
        stack: Closes files.

    Attributes:
        path: As the user named it.
        faults: What is wrong with it; grows while messages are read.

    Raises:
        InputFileError: No bag, or none with a message that can be read.
    """

    def __init__(self, path: Path, folder: Path, stack: ExitStack) -> None:
        self.path = path
        self.faults = Faults()
        self.files: list[BagFile] = []
        self.paths, counts = bag_files(path, self.faults)
        for file in self.paths:
            opened = self._opened(file, folder, stack)
            self.files.append(opened)
            self._compare(file, opened, counts.get(file.name))
        self._check_encodings()

    @property
    def topics(self) -> tuple[BagTopic, ...]:
        """Ordered by name."""
        found: dict[tuple[str, str, str], int] = {}
        for file in self.files:
            for channel in file.channels.values():
                key = (channel.topic, channel.message_type, channel.encoding)
                found[key] = found.get(key, 0) + channel.messages
        return tuple(
            BagTopic(topic, kind, number, encoding)
            for (topic, kind, encoding), number in sorted(found.items())
        )

    def describe(self) -> BagInfo:
        """What is in it, as far as it is known without reading all messages."""
        filled = [file for file in self.files if file.end_ns or file.start_ns]
        topics = self.topics
        start_ns = min((file.start_ns for file in filled), default=0)
        return BagInfo(
            path=self.path,
            storage="sqlite3" if isinstance(self.files[0], SqliteFile) else "mcap",
            start_ns=start_ns,
            duration_ns=max((file.end_ns for file in filled), default=start_ns) - start_ns,
            size_bytes=sum(file.stat().st_size for file in self._all_files()),
            messages=sum(topic.messages for topic in topics),
            topics=topics,
            report=self.report(),
        )

    def report(self) -> InputReport:
        """What was left out so far, and why."""
        return self.faults.report(str(self.path), sum(topic.messages for topic in self.topics))

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """ROS 2 messages in the order of their recording time, one at a time.

        Args:
            topics: Only these, none if empty; default: all.
        """
        group: list[BagFile] = []
        for file in sorted(self.files, key=lambda file: file.start_ns):
            if group and file.start_ns > max(other.end_ns for other in group):
                yield from self._merged(group, topics)
                group = []
            group.append(file)
        yield from self._merged(group, topics)

    def _merged(
        self, files: Collection[BagFile], topics: Collection[str] | None
    ) -> Iterator[BagMessage]:
        """Messages of files that overlap in time."""
        streams = [self._of_file(file, topics) for file in files]
        yield from heapq.merge(*streams, key=lambda message: message.time_ns)

    def _of_file(self, file: BagFile, topics: Collection[str] | None) -> Iterator[BagMessage]:
        wanted = {
            number: channel
            for number, channel in file.channels.items()
            if channel.readable and (topics is None or channel.topic in topics)
        }
        if not wanted:
            return
        for time_ns, number, data in file.messages(wanted):
            channel = wanted[number]
            content = data
            if data.startswith(ZSTD_MAGIC):  # CDR begins with a zero
                try:
                    content = unpack(data)
                except OSError:
                    self.faults.leave_out(1, _UNREADABLE, f"{channel.topic} at {time_ns} ns")
                    continue
            yield BagMessage(channel.topic, channel.message_type, time_ns, content)

    def _opened(self, file: Path, folder: Path, stack: ExitStack) -> BagFile:
        magic = recognise(file)
        if magic == ZSTD_MAGIC:
            file = unpacked_file(file, folder, self.faults)
            magic = recognise(file)
        if magic not in (MCAP_MAGIC, SQLITE_MAGIC):
            raise InputFileError(str(self.path), f"{file.name}, packed twice", EXPECTED)
        opened: BagFile = (
            McapFile(file, self.faults)
            if magic == MCAP_MAGIC
            else SqliteFile(file, folder, self.faults)
        )
        stack.callback(opened.close)
        return opened

    def _compare(self, file: Path, opened: BagFile, announced: int | None) -> None:
        """Hold the messages of a file against what the metadata says of it."""
        found = sum(channel.messages for channel in opened.channels.values())
        if announced is not None and found < announced:
            text = f"more messages in {METADATA} than in the file"
            place = f"{file.name}, {found} of {announced}"
            self.faults.leave_out(announced - found, text, place, absent=True)

    def _check_encodings(self) -> None:
        """Say which messages are none of ROS 2.

        Raises:
            InputFileError: None is.
        """
        foreign: dict[str, list[Channel]] = {}
        readable = 0
        for file in self.files:
            for channel in file.channels.values():
                readable += channel.readable
                if channel.encoding != "cdr":
                    foreign.setdefault(channel.encoding or "of no encoding", []).append(channel)
        if foreign and not readable:
            kind = "an MCAP" if isinstance(self.files[0], McapFile) else "a bag"
            found = f"{kind} without ROS 2 messages ({', '.join(sorted(foreign))})"
            raise InputFileError(str(self.path), found, "a bag with ROS 2 messages (cdr)")
        for encoding, channels in foreign.items():
            count = sum(channel.messages for channel in channels)
            text = f"messages that are not ROS 2's but {encoding}"
            self.faults.leave_out(count, text, channels[0].topic)
        for topic in self.topics:
            if topic.encoding == "cdr" and not topic.message_type:
                place = topic.name or "without a topic"
                self.faults.leave_out(topic.messages, "messages without a type", place)

    def _all_files(self) -> list[Path]:
        """The bag's files and what belongs to them."""
        beside = {p.parent / METADATA for p in self.paths} if self.path.is_dir() else set()
        return [*self.paths, *(file for file in beside if file.is_file())]


@contextmanager
def open_bag(path: str | Path) -> Iterator[Bag]:
    """Open a bag: its folder, one of its files, its metadata.yaml, or a folder with one bag in it.

    Raises:
        InputFileError: No bag, or none with a message that can be read.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="geoorbit_bag_")))
        yield Bag(Path(path), folder, stack)


def describe_bag(path: str | Path) -> BagInfo:
    """What is in a bag; an empty bag is no error here.

    Raises:
        InputFileError: As `open_bag`.
    """
    with open_bag(path) as bag:
        return bag.describe()


def bag_messages(path: str | Path, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
    """All messages of a bag in the order of their recording time, one at a time.

    Args:
        path: As for `open_bag`.
        topics: Only these, none if empty; default: all.

    Raises:
        InputFileError: As `open_bag`.
    """
    with open_bag(path) as bag:
        yield from bag.messages(topics)
