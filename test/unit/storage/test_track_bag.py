from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
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

STORE = get_typestore(Stores.ROS2_JAZZY)
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
def test_a_bag_cut_off_anywhere_is_refused(tmp_path: Path, storage: Storage, kept: float) -> None:
    frames = steady_frames(400, 10, PIXEL_TRACK_DTYPE)
    path = tmp_path / "bag"
    write_track_bag(path, "a", frames, storage)
    (data,) = (f for f in path.iterdir() if f.suffix != ".yaml")
    content = data.read_bytes()
    keep = int(kept * len(content)) if 0 < kept < 1 else int(kept)
    data.write_bytes(content[:keep])
    with pytest.raises(InputFileError) as caught:
        read_track_bag(path)
    assert caught.value.place == str(path)
    assert "cut off" in str(caught.value.found) or "cut off" in caught.value.expected
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("content", ["", "rosbag2_bagfile_information: [", "a: 1", "\0"])
def test_damaged_metadata_is_refused(tmp_path: Path, content: str) -> None:
    write_track_bag(tmp_path / "bag", "a", FRAMES)
    (tmp_path / "bag" / "metadata.yaml").write_text(content)
    with pytest.raises(InputFileError, match="cut off or damaged"):
        read_track_bag(tmp_path / "bag")


def test_a_recording_without_its_metadata_says_so(tmp_path: Path) -> None:
    write_track_bag(tmp_path / "bag", "a", FRAMES)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    with pytest.raises(InputFileError, match=r"bag\.mcap without metadata\.yaml"):
        read_track_bag(tmp_path / "bag")


def test_what_is_no_bag(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.mcap").write_text("hello, this is no bag at all, but long enough for one")
    (tmp_path / "text.db3").write_text("hello")
    for name, found in (
        ("absent", "no such file"),
        ("folder", "folder without metadata.yaml"),
        ("notes.txt", "file named 'notes.txt'"),
        ("text.mcap", "damaged"),
        ("text.db3", "damaged"),
    ):
        with pytest.raises(InputFileError, match=found):
            read_track_bag(tmp_path / name)


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


@pytest.mark.parametrize("step_ns", [0, -1])
def test_time_that_stands_still_or_goes_back(tmp_path: Path, step_ns: int) -> None:
    """Recording times increase, capture times don't: a bag merged from two."""
    rows = FRAMES.frame(0)
    stamps = [5, 10**9, 10**9 + step_ns]
    messages = [
        ("/a/tracks_px", MESSAGE_TYPE, k, encode_table(stamp, "a", rows))
        for k, stamp in enumerate(stamps)
    ]
    path = foreign_bag(tmp_path / "bag", messages, {"/a/tracks_px": MESSAGE_TYPE})
    with pytest.raises(MessageError, match=r"tracks_px, message 3: .* after 1\.000000000 s"):
        read_track_bag(path)


@pytest.mark.parametrize(
    ("field", "value", "found"),
    [("x", np.nan, "x nan"), ("width", -2, "width -2"), ("score", np.inf, "score inf"),
     ("track_id", 0, "track_id 0")],
)  # fmt: skip
def test_a_box_that_is_none_is_named(tmp_path: Path, field: str, value: float, found: str) -> None:
    rows = FRAMES.rows.copy()
    rows[field][7] = value  # the second row of the third frame
    path = tmp_path / "bag"
    write_track_bag(path, "a", Frames(FRAMES.stamp_ns, FRAMES.offset, rows))
    with pytest.raises(MessageError, match="message 3: ") as caught:
        read_track_bag(path)
    assert found in str(caught.value.found)


def test_a_table_without_our_fields_is_named_by_message(tmp_path: Path) -> None:
    ground = steady_frames(1, 2, TRACK_DTYPE, start_ns=2 * 10**18)
    messages = track_messages(FRAMES) + track_messages(ground)
    path = foreign_bag(tmp_path / "bag", messages, {"/a/tracks_px": MESSAGE_TYPE})
    with pytest.raises(MessageError, match="message 41: found no field 'height'"):
        read_track_bag(path)


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
