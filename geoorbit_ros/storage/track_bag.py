"""Tracked boxes in rosbag2 bags, written and read without a ROS installation.

A track bag has one topic `/<camera_id>/tracks_px` of `sensor_msgs/msg/PointCloud2` with the fields
of `PIXEL_TRACK_DTYPE`. Message time and header stamp are the capture time of the frame.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
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

from geoorbit_ros.core.errors import (
    InputFileError,
    MessageError,
    ParameterError,
    TableError,
)
from geoorbit_ros.core.tables import (
    PIXEL_TRACK_DTYPE,
    Frames,
    first_bad_box,
    first_repeated_id,
)
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.bag_reader import (
    BagInfo,
    Storage,
    describe,
    describe_bag,
    messages,
    open_bag,
)
from geoorbit_ros.storage.pointcloud2 import MESSAGE_TYPE, decode_table, encode_table

__all__ = ["TrackBag", "describe_bag", "read_track_bag", "write_track_bag"]

_TOPIC = "tracks_px"
_BAG_VERSION: Literal[9] = 9
"""Metadata version of rosbag2 in Jazzy."""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
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
    """One camera's tracked boxes out of a bag; `frames` hold `PIXEL_TRACK_DTYPE`."""

    camera_id: str
    frames: Frames


def write_track_bag(
    path: str | Path, camera_id: str, frames: Frames, storage: Storage = "mcap"
) -> None:
    """Write a new bag; frames without rows become empty tables.

    Args:
        path: The bag's folder, which must not exist (or be empty).
        camera_id: The camera's namespace, one ROS name.
        frames: Rows of `PIXEL_TRACK_DTYPE`.
        storage: `mcap` is compressed (zstd chunks), a third of the size of `sqlite3`.

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
    with atomic_output(path) as temporary:
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


def read_track_bag(path: str | Path, camera_id: str | None = None) -> TrackBag:
    """Read one camera's tracked boxes from its topic `/<camera_id>/tracks_px`.

    Args:
        path: The bag's folder, or its only .mcap or .db3 file.
        camera_id: Which camera; may be left out when the bag holds one.

    Raises:
        InputFileError: No bag, an empty, incomplete or damaged one, or no such topic in it.
        MessageError: Another message type on the topic, a message that is no table of tracks,
            stamps that don't increase, a box that is none.
    """
    stamps: list[int] = []
    tables = []
    with open_bag(path) as reader:
        topic = _find_topic(describe(reader), camera_id)
        place = f"{path}, {topic}"
        for number, message in enumerate(messages(reader, [topic]), 1):
            here = f"{place}, message {number}"
            try:
                stamp_ns, _, rows = decode_table(message.cdr, PIXEL_TRACK_DTYPE, place)
            except MessageError as error:
                raise MessageError(here, error.found, error.expected) from None
            if stamps and stamp_ns <= stamps[-1]:
                found = f"stamp {stamp_ns / 1e9:.9f} s after {stamps[-1] / 1e9:.9f} s"
                raise MessageError(here, found, "stamps that increase")
            stamps.append(stamp_ns)
            tables.append(rows)
    offset = np.append(0, np.cumsum([len(rows) for rows in tables])).astype(np.int64)
    frames = Frames(np.array(stamps, np.int64), offset, np.concatenate(tables))
    _check_boxes(frames, place)
    return TrackBag(topic.removesuffix(f"/{_TOPIC}").strip("/"), frames)


def _find_topic(info: BagInfo, camera_id: str | None) -> str:
    """The topic with the camera's tracks, checked to hold some."""
    if not info.messages:
        raise InputFileError(str(info.path), "an empty bag", "a bag with messages")
    suffix = f"/{_TOPIC}" if camera_id is None else f"/{camera_id}/{_TOPIC}"
    found = [topic for topic in info.topics if topic.name.endswith(suffix)]
    wanted = f"a topic /{camera_id or '<camera_id>'}/{_TOPIC}"
    if not found:
        there = ", ".join(f"{topic.name} ({topic.message_type})" for topic in info.topics)
        raise InputFileError(str(info.path), f"only {there}", wanted)
    if len(found) > 1:
        names = ", ".join(topic.name for topic in found)
        raise InputFileError(
            str(info.path), f"{len(found)} cameras: {names}", "one, or a camera id that says which"
        )
    topic = found[0]
    if topic.message_type != MESSAGE_TYPE:
        raise MessageError(f"{info.path}, {topic.name}", f"type {topic.message_type}", MESSAGE_TYPE)
    if not topic.messages:
        raise InputFileError(
            str(info.path), f"no message on {topic.name}", "a message for every frame"
        )
    return topic.name


def _check_boxes(frames: Frames, place: str) -> None:
    for row, expected in (
        (first_bad_box(frames.rows), "finite numbers, sizes not negative"),
        (first_repeated_id(frames), "every id at most once in a message"),
    ):
        if row is not None:
            message = int(np.searchsorted(frames.offset, row, side="right"))
            box = ", ".join(
                f"{name} {frames.rows[name][row]:g}"
                for name in ("track_id", "x", "y", "width", "height", "score")
            )
            raise MessageError(f"{place}, message {message}", f"a box with {box}", expected)
