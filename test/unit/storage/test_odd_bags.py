"""Bags as other programs, killed recorders and merges leave them: right, or told."""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from made_bags import MAGIC, TRACKS, MadeMcap, record, tables
from made_frames import assert_same, steady_frames

from geoorbit_ros.core.errors import GeoOrbitError, InputFileError
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, Frames
from geoorbit_ros.storage.bag_reader import bag_messages, describe_bag
from geoorbit_ros.storage.pointcloud2 import encode_table
from geoorbit_ros.storage.track_bag import TrackBag, read_track_bag, write_track_bag

START_NS = 1_700_000_000 * 10**9
FRAMES = steady_frames(300, 4, PIXEL_TRACK_DTYPE, start_ns=START_NS)
ROWS = [FRAMES.frame(k) for k in range(len(FRAMES))]
MESSAGES = tables(FRAMES.stamp_ns.tolist(), ROWS)
ONE = {1: ("/a/tracks_px", *TRACKS)}
TWO = {1: ("/a/tracks_px", *TRACKS), 2: ("/a/tracks_px", *TRACKS)}


def told(bag: TrackBag) -> str:
    return " ".join(bag.report.sentences())


def on(channel: int, messages: list[tuple[int, int, bytes]]) -> list[tuple[int, int, bytes]]:
    return [(channel, time_ns, data) for _, time_ns, data in messages]


WELL: list[tuple[str, MadeMcap]] = [
    ("profile of no name", MadeMcap(ONE, profile="")),
    ("profile of another program", MadeMcap(ONE, profile="autoware")),
    ("lz4 chunks", MadeMcap(ONE, compression="lz4")),
    ("chunks that are not packed", MadeMcap(ONE, compression="")),
    ("no chunks, as rosbag2's fastwrite", MadeMcap(ONE, chunk=0)),
    ("no message index", MadeMcap(ONE, message_index=False)),
    ("no message index, no statistics", MadeMcap(ONE, message_index=False, statistics=False)),
    ("no statistics", MadeMcap(ONE, statistics=False)),
    ("no summary", MadeMcap(ONE, summary=False)),
    ("no summary, no chunks", MadeMcap(ONE, summary=False, chunk=0)),
    ("ROS 1's spelling of the type", MadeMcap({1: ("/a/tracks_px", "sensor_msgs/PointCloud2",
                                                   "ros2msg", "cdr")})),
    ("IDL's spelling", MadeMcap({1: ("/a/tracks_px", "sensor_msgs::msg::PointCloud2",
                                     "omgidl", "cdr")})),
    ("DDS's spelling", MadeMcap({1: ("/a/tracks_px", "sensor_msgs::msg::dds_::PointCloud2_",
                                     "omgidl", "cdr")})),
    ("no encoding of messages", MadeMcap({1: ("/a/tracks_px", TRACKS[0], "ros2msg", "")})),
]  # fmt: skip


@pytest.mark.parametrize(("_name", "made"), WELL, ids=[name for name, _ in WELL])
def test_any_mcap_with_messages_of_ros_2_is_read(
    tmp_path: Path, _name: str, made: MadeMcap
) -> None:
    bag = read_track_bag(made.write(tmp_path / "a.mcap", MESSAGES))
    assert bag.camera_id == "a"
    assert_same(bag.frames, FRAMES)
    assert told(bag) == ""
    (topic,) = describe_bag(tmp_path / "a.mcap").topics
    assert topic.messages == len(FRAMES)


