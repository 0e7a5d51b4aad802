"""Any rosbag2 bag as serialised messages, without a ROS installation."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from rosbags.rosbag2 import Reader

from geoorbit_ros.core.errors import GeoOrbitError, InputFileError

Storage = Literal["mcap", "sqlite3"]

_EXPECTED = "a complete rosbag2 bag (a folder with metadata.yaml, or one .mcap or .db3 file)"


class BagMessage(NamedTuple):
    """One recorded message: topic, type, recording time and serialised content."""

    topic: str
    message_type: str
    time_ns: int
    cdr: bytes


@dataclass(frozen=True, slots=True)
class BagTopic:
    """One topic of a bag."""

    name: str
    message_type: str
    messages: int


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
    """

    path: Path
    storage: Storage
    start_ns: int
    duration_ns: int
    size_bytes: int
    messages: int
    topics: tuple[BagTopic, ...]


@contextmanager
def open_bag(path: str | Path) -> Iterator[Reader]:
    """A reader of a bag whose faults, on opening and while reading, are sentences about it.

    Args:
        path: The bag's folder, or its only .mcap or .db3 file.

    Raises:
        InputFileError: No bag, an incomplete or a damaged one.
    """
    folder = Path(path)
    if not folder.exists():
        raise InputFileError(str(path), "no such file or folder", _EXPECTED)
    if folder.is_dir() and not (folder / "metadata.yaml").is_file():
        recorded = sorted(f.name for f in folder.iterdir() if f.suffix in (".mcap", ".db3"))
        raise InputFileError(
            str(path),
            f"{recorded[0]} without metadata.yaml (a recording cut off?)"
            if recorded
            else "a folder without metadata.yaml",
            _EXPECTED,
        )
    if folder.is_file() and folder.suffix not in (".mcap", ".db3"):
        raise InputFileError(str(path), f"a file named '{folder.name}'", _EXPECTED)
    try:
        for file in folder.glob("*.db3") if folder.is_dir() else [folder]:
            _refuse_short_database(file)
        with Reader(folder) as reader:
            yield reader
    except GeoOrbitError:
        raise
    except Exception as error:
        # rosbags parses bytes that may be anything; beside its ReaderError come those of its
        # parsers (struct, zstd, apsw, yaml, IndexError, TypeError, ...).
        reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        raise InputFileError(
            str(path), f"a bag that is cut off or damaged ({reason})", _EXPECTED
        ) from error


def describe_bag(path: str | Path) -> BagInfo:
    """What is in a bag, from its metadata; an empty bag is no error here.

    Raises:
        InputFileError: As `open_bag`.
    """
    with open_bag(path) as reader:
        return describe(reader)


def describe(reader: Reader) -> BagInfo:
    """What is in an open bag."""
    path = Path(str(reader.path))
    files = list(path.iterdir()) if path.is_dir() else [path]
    return BagInfo(
        path=path,
        storage="mcap" if any(".mcap" in file.name for file in files) else "sqlite3",
        start_ns=reader.start_time if reader.message_count else 0,
        duration_ns=max(reader.duration - 1, 0),  # rosbags counts to after the last message
        size_bytes=sum(file.stat().st_size for file in files),
        messages=reader.message_count,
        topics=tuple(
            BagTopic(c.topic, c.msgtype, c.msgcount)
            for c in sorted(reader.connections, key=lambda c: c.topic)
        ),
    )


def bag_messages(path: str | Path, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
    """All messages of a bag in the order of their recording time, one at a time.

    Args:
        path: The bag's folder, or its only .mcap or .db3 file.
        topics: Only these, none if empty; default: all.

    Raises:
        InputFileError: As `open_bag`, or fewer messages than the metadata announces.
    """
    with open_bag(path) as reader:
        yield from messages(reader, topics)


def messages(reader: Reader, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
    """As `bag_messages`, from an open bag."""
    wanted = [c for c in reader.connections if topics is None or c.topic in topics]
    if not wanted:  # to rosbags an empty choice means every topic
        return
    count = 0
    for connection, time_ns, cdr in reader.messages(wanted):
        count += 1
        yield BagMessage(connection.topic, connection.msgtype, time_ns, cdr)
    announced = sum(c.msgcount for c in wanted)
    if count != announced:
        raise InputFileError(
            str(reader.path),
            f"{count} messages",
            f"{announced} as its metadata says (is it cut off?)",
        )


def _refuse_short_database(file: Path) -> None:
    """SQLite reads a last page that is cut off as if it ended in zeros; the header has its size.

    Raises:
        ValueError: The file is shorter than the header says
            (https://sqlite.org/fileformat2.html#the_database_header).
    """
    with file.open("rb") as stream:
        header = stream.read(100)
    if len(header) < 100 or not header.startswith(b"SQLite format 3\0"):
        return
    page_size, pages = int.from_bytes(header[16:18]), int.from_bytes(header[28:32])
    size = pages * (65536 if page_size == 1 else page_size)
    current = header[24:28] == header[92:96]  # else an old SQLite wrote last and left `pages` alone
    if current and file.stat().st_size < size:
        raise ValueError(f"{file.stat().st_size} of {size} bytes")
