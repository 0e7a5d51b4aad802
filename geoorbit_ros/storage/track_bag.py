"""Tracked boxes in rosbag2 bags, written and read without a ROS installation.

A track bag has one topic `/<camera_id>/tracks_px` of `sensor_msgs/msg/PointCloud2` with the fields
of `PIXEL_TRACK_DTYPE`. Message time and header stamp are the capture time of the frame. How large
the image is says a `sensor_msgs/msg/CameraInfo` of the same camera, where the bag has one.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from geoorbit_ros.core.cdr import CdrReader
from geoorbit_ros.core.errors import (
    InputFileError,
    MessageError,
    ParameterError,
    TableError,
)
from geoorbit_ros.core.frame_order import capture_times
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.core.tables import FLAG_GROUND_POINT, PIXEL_TRACK_DTYPE, Frames
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.bag_file import Faults
from geoorbit_ros.storage.bag_reader import Bag, BagInfo, Storage, describe_bag, open_bag
from geoorbit_ros.storage.pointcloud2 import MESSAGE_TYPE, decode_table, encode_table
from geoorbit_ros.storage.tracks.cleaning import NO_ID, ReadOptions, clean_tracks
from geoorbit_ros.storage.tracks.raw_tracks import RawTracks

__all__ = ["TrackBag", "describe_bag", "read_track_bag", "write_track_bag"]

Stamps = NDArray[np.int64]

_EXPECTED = "a bag with tracked boxes"
_TOPIC = "tracks_px"
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_BAG_VERSION: Literal[9] = 9
"""Metadata version of rosbag2 in Jazzy."""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
_FOREVER = QosTime(9223372036, 854775807)
"""RMW_DURATION_INFINITE."""
_QOS = Qos(
    QosHistory.KEEP_LAST,
    100,
    QosReliability.RELIABLE,
    QosDurability.VOLATILE,
    _FOREVER,
    _FOREVER,
    QosLiveliness.AUTOMATIC,
    _FOREVER,
    False,
)
"""Reliable, so that `ros2 bag play` reaches subscribers that ask for it as well as others."""


@dataclass(frozen=True, slots=True)
class TrackBag:
    """One camera's tracked boxes out of a bag.

    Attributes:
        camera_id: The topic's namespace; empty for a topic without one.
        topic: Full name.
        frames: `PIXEL_TRACK_DTYPE`.
        report: What was done with messages and boxes.
    """

    camera_id: str
    topic: str
    frames: Frames
    report: InputReport


def write_track_bag(
    path: str | Path,
    camera_id: str,
    frames: Frames,
    storage: Storage = "mcap",
    *,
    overwrite: bool = False,
) -> None:
    """Write a new bag; frames without rows become empty tables.

    Args:
        path: The bag's folder, which must not exist (or be empty).
        camera_id: The camera's namespace, a ROS name or several with `/` between them.
        frames: Rows of `PIXEL_TRACK_DTYPE`.
        storage: `mcap` is compressed (zstd chunks), a third of the size of `sqlite3`.
        overwrite: Replace a folder that exists.

    Raises:
        InputFileError: `path` can't be written.
        ParameterError: A `camera_id` that is no ROS name.
        TableError: No frame, or rows of another type.
    """
    if not _NAME.fullmatch(camera_id):
        raise ParameterError("camera id", f"'{camera_id}'", "letters, digits and _, a letter first")
    if frames.rows.dtype != PIXEL_TRACK_DTYPE:
        raise TableError(f"{path}, rows to write", frames.rows.dtype.names, "those of tracks_px")
    if not len(frames):
        raise TableError(f"{path}, frames to write", "none", "at least one frame")
    definition = get_typestore(Stores.ROS2_JAZZY)
    with atomic_output(path, overwrite=overwrite) as temporary:
        plugin = StoragePlugin[storage.upper()]
        writer = Writer(temporary, version=_BAG_VERSION, storage_plugin=plugin)
        if plugin is StoragePlugin.MCAP:
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection(
                f"/{camera_id}/{_TOPIC}",
                MESSAGE_TYPE,
                typestore=definition,
                offered_qos_profiles=[_QOS],
            )
            for k, stamp_ns in enumerate(frames.stamp_ns.tolist()):
                cdr = encode_table(stamp_ns, f"{camera_id}_optical", frames.frame(k))
                writer.write(connection, stamp_ns, cdr)


def read_track_bag(
    path: str | Path, camera_id: str | None = None, options: ReadOptions | None = None
) -> TrackBag:
    """Read one camera's tracked boxes from its topic `/<camera_id>/tracks_px`.

    Boxes are cleaned as those of files (`storage.tracks.cleaning`). Frames are ordered by the
    stamps in the messages; messages with the same stamp become one frame.

    Args:
        path: The bag's folder, or one of its files.
        camera_id: Which camera; may be left out when the bag holds one.
        options: What the user says about the boxes.

    Raises:
        InputFileError: No bag, an empty one, no such topic in it, or one of whose messages or
            boxes most can't be used.
        MessageError: Another message type on the topic, or no message that is a table of tracks.
    """
    options = options or ReadOptions()
    with open_bag(path) as bag:
        topic = _find_topic(bag.describe(), camera_id)
        messages = _read_messages(bag, topic)
        report = InputReport(str(path), "boxes")
        report.include(bag.report())
        said = _image_size(bag, topic, report)
    report.include(messages.report)
    messages.report.check(options.strict, f"tables of tracks on {topic}")
    stamp_ns, run = capture_times(messages.stamp_ns, messages.received_ns, report)
    boxes = messages.boxes(report, stamp_ns, run)
    if not len(boxes):
        report.check(options.strict, _EXPECTED)
        options.size(said, report)
        frames = Frames(*_empty_frames(stamp_ns))
    else:
        boxes.image_size = said
        frames, report = clean_tracks(boxes, options, _EXPECTED)
        report.check(options.strict, _EXPECTED)
        frames = _with_empty(frames, stamp_ns)
    return TrackBag(topic.removesuffix(_TOPIC).strip("/"), topic, frames, report)


@dataclass(slots=True)
class _Messages:
    """Tables of one topic, M messages in the order of their receipt."""

    stamp_ns: Stamps
    received_ns: Stamps
    number: Stamps
    tables: list[NDArray[np.void]]
    report: InputReport

    def boxes(self, report: InputReport, stamp_ns: Stamps, run: Stamps) -> RawTracks:
        """All boxes, to be cleaned; ids of another run of the source are other tracks."""
        order = np.argsort(stamp_ns, kind="stable")
        stamp_ns, run, number = stamp_ns[order], run[order], self.number[order]
        tables = [self.tables[k] for k in order]
        rows = np.concatenate(tables)
        sizes = [len(table) for table in tables]
        track_id = rows["track_id"].astype(np.int64)
        if run.any():
            key = (np.repeat(run, sizes) << 32) + track_id
            track_id = np.where(track_id == NO_ID, NO_ID, np.unique(key, return_inverse=True)[1])
        report.total = len(rows)
        flags = rows["flags"]
        sizeless = (rows["width"] == 0) & (rows["height"] == 0)
        return RawTracks(
            format_name="bags",
            row=np.repeat(number, sizes),
            row_word="message",
            x=rows["x"].astype(np.float64),
            y=rows["y"].astype(np.float64),
            width=rows["width"].astype(np.float64),
            height=rows["height"].astype(np.float64),
            ground_point=sizeless | ((flags & FLAG_GROUND_POINT) != 0),
            track_id=pa.array(track_id).cast(pa.string()),
            class_name=pa.array(rows["class_id"]).cast(pa.string()),
            score=rows["score"].astype(np.float64),
            report=report,
            stamp_ns=np.repeat(stamp_ns, sizes),
            flags=flags,
        )


def _read_messages(bag: Bag, topic: str) -> _Messages:
    """All tables of a topic; messages that are none are left out, repeated ones used once."""
    place = f"{bag.path}, {topic}"
    stamps, received, numbers, tables = [], [], [], []
    refused = Faults()
    first_error: MessageError | None = None
    last: tuple[int, bytes] | None = None
    for number, message in enumerate(bag.messages([topic]), 1):
        here = f"message {number}"
        if message.message_type != MESSAGE_TYPE:
            refused.leave_out(1, f"of type {message.message_type}", here)
            continue
        try:
            stamp_ns, _, rows = decode_table(message.cdr, PIXEL_TRACK_DTYPE, place)
        except MessageError as error:
            first_error = first_error or MessageError(
                f"{place}, {here}", error.found, error.expected
            )
            refused.leave_out(1, "no tables of tracks", f"{here}: {error.found}")
            continue
        if last == (message.time_ns, message.cdr):
            refused.leave_out(1, "the same message again", here)
            continue
        last = message.time_ns, message.cdr
        stamps.append(stamp_ns)
        received.append(message.time_ns)
        numbers.append(number)
        tables.append(rows)
    if first_error and not tables:
        raise first_error
    if not tables:
        why = next(bag.report().sentences(), "")
        found = f"no message on {topic} that can be read" + (f": {why}" if why else "")
        raise InputFileError(str(bag.path), found, "a message for every frame")
    return _Messages(
        np.array(stamps, np.int64),
        np.array(received, np.int64),
        np.array(numbers, np.int64),
        tables,
        refused.report(str(bag.path), len(tables) + refused.counts.total()),
    )


def _image_size(bag: Bag, tracks: str, report: InputReport) -> tuple[int, int] | None:
    """What the camera's CameraInfo says; None where none does, or two say different things.

    It is on a topic in the camera's namespace, or, for a bag with one such topic, on any. What is
    wrong with it goes into the report.
    """
    topics = [t.name for t in bag.describe().topics if t.message_type == _CAMERA_INFO]
    own = [name for name in topics if name.startswith(tracks.removesuffix(_TOPIC))]
    sizes: dict[tuple[int, int], str] = {}
    for name in own or (topics if len(topics) == 1 else []):
        for message in bag.messages([name]):
            try:
                cdr = CdrReader(message.cdr, f"{bag.path}, {name}", f"a {_CAMERA_INFO}")
                cdr.header()
                height, width = cdr.whole("I"), cdr.whole("I")
            except MessageError as error:
                text = f"a CameraInfo on {name} can't be read: {error.found}"
                report.note(Treatment.NOTED, text)
                break
            if width and height:  # 0 x 0 stands for not known
                sizes.setdefault((width, height), name)
                break
    if len(sizes) > 1:
        said = ", ".join(f"{width}x{height} on {name}" for (width, height), name in sizes.items())
        report.note(Treatment.NOTED, f"CameraInfo says different sizes of the image: {said}")
    return next(iter(sizes)) if len(sizes) == 1 else None


def _empty_frames(stamp_ns: Stamps) -> tuple[Stamps, Stamps, NDArray[np.void]]:
    stamps = np.unique(stamp_ns)
    return stamps, np.zeros(len(stamps) + 1, np.int64), np.empty(0, PIXEL_TRACK_DTYPE)


def _with_empty(frames: Frames, stamp_ns: Stamps) -> Frames:
    """The frames and, between them, those in which nothing was seen."""
    stamps = np.union1d(stamp_ns, frames.stamp_ns)
    counts = np.zeros(len(stamps), np.int64)
    counts[np.searchsorted(stamps, frames.stamp_ns)] = np.diff(frames.offset)
    return Frames(stamps, np.append(0, np.cumsum(counts)).astype(np.int64), frames.rows)


def _find_topic(info: BagInfo, camera_id: str | None) -> str:
    """The topic with the camera's tracks, checked to hold some."""
    if not info.messages:
        first = next(info.report.sentences(), "")
        raise InputFileError(
            str(info.path), "an empty bag" + (f": {first}" if first else ""), "a bag with messages"
        )
    asked = None if camera_id is None else camera_id.strip("/").removesuffix(f"/{_TOPIC}")
    suffix = f"/{_TOPIC}" if asked is None else f"/{asked}/{_TOPIC}"
    found = [topic for topic in info.topics if topic.name.endswith(suffix)]
    if not found:  # one recorded in the root namespace may be called as the user likes
        found = [topic for topic in info.topics if topic.name == f"/{_TOPIC}"]
    wanted = f"a topic /{asked or '<camera_id>'}/{_TOPIC}"
    if not found:
        shown = [topic for topic in info.topics if topic.name]
        there = ", ".join(f"{topic.name} ({topic.message_type})" for topic in shown[:8])
        more = f" and {len(shown) - 8} more" if len(shown) > 8 else ""
        raise InputFileError(str(info.path), f"only {there}{more}", wanted)
    names = list(dict.fromkeys(topic.name for topic in found))
    if len(names) > 1:
        found_here = f"{len(names)} cameras: {', '.join(names)}"
        raise InputFileError(str(info.path), found_here, "one, or a camera id that says which")
    tables = [topic for topic in found if topic.message_type == MESSAGE_TYPE]
    if not tables:
        kind = found[0].message_type or f"unknown, in {found[0].encoding}"
        raise MessageError(f"{info.path}, {names[0]}", f"type {kind}", MESSAGE_TYPE)
    if not any(topic.messages for topic in tables):
        raise InputFileError(
            str(info.path), f"no message on {names[0]}", "a message for every frame"
        )
    return names[0]