@pytest.mark.parametrize("chunk", [0, 7, 1000])
def test_several_channels_of_a_topic_are_one_topic(tmp_path: Path, chunk: int) -> None:
    """After a publisher's restart, or a merge: side by side, or one after the other."""
    by_turns = [(1 + k % 2, *message[1:]) for k, message in enumerate(MESSAGES)]
    half = on(1, MESSAGES[:150]) + on(2, MESSAGES[150:])
    behind = on(2, MESSAGES[150:]) + on(1, MESSAGES[:150])  # as mcap merge may write them
    for messages in (by_turns, half, behind):
        path = MadeMcap(TWO, chunk=chunk).write(tmp_path / "a.mcap", messages)
        for camera_id in (None, "a", "/a", "/a/tracks_px"):
            bag = read_track_bag(path, camera_id)
            assert_same(bag.frames, FRAMES)
            assert told(bag) == ""
        (topic,) = describe_bag(path).topics
        assert topic.messages == len(FRAMES)
        times = [message.time_ns for message in bag_messages(path)]
        assert times == sorted(times)


FOREIGN = {
    "json": ("/tracks", "foxglove.Log", "jsonschema", "json"),
    "protobuf": ("/tracks", "foxglove.FrameTransform", "protobuf", "protobuf"),
    "ros1": ("/a/tracks_px", "sensor_msgs/PointCloud2", "ros1msg", "ros1"),
    "flatbuffer": ("/tracks", "foxglove.Log", "flatbuffer", "flatbuffer"),
}


@pytest.mark.parametrize("encoding", FOREIGN)
@pytest.mark.parametrize("chunk", [0, 100])
def test_messages_of_other_kinds_are_named(tmp_path: Path, encoding: str, chunk: int) -> None:
    messages = [(1, k, b"{}") for k in range(5)]
    made = MadeMcap({1: FOREIGN[encoding]}, profile="", chunk=chunk)
    path = made.write(tmp_path / "a.mcap", messages)
    for read in (read_track_bag, describe_bag):
        with pytest.raises(InputFileError, match=f"without ROS 2 messages .{encoding}."):
            read(path)
    mixed = MadeMcap({1: FOREIGN[encoding], **{2: ONE[1]}}, profile="", chunk=chunk)
    bag = read_track_bag(mixed.write(tmp_path / "b.mcap", messages + on(2, MESSAGES)))
    assert_same(bag.frames, FRAMES)
    assert f"5 of 305 messages left out: messages that are not ROS 2's but {encoding}" in told(bag)


def test_a_channel_without_a_type_is_left_out(tmp_path: Path) -> None:
    made = MadeMcap({1: ONE[1], 2: ("/a/other", None, "", "cdr")})
    path = made.write(tmp_path / "a.mcap", [*MESSAGES, (2, START_NS, b"\0\1\0\0")])
    bag = read_track_bag(path)
    assert_same(bag.frames, FRAMES)
    assert "1 of 301 messages left out: messages without a type (first: /a/other)" in told(bag)


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_an_mcap_that_breaks_off_gives_every_message_before_the_break(
    tmp_path: Path, compression: str, share: float
) -> None:
    made = MadeMcap(ONE, compression=compression, chunk=20)
    content = made.content(MESSAGES)
    path = tmp_path / "a.mcap"
    path.write_bytes(content[: int(share * len(content))])
    bag = read_track_bag(path)
    number = len(bag.frames)
    whole = Frames(FRAMES.stamp_ns[:number], FRAMES.offset[: number + 1], FRAMES.rows[: 4 * number])
    assert_same(bag.frames, whole)
    assert number >= share * len(FRAMES) - 40  # two chunks: of one, what is unpacked is used
    assert "a.mcap has no end (cut off, or its recorder still runs)" in told(bag)


def test_a_recording_that_is_cut_off_is_read_with_other_topics_in_it(tmp_path: Path) -> None:
    made = MadeMcap({1: ONE[1], 2: ("/b/x", *TRACKS)}, footer=False)
    path = made.write(tmp_path / "a.mcap", MESSAGES[:150] + on(2, MESSAGES[150:]))
    assert len(read_track_bag(path).frames) == 150
    assert [t.messages for t in describe_bag(path).topics] == [150, 150]


