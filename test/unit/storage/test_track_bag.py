from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from made_frames import assert_same, pixel_frames, steady_frames
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from geoorbit_ros.core.errors import (
    GeoOrbitError,
    InputFileError,
    MessageError,
    ParameterError,
    TableError,
)
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, TRACK_DTYPE, Frames
from geoorbit_ros.storage.bag_reader import Storage, bag_messages, describe_bag
from geoorbit_ros.storage.pointcloud2 import MESSAGE_TYPE, encode_table
from geoorbit_ros.storage.track_bag import read_track_bag, write_track_bag
from geoorbit_ros.storage.tracks.cleaning import ReadOptions

STORE = get_typestore(Stores.ROS2_JAZZY)
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
STORAGES: tuple[Storage, ...] = ("mcap", "sqlite3")
Message = tuple[str, str, int, bytes]


def foreign_bag(path: Path, messages: Iterable[Message], topics: dict[str, str]) -> Path:
    """A bag as some other program writes it: topics with their types, then messages."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            name: writer.add_connection(name, kind, typestore=STORE)
            for name, kind in topics.items()
        }
        for name, _, time_ns, cdr in messages:
            writer.write(connections[name], time_ns, cdr)
    return path


def track_messages(frames: Frames, topic: str = "/a/tracks_px") -> list[Message]:
    return [
        (topic, MESSAGE_TYPE, stamp, encode_table(stamp, "a_optical", frames.frame(k)))
        for k, stamp in enumerate(frames.stamp_ns.tolist())
    ]


FRAMES = steady_frames(40, 3, PIXEL_TRACK_DTYPE, start_ns=10**18)


@settings(deadline=None, max_examples=8)
@given(pixel_frames(), st.sampled_from(STORAGES))
def test_reading_undoes_writing(
    tmp_path_factory: pytest.TempPathFactory, frames: Frames, storage: Storage
) -> None:
    # Boxes of a pixel in the corner would be taken for shares of the image.
    numbers = [frames.rows[name] for name in ("x", "y", "width", "height")]
    assume(not len(frames.rows) or np.abs(numbers).max() > 2.0)
    path = tmp_path_factory.mktemp("bag") / "pole_7"
    write_track_bag(path, "pole_7", frames, storage)
    bag = read_track_bag(path)
    assert bag.camera_id == "pole_7"
    assert_same(bag.frames, frames)


@pytest.mark.parametrize("storage", STORAGES)
def test_any_ros_tool_finds_standard_messages(tmp_path: Path, storage: Storage) -> None:
    write_track_bag(tmp_path / "pole_7", "pole_7", FRAMES, storage)
    with AnyReader([tmp_path / "pole_7"]) as reader:
        (connection,) = reader.connections
        assert (connection.topic, connection.msgtype) == ("/pole_7/tracks_px", MESSAGE_TYPE)
        assert connection.digest == STORE.hash_rihs01(MESSAGE_TYPE)
        (profile,) = connection.ext.offered_qos_profiles  # type: ignore[union-attr]
        assert (profile.reliability.name, profile.durability.name) == ("RELIABLE", "VOLATILE")
        recorded = list(reader.messages())
        assert [time_ns for _, time_ns, _ in recorded] == FRAMES.stamp_ns.tolist()
        for found, time_ns, cdr in recorded:
            message: Any = reader.deserialize(cdr, found.msgtype)
            stamp = message.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == time_ns
            assert message.header.frame_id == "pole_7_optical"


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_describes_itself(tmp_path: Path, storage: Storage) -> None:
    write_track_bag(tmp_path / "pole_7", "pole_7", FRAMES, storage)
    info = describe_bag(tmp_path / "pole_7")
    assert info.storage == storage
    assert info.start_ns == FRAMES.stamp_ns[0]
    assert info.duration_ns == FRAMES.stamp_ns[-1] - FRAMES.stamp_ns[0]
    assert info.size_bytes == sum(f.stat().st_size for f in (tmp_path / "pole_7").iterdir())
    assert [(t.name, t.messages) for t in info.topics] == [("/pole_7/tracks_px", len(FRAMES))]
    (single,) = (f for f in (tmp_path / "pole_7").iterdir() if f.suffix != ".yaml")
    assert_same(read_track_bag(single).frames, FRAMES)  # the file alone will do
    assert describe_bag(single).duration_ns == info.duration_ns


def test_one_of_several_cameras(tmp_path: Path) -> None:
    other = steady_frames(5, 1, PIXEL_TRACK_DTYPE, start_ns=10**18)
    topics = {"/a/tracks_px": MESSAGE_TYPE, "/b/tracks_px": MESSAGE_TYPE, "/a/x": MESSAGE_TYPE}
    mixed = sorted(
        track_messages(FRAMES) + track_messages(other, "/b/tracks_px"), key=lambda m: m[2]
    )
    path = foreign_bag(tmp_path / "two", mixed, topics)
    assert_same(read_track_bag(path, "a").frames, FRAMES)
    assert_same(read_track_bag(path, "b").frames, other)
    with pytest.raises(InputFileError, match=r"2 cameras: /a/tracks_px, /b/tracks_px"):
        read_track_bag(path)
    with pytest.raises(InputFileError, match=r"only /a/tracks_px .*expected a topic /c/tracks_px"):
        read_track_bag(path, "c")
    assert len(list(bag_messages(path))) == len(mixed)
    assert len(list(bag_messages(path, ["/b/tracks_px"]))) == len(other)
    assert list(bag_messages(path, [])) == []


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("kept", [0, 1, 8, 60, 0.2, 0.5, 0.8, 0.99, -40, -1])
def test_a_bag_cut_off_anywhere_is_read_as_far_as_it_goes(
    tmp_path: Path, storage: Storage, kept: float
) -> None:
    frames = steady_frames(1500, 20, PIXEL_TRACK_DTYPE)
    path = tmp_path / "bag"
    write_track_bag(path, "a", frames, storage)
    (data,) = (f for f in path.iterdir() if f.suffix != ".yaml")
    content = data.read_bytes()
    keep = int(kept * len(content)) if 0 < kept < 1 else int(kept)
    data.write_bytes(content[:keep])
    if kept in (0, 1, 8, 60):
        with pytest.raises(InputFileError) as caught:
            read_track_bag(path)
        assert str(caught.value).isprintable()
        return
    bag = read_track_bag(path)
    number = len(bag.frames)
    assert_same(bag.frames, Frames(
        frames.stamp_ns[:number], frames.offset[: number + 1], frames.rows[: 20 * number]
    ))  # fmt: skip
    assert number >= (0.9 * min(kept, 1) - 0.1 if kept > 0 else 0.9) * len(frames)
    told = " ".join(bag.report.sentences())
    assert "read as far as it goes" in told
    if number < len(frames):
        assert f"{len(frames) - number} of {len(frames)} messages left out" in told
    with pytest.raises(InputFileError, match="--strict"):
        read_track_bag(path, options=ReadOptions(strict=True))


@pytest.mark.parametrize("content", ["", "rosbag2_bagfile_information: [", "a: 1", "\0", None])
def test_metadata_that_are_missing_or_damaged_are_not_needed(
    tmp_path: Path, content: str | None
) -> None:
    write_track_bag(tmp_path / "bag", "a", FRAMES)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    if content is not None:
        (tmp_path / "bag" / "metadata.yaml").write_text(content)
    bag = read_track_bag(tmp_path / "bag")
    assert_same(bag.frames, FRAMES)
    assert "metadata.yaml" in " ".join(bag.report.sentences())


def test_what_is_no_bag(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for name, content in (
        ("notes.txt", b"hello"),
        ("text.mcap", b"hello, this is no bag at all, but long enough for one"),
        ("ros1.bag", b"#ROSBAG V2.0\n" + bytes(100)),
        ("packed.zip", b"PK\x03\x04" + bytes(100)),
        ("none.mcap", b""),
        ("zeros.mcap", bytes(1000)),
        ("bag.mcap", b"version https://git-lfs.github.com/spec/v1\noid sha256:0"),
        ("other.db3", b"SQLite format 3\0" + bytes(200)),
        ("film.mcap", b"\0\0\0\x20ftypisom" + bytes(100)),
    ):
        (tmp_path / name).write_bytes(content)
    for name, found in (
        ("absent", "no such file"),
        ("folder", "folder without a bag's files"),
        ("notes.txt", "a text file.*--tracks"),
        ("text.mcap", "a text file"),
        ("ros1.bag", "a ROS 1 bag.*rosbags-convert"),
        ("packed.zip", "a zip archive"),
        ("none.mcap", "an empty file"),
        ("zeros.mcap", "begins with zeros"),
        ("bag.mcap", "a pointer of Git LFS"),
        ("other.db3", "SQLite file that is damaged"),
        ("film.mcap", "neither MCAP nor SQLite"),
    ):
        with pytest.raises(InputFileError, match=found) as caught:
            read_track_bag(tmp_path / name)
        assert str(caught.value).isprintable()


@pytest.mark.parametrize("topics", [{}, {"/a/tracks_px": MESSAGE_TYPE}])
def test_an_empty_bag(tmp_path: Path, topics: dict[str, str]) -> None:
    path = foreign_bag(tmp_path / "empty", [], topics)
    with pytest.raises(InputFileError, match="an empty bag"):
        read_track_bag(path)
    assert describe_bag(path).messages == 0
    assert describe_bag(path).duration_ns == 0


def test_bags_without_usable_tracks(tmp_path: Path) -> None:
    text = bytes(
        STORE.serialize_cdr(STORE.types["std_msgs/msg/String"]("x"), "std_msgs/msg/String")
    )
    string = {"/a/tracks_px": "std_msgs/msg/String"}
    path = foreign_bag(tmp_path / "type", [("/a/tracks_px", "", 1, text)], string)
    with pytest.raises(MessageError, match=r"type std_msgs/msg/String, expected sensor_msgs"):
        read_track_bag(path)

    path = foreign_bag(
        tmp_path / "topic", [("/rosout", "", 1, text)], {"/rosout": "std_msgs/msg/String"}
    )
    with pytest.raises(InputFileError, match=r"only /rosout \(std_msgs/msg/String\)"):
        read_track_bag(path)

    path = foreign_bag(
        tmp_path / "silent",
        [("/rosout", "", 1, text)],
        {"/rosout": "std_msgs/msg/String", "/a/tracks_px": MESSAGE_TYPE},
    )
    with pytest.raises(InputFileError, match="no message on /a/tracks_px"):
        read_track_bag(path)


@pytest.mark.parametrize("step_ns", [0, -1, -30_000_000])
def test_messages_out_of_order_are_sorted_and_those_of_one_time_are_one_frame(
    tmp_path: Path, step_ns: int
) -> None:
    rows = steady_frames(3, 2, PIXEL_TRACK_DTYPE)
    rows.rows["track_id"] = [1, 2, 3, 4, 5, 6]
    stamps = [5 * 10**8, 10**9, 10**9 + step_ns]
    messages = [
        ("/a/tracks_px", MESSAGE_TYPE, k, encode_table(stamp, "a", rows.frame(k)))
        for k, stamp in enumerate(stamps)
    ]
    path = foreign_bag(tmp_path / "bag", messages, {"/a/tracks_px": MESSAGE_TYPE})
    bag = read_track_bag(path)
    assert bag.frames.stamp_ns.tolist() == sorted(set(stamps))
    assert len(bag.frames.rows) == 6
    assert ("message 3" in " ".join(bag.report.sentences())) == (step_ns < 0)


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [("x", np.nan, "1 of 120 boxes left out: .* message 3: x nan"),
     ("width", -2, "1 of 120 boxes left out: .* message 3: .* w -2"),
     ("width", 0, "1 of 120 boxes left out: .* not above 0"),
     ("score", np.inf, "1 of 120 boxes repaired: a score that is no number"),
     ("track_id", 0, "1 of 120 boxes repaired: an id twice"),
     ("track_id", -1, "1 of 120 boxes left out: no id")],
)  # fmt: skip
def test_a_box_that_is_none_is_left_out_and_told(
    tmp_path: Path, field: str, value: float, told: str
) -> None:
    rows = FRAMES.rows.copy()
    rows[field][7] = value  # the second row of the third frame
    path = tmp_path / "bag"
    write_track_bag(path, "a", Frames(FRAMES.stamp_ns, FRAMES.offset, rows))
    bag = read_track_bag(path)
    assert len(bag.frames) == len(FRAMES)
    assert len(bag.frames.rows) == 119 + (field == "score")
    assert re.search(told, " ".join(bag.report.sentences()))
    with pytest.raises(InputFileError, match="--strict"):
        read_track_bag(path, options=ReadOptions(strict=True))


def test_a_table_without_our_fields_is_left_out_and_told(tmp_path: Path) -> None:
    ground = steady_frames(1, 2, TRACK_DTYPE, start_ns=2 * 10**18)
    messages = track_messages(FRAMES) + track_messages(ground)
    path = foreign_bag(tmp_path / "bag", messages, {"/a/tracks_px": MESSAGE_TYPE})
    bag = read_track_bag(path)
    assert_same(bag.frames, FRAMES)
    told = r"1 of 41 messages left out: no tables of tracks \(first: message 41: no field 'height'"
    assert re.search(told, " ".join(bag.report.sentences()))
    only = foreign_bag(tmp_path / "only", track_messages(ground), {"/a/tracks_px": MESSAGE_TYPE})
    with pytest.raises(MessageError, match="message 1: found no field 'height'"):
        read_track_bag(only)


def camera_info(topic: str, width: int, height: int, time_ns: int = 10**18) -> Message:
    info = STORE.types[CAMERA_INFO]
    header = STORE.types["std_msgs/msg/Header"](
        STORE.types["builtin_interfaces/msg/Time"](1, 2), ""
    )
    region = STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    none, matrix = np.empty(0), np.zeros(9)
    message = info(header, height, width, "", none, matrix, matrix, np.zeros(12), 0, 0, region)
    return topic, CAMERA_INFO, time_ns, bytes(STORE.serialize_cdr(message, CAMERA_INFO))


@pytest.mark.parametrize(
    ("infos", "size", "told"),
    [
        ([("/a/camera_info", 3840, 2160)], (3840, 2160), ""),
        ([("/a/image/camera_info", 0, 0), ("/a/image/camera_info", 2560, 1440)], (2560, 1440), ""),
        ([("/camera_info", 3840, 2160)], (3840, 2160), ""),
        ([("/b/camera_info", 2560, 1440), ("/a/camera_info", 3840, 2160)], (3840, 2160), ""),
        ([("/b/camera_info", 2560, 1440), ("/c/camera_info", 3840, 2160)], None, ""),
        ([("/a/camera_info", 0, 0)], None, ""),
        (
            [("/a/left/camera_info", 2560, 1440), ("/a/right/camera_info", 3840, 2160)],
            None,
            "CameraInfo says different sizes of the image: 2560x1440 on /a/left/camera_info, "
            "3840x2160 on /a/right/camera_info",
        ),
    ],
)
def test_camera_info_says_how_large_the_image_is(
    tmp_path: Path, infos: list[tuple[str, int, int]], size: tuple[int, int] | None, told: str
) -> None:
    messages = track_messages(FRAMES) + [camera_info(*info) for info in infos]
    topics = {"/a/tracks_px": MESSAGE_TYPE} | {info[0]: CAMERA_INFO for info in infos}
    bag = read_track_bag(foreign_bag(tmp_path / "bag", messages, topics))
    assert bag.report.image_size == size
    assert list(bag.report.sentences()) == ([told] if told else [])
    assert_same(bag.frames, FRAMES)


def test_what_the_user_says_of_the_image_goes_before_camera_info(tmp_path: Path) -> None:
    topics = {"/a/tracks_px": MESSAGE_TYPE, "/a/camera_info": CAMERA_INFO}
    sized = [*track_messages(FRAMES), camera_info("/a/camera_info", 640, 480)]
    path = foreign_bag(tmp_path / "sized", sized, topics)
    report = read_track_bag(path, options=ReadOptions((4000, 3000))).report
    assert report.image_size == (4000, 3000)
    (sentence,) = report.sentences()
    assert sentence.startswith("the image is 4000x3000 as you say, but 640x480 as the file says")
    cut = [*track_messages(FRAMES), (*camera_info("/a/camera_info", 640, 480)[:3], b"\0\1\0\0\1")]
    report = read_track_bag(
        foreign_bag(tmp_path / "cut", cut, topics), options=ReadOptions(default_size=(4000, 3000))
    ).report
    assert report.image_size == (4000, 3000)
    (sentence,) = report.sentences()
    assert sentence.startswith("a CameraInfo on /a/camera_info can't be read: ")


def test_nothing_is_left_of_a_bag_that_could_not_be_written(tmp_path: Path) -> None:
    too_late = Frames(FRAMES.stamp_ns + 2 * 10**18, FRAMES.offset, FRAMES.rows)
    none = Frames(np.empty(0, np.int64), np.zeros(1, np.int64), np.empty(0, PIXEL_TRACK_DTYPE))
    for camera_id, frames, error in (
        ("pole 7", FRAMES, ParameterError),
        ("/a", FRAMES, ParameterError),
        ("a", none, TableError),
        ("a", steady_frames(2, 2, TRACK_DTYPE), TableError),
        ("a", too_late, TableError),
    ):
        with pytest.raises(error):
            write_track_bag(tmp_path / "bag", camera_id, frames)
    assert list(tmp_path.iterdir()) == []


@settings(deadline=None, max_examples=60)
@given(st.sampled_from(STORAGES), st.floats(0, 1, exclude_max=True), st.integers(1, 255))
def test_a_damaged_byte_never_passes_for_another_error(
    tmp_path_factory: pytest.TempPathFactory, storage: Storage, where: float, flip: int
) -> None:
    path = tmp_path_factory.mktemp("bag") / "bag"
    write_track_bag(path, "a", FRAMES, storage)
    (data,) = (f for f in path.iterdir() if f.suffix != ".yaml")
    content = bytearray(data.read_bytes())
    content[int(where * len(content))] ^= flip
    data.write_bytes(content)
    try:
        read_track_bag(path)
    except GeoOrbitError as error:
        assert str(path) in error.place