def damaged_chunk(made: MadeMcap) -> bytes:
    content = bytearray(made.content(MESSAGES))
    at = content.index(made.data[4]) + 200  # within the second chunk
    content[at : at + 40] = bytes(40)
    return bytes(content)


def not_packed(made: MadeMcap) -> MadeMcap:
    made.compression, made.checksum = "", False  # as rosbag2 and rosbags write by default
    return made


def wrong_length(made: MadeMcap) -> bytes:
    content = bytearray(not_packed(made).content(MESSAGES))
    content[content.index(MESSAGES[130][2]) - 22 - 8 + 2] ^= 1  # the record's length, 64 KiB more
    return bytes(content)


def short_length(made: MadeMcap) -> bytes:
    content = bytearray(not_packed(made).content(MESSAGES))
    content[content.index(MESSAGES[130][2]) - 22 - 8] ^= 0x20
    return bytes(content)


def wrong_length_and_no_index(made: MadeMcap) -> bytes:
    made.message_index = False
    return wrong_length(made)


def half_zeros(made: MadeMcap) -> bytes:
    content = bytearray(not_packed(made).content(MESSAGES))
    begin, end = (content.index(MESSAGES[k][2]) for k in (150, 199))
    content[begin:end] = bytes(end - begin)
    return bytes(content)


def zeros_outside_of_chunks(made: MadeMcap) -> bytes:
    made.chunk = 0
    content = bytearray(made.content(MESSAGES))
    begin, end = (content.index(MESSAGES[k][2]) for k in (150, 170))
    content[begin : end - 40] = bytes(end - 40 - begin)
    return bytes(content)


def zeros_in_the_middle(made: MadeMcap) -> bytes:
    content = bytearray(made.content(MESSAGES))
    at = content.index(made.data[4])
    content[at : at + 60] = bytes(60)
    return bytes(content)


def zeros_and_no_index(made: MadeMcap) -> bytes:
    made.chunk_index = False
    return zeros_in_the_middle(made)


def zeros_and_no_summary(made: MadeMcap) -> bytes:
    made.summary = False
    return zeros_in_the_middle(made)


def unknown_record(made: MadeMcap) -> bytes:
    content = made.content(MESSAGES)
    return content.replace(made.data[3], record(0x99, b"private") + made.data[3])


def nothing_behind_the_end(made: MadeMcap) -> bytes:
    return made.content(MESSAGES) + bytes(4096)  # room that a file system had set aside


@pytest.mark.parametrize(
    ("make", "lost", "sentence"),
    [
        (damaged_chunk, 100, "100 of 300 messages left out: a chunk with a wrong checksum"),
        (wrong_length, 1, "1 of 300 messages left out: messages in a damaged chunk"),
        (short_length, 1, "1 of 300 messages left out: messages in a damaged chunk"),
        (wrong_length_and_no_index, 70, "messages in a damaged chunk"),
        (half_zeros, 50, "49 of 300 messages left out: messages in a damaged chunk"),
        (zeros_outside_of_chunks, 20, "records that can't be read are passed over"),
        (zeros_in_the_middle, 100, "records that can't be read are passed over"),
        (zeros_and_no_index, 200, "records that can't be read are passed over"),
        (zeros_and_no_summary, 200, "has no end"),
        (unknown_record, 0, ""),
        (nothing_behind_the_end, 0, ""),
    ],
)
def test_an_mcap_with_a_damage_in_the_middle(
    tmp_path: Path, make: Callable[[MadeMcap], bytes], lost: int, sentence: str
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(make(MadeMcap(ONE)))
    bag = read_track_bag(path)
    assert len(bag.frames) == len(FRAMES) - lost
    assert sentence in told(bag)


def test_a_chunk_that_no_program_here_unpacks(tmp_path: Path) -> None:
    path = MadeMcap(ONE, compression="snappy").write(tmp_path / "a.mcap", MESSAGES)
    with pytest.raises(InputFileError, match="packed with 'snappy'"):
        read_track_bag(path)


def test_only_the_beginning_of_an_mcap(tmp_path: Path) -> None:
    content = MadeMcap(ONE).content(MESSAGES)
    for kept in (8, 20, 40, 60):
        (tmp_path / "a.mcap").write_bytes(content[:kept])
        with pytest.raises(InputFileError, match=r"an empty bag: a\.mcap has no end"):
            read_track_bag(tmp_path / "a.mcap")
    (tmp_path / "a.mcap").write_bytes(MAGIC + struct.pack("<BQ", 6, 2**62) + bytes(200))
    with pytest.raises(InputFileError):
        read_track_bag(tmp_path / "a.mcap")


# --- databases ---


def a_bag(folder: Path, **more: object) -> Path:
    write_track_bag(folder / "bag", "a", FRAMES, "sqlite3")
    assert more == {}
    return folder / "bag"


def test_messages_in_a_log_that_a_killed_recorder_left_are_read(tmp_path: Path) -> None:
    """rosbag2's preset `resilient`: the end of the recording is in the -wal file alone."""
    database = a_bag(tmp_path) / "bag.db3"
    connection = sqlite3.connect(database)
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("PRAGMA wal_autocheckpoint=0")
    row = connection.execute("SELECT topic_id FROM messages LIMIT 1").fetchone()
    stamp_ns = int(FRAMES.stamp_ns[-1]) + 10**9
    new = encode_table(stamp_ns, "a", ROWS[0])
    insert = "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)"
    connection.execute(insert, (row[0], stamp_ns, new))
    connection.commit()
    killed = tmp_path / "killed"
    shutil.copytree(tmp_path / "bag", killed)  # as it lies there while the recorder runs
    connection.close()
    (killed / "metadata.yaml").unlink()
    before = {file.name: file.read_bytes() for file in killed.iterdir()}
    bag = read_track_bag(killed)
    assert len(bag.frames) == len(FRAMES) + 1
    assert "messages in bag.db3-wal, left by a recorder that was killed, are used" in told(bag)
    assert {file.name: file.read_bytes() for file in killed.iterdir()} == before


def test_logs_without_content_and_a_folder_that_cant_be_written(tmp_path: Path) -> None:
    folder = a_bag(tmp_path)
    (folder / "bag.db3-wal").write_bytes(b"")
    (folder / "bag.db3-shm").write_bytes(bytes(32768))
    folder.chmod(0o555)
    try:
        bag = read_track_bag(folder)
    finally:
        folder.chmod(0o755)
    assert_same(bag.frames, FRAMES)
    assert sorted(os.listdir(folder)) == ["bag.db3", "bag.db3-shm", "bag.db3-wal", "metadata.yaml"]


def test_a_database_in_any_order_is_read_in_the_order_of_time(tmp_path: Path) -> None:
    database = a_bag(tmp_path) / "bag.db3"
    with sqlite3.connect(database) as connection:
        connection.execute("UPDATE messages SET id = -id")
    connection.close()
    times = [message.time_ns for message in bag_messages(tmp_path / "bag")]
    assert times == FRAMES.stamp_ns.tolist()
    assert told(read_track_bag(tmp_path / "bag")) == ""


OLD = """
DROP TABLE topics; CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL,
    type TEXT NOT NULL, serialization_format TEXT NOT NULL);
INSERT INTO topics VALUES(1, '/a/tracks_px', 'sensor_msgs/msg/PointCloud2', 'cdr');
UPDATE messages SET topic_id = 1; DROP TABLE schema; DROP TABLE metadata;
DROP TABLE message_definitions; DROP INDEX timestamp_idx;
"""
"""A database as Dashing wrote it (ros2/rosbag2#1089)."""


def test_a_database_of_the_first_rosbag2(tmp_path: Path) -> None:
    database = a_bag(tmp_path) / "bag.db3"
    connection = sqlite3.connect(database)
    connection.executescript(OLD)
    connection.close()
    assert_same(read_track_bag(database).frames, FRAMES)


def test_other_databases_are_named(tmp_path: Path) -> None:
    connection = sqlite3.connect(tmp_path / "other.db3")
    connection.execute("CREATE TABLE people (name TEXT)")
    connection.commit()
    connection.close()
    with pytest.raises(InputFileError, match="SQLite database without the tables of a bag"):
        read_track_bag(tmp_path / "other.db3")


# --- folders and metadata ---


def split_bag(folder: Path, metadata: str | None = None) -> Path:
    """Three files of a hundred messages, named as rosbag2 names them."""
    bag = folder / "ride"
    bag.mkdir()
    for k in range(3):
        part = MESSAGES[100 * k : 100 * (k + 1)]
        MadeMcap(ONE).write(bag / f"ride_{k}.mcap", part)
    listed = "".join(f"\n    - ride_{k}.mcap" for k in range(3))
    counts = "".join(f"\n    - path: ride_{k}.mcap\n      message_count: 100" for k in range(3))
    content = metadata or (
        "rosbag2_bagfile_information:\n  version: {version}\n  storage_identifier: mcap\n"
        f"  message_count: 300\n  relative_file_paths:{listed}\n  files:{counts}\n"
    )
    (bag / "metadata.yaml").write_text(content.replace("{version}", "9"))
    return bag


def edited(old: str, new: str) -> Callable[[Path], None]:
    def edit(bag: Path) -> None:
        file = bag / "metadata.yaml"
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new))

    return edit


def without(name: str) -> Callable[[Path], None]:
    return lambda bag: (bag / name).unlink()


def packed(bag: Path) -> None:
    for file in bag.glob("*.mcap"):
        file.with_name(f"{file.name}.zstd").write_bytes(
            pa.compress(file.read_bytes(), codec="zstd", asbytes=True)
        )
        file.unlink()


def another_beside(bag: Path) -> None:
    shutil.copy(bag / "ride_0.mcap", bag / "old_0.mcap")


PARTS: list[tuple[str, Callable[[Path], None], int, str]] = [
    ("as rosbag2 writes it", lambda _: None, 300, "^$"),
    ("a newer version", edited("version: 9", "version: 12"), 300, "^$"),
    ("no storage identifier (#2175)", edited("mcap\n  mess", "''\n  mess"), 300, "^$"),
    ("paths from another folder", edited("- ride_", "- /home/me/ride/ride_"), 300, "^$"),
    ("without metadata", without("metadata.yaml"), 300, "no metadata.yaml"),
    ("a part missing", without("ride_1.mcap"), 200,
     "100 of 300 messages left out: ride_1.mcap of the bag's 3 files is missing"),
    ("files packed as a whole", packed, 300, "^$"),
    ("another file beside them", another_beside, 300, "old_0.mcap beside the bag's files"),
    ("metadata of another bag", edited("ride_", "other_"), 300, "names other files"),
    ("more messages announced", edited("message_count: 100", "message_count: 120"), 300,
     "60 of 360 messages left out: more messages in metadata.yaml than in the file"),
    ("a list", edited("rosbag2_bagfile_information:", "- a:"), 300, "metadata.yaml can't be read"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("_name", "change", "messages", "sentence"), PARTS, ids=[part[0] for part in PARTS]
)
def test_a_bag_in_parts(
    tmp_path: Path, _name: str, change: Callable[[Path], None], messages: int, sentence: str
) -> None:
    bag_folder = split_bag(tmp_path)
    change(bag_folder)
    bag = read_track_bag(bag_folder)
    assert len(bag.frames) == messages
    assert re.search(sentence, told(bag)), told(bag)
    if messages == 300:
        assert_same(bag.frames, FRAMES)


def test_ten_and_more_parts_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    bag = tmp_path / "ride"
    bag.mkdir()
    for k in range(12):
        MadeMcap(ONE).write(bag / f"ride_{k}.mcap", MESSAGES[25 * k : 25 * (k + 1)])
    assert_same(read_track_bag(bag).frames, FRAMES)


@pytest.mark.parametrize("name", ["ride", "ride/ride", "ride/metadata.yaml", "ride/ride_2.mcap"])
def test_what_people_name_when_they_mean_a_bag(tmp_path: Path, name: str) -> None:
    if name == "ride/ride":  # unpacked into a folder of its own
        (tmp_path / "ride").mkdir()
        split_bag(tmp_path / "ride")
        name = "ride"
    else:
        split_bag(tmp_path)
    bag = read_track_bag(tmp_path / name)
    part = name.endswith(".mcap")
    assert len(bag.frames) == (100 if part else 300)
    assert ("one of 3 files of its folder" in told(bag)) == part


def test_a_folder_of_several_bags_is_refused_with_their_names(tmp_path: Path) -> None:
    for name in ("monday", "tuesday"):
        (tmp_path / name).mkdir()
        split_bag(tmp_path / name).rename(tmp_path / name / "ride")
        shutil.move(str(tmp_path / name / "ride"), str(tmp_path / f"{name}_ride"))
        shutil.rmtree(tmp_path / name)
    with pytest.raises(InputFileError, match=r"2 bags \(monday_ride, tuesday_ride\)"):
        read_track_bag(tmp_path)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_messages_packed_one_by_one(tmp_path: Path, storage: str) -> None:
    def squeezed(data: bytes) -> bytes:
        return bytes(pa.compress(data, codec="zstd", asbytes=True))

    if storage == "mcap":
        messages = [(c, t, squeezed(data)) for c, t, data in MESSAGES]
        path = MadeMcap(ONE).write(tmp_path / "a.mcap", messages)
    else:
        path = a_bag(tmp_path) / "bag.db3"
        with sqlite3.connect(path) as connection:
            rows = connection.execute("SELECT id, data FROM messages").fetchall()
            new = [(squeezed(data), number) for number, data in rows]
            connection.executemany("UPDATE messages SET data = ? WHERE id = ?", new)
        connection.close()
    assert_same(read_track_bag(path).frames, FRAMES)
    if storage == "mcap":
        damaged = (1, START_NS, squeezed(MESSAGES[0][2])[:-20])
        bag = read_track_bag(MadeMcap(ONE).write(path, [damaged, *messages[1:]]))
        assert len(bag.frames) == 299
        assert "1 of 300 messages left out: a message that can't be unpacked" in told(bag)


def test_a_file_packed_as_a_whole_and_cut_off(tmp_path: Path) -> None:
    frames = steady_frames(4000, 4, PIXEL_TRACK_DTYPE)
    many = tables(frames.stamp_ns.tolist(), [frames.frame(k) for k in range(len(frames))])
    whole = pa.compress(MadeMcap(ONE, compression="").content(many), "zstd", asbytes=True)
    (tmp_path / "a.mcap.zstd").write_bytes(whole[: len(whole) // 2])
    bag = read_track_bag(tmp_path / "a.mcap.zstd")
    assert 1000 < len(bag.frames) < 2000
    assert "a.mcap.zstd is cut off or damaged" in told(bag)


# --- times ---


def with_stamps(stamps: np.ndarray[tuple[int], np.dtype[np.int64]]) -> list[tuple[int, int, bytes]]:
    """The recording, received when it was, with other stamps in its messages."""
    return [
        (1, received, encode_table(int(stamp), "a", rows))
        for received, stamp, rows in zip(FRAMES.stamp_ns.tolist(), stamps, ROWS, strict=True)
    ]


def read_with(tmp_path: Path, stamps: np.ndarray[tuple[int], np.dtype[np.int64]]) -> TrackBag:
    return read_track_bag(MadeMcap(ONE).write(tmp_path / "a.mcap", with_stamps(stamps)))


def test_without_stamps_times_of_receipt_count(tmp_path: Path) -> None:
    bag = read_with(tmp_path, np.zeros(300, np.int64))
    assert_same(bag.frames, FRAMES)
    assert "no time of capture (stamp 0)" in told(bag)


def test_a_simulations_time_from_zero_stays(tmp_path: Path) -> None:
    stamps = FRAMES.stamp_ns - START_NS
    bag = read_with(tmp_path, stamps)
    assert bag.frames.stamp_ns.tolist() == stamps.tolist()
    assert told(bag) == ""


def test_single_messages_without_a_stamp_take_the_time_of_receipt(tmp_path: Path) -> None:
    stamps = FRAMES.stamp_ns - 80_000_000  # the camera's clock is 80 ms behind
    expected = stamps.copy()
    stamps[[10, 200]] = 0
    bag = read_with(tmp_path, stamps)
    assert bag.frames.stamp_ns.tolist() == expected.tolist()
    assert "2 of 300 messages have no time of capture" in told(bag)


def test_a_source_that_starts_again_is_not_mixed_with_what_was_before(tmp_path: Path) -> None:
    """A film that is played twice: the same stamps again, and the same ids for other vehicles."""
    stamps = np.concatenate([FRAMES.stamp_ns[:150] - START_NS] * 2) + 10**9
    bag = read_with(tmp_path, stamps)
    assert np.diff(bag.frames.stamp_ns).tolist() == np.diff(FRAMES.stamp_ns).tolist()
    assert not set(bag.frames.rows["track_id"][:600]) & set(bag.frames.rows["track_id"][600:])
    assert "time goes back by 4.9 s: the source started again" in told(bag)


def test_stamps_that_contradict_the_order_of_receipt_altogether(tmp_path: Path) -> None:
    stamps = START_NS + np.random.default_rng(1).permutation(300) * 5 * 10**9
    bag = read_with(tmp_path, stamps)
    assert bag.frames.stamp_ns.tolist() == FRAMES.stamp_ns.tolist()
    assert bag.report.doubtful


def test_messages_that_were_recorded_twice_count_once(tmp_path: Path) -> None:
    twice = [message for message in MESSAGES for _ in range(2)]
    bag = read_track_bag(MadeMcap(ONE).write(tmp_path / "a.mcap", twice))
    assert_same(bag.frames, FRAMES)
    assert "300 of 600 messages" in told(bag)
    assert "the same message again" in told(bag)


# --- never anything else than a sentence ---


def test_a_byte_wrong_anywhere_is_never_another_error(tmp_path: Path) -> None:
    content = MadeMcap(TWO, chunk=40).content(MESSAGES[:80] + on(2, MESSAGES[80:120]))
    write_track_bag(tmp_path / "bag", "a", FRAMES, "sqlite3")
    database = (tmp_path / "bag" / "bag.db3").read_bytes()
    generator = np.random.default_rng(7)
    for k in range(160):
        source, name = (content, "a.mcap") if k % 2 else (database, "a.db3")
        bytes_ = bytearray(source)
        for at in generator.integers(16, min(len(bytes_), 6000), 3):
            bytes_[at] = int(generator.integers(256))
        (tmp_path / name).write_bytes(bytes_)
        try:
            read_track_bag(tmp_path / name)
            describe_bag(tmp_path / name)
        except GeoOrbitError as error:
            assert str(error).isprintable()


def test_one_message_that_comes_late_is_no_source_that_starts_again(tmp_path: Path) -> None:
    order = [*range(100), *range(101, 160), 100, *range(160, 300)]  # two seconds late
    messages = [(1, int(FRAMES.stamp_ns[k]), MESSAGES[taken][2]) for k, taken in enumerate(order)]
    bag = read_track_bag(MadeMcap(ONE).write(tmp_path / "a.mcap", messages))
    assert_same(bag.frames, FRAMES)
    assert "1 of 300 messages came after others of a later time; sorted" in told(bag)
