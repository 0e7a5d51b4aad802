from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_frames import MAX_STAMP_NS
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from geoorbit_ros.core.errors import MessageError, TableError
from geoorbit_ros.core.tables import DETECTION_DTYPE, PIXEL_TRACK_DTYPE, TRACK_DTYPE
from geoorbit_ros.storage.pointcloud2 import MESSAGE_TYPE, decode_table, encode_table

STORE = get_typestore(Stores.ROS2_JAZZY)
DTYPES = st.sampled_from((DETECTION_DTYPE, PIXEL_TRACK_DTYPE, TRACK_DTYPE))
STAMPS = st.integers(-(2**31) * 10**9, MAX_STAMP_NS)
FRAME_IDS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=9)
NUMBER = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def random_rows(dtype: np.dtype[np.void], seed: int) -> NDArray[np.void]:
    generator = np.random.default_rng(seed)
    number = int(generator.integers(0, 30))
    return np.frombuffer(generator.bytes(number * dtype.itemsize), dtype)


def foreign_message(layout: np.dtype[np.void], points: NDArray[np.void], **changes: Any) -> bytes:
    """A message as some other program writes it, serialised by rosbags."""
    types = STORE.types
    fields = [
        types["sensor_msgs/msg/PointField"](
            name, layout.fields[name][1], NUMBER[layout[name].str[1:]], 1
        )
        for name in layout.names or ()
        if layout.fields is not None
    ]
    stamp = types["builtin_interfaces/msg/Time"](12, 345)
    values: dict[str, Any] = {
        "header": types["std_msgs/msg/Header"](stamp, "lens"),
        "height": 1,
        "width": len(points),
        "fields": fields,
        "is_bigendian": False,
        "point_step": layout.itemsize,
        "row_step": layout.itemsize * len(points),
        "data": np.frombuffer(points.tobytes(), np.uint8),
        "is_dense": True,
    }
    message = types[MESSAGE_TYPE](**(values | changes))
    return bytes(STORE.serialize_cdr(message, MESSAGE_TYPE))


@given(DTYPES, st.integers(0, 2**32), STAMPS, FRAME_IDS)
def test_decoding_undoes_encoding(
    dtype: np.dtype[np.void], seed: int, stamp_ns: int, frame_id: str
) -> None:
    rows = random_rows(dtype, seed)
    message = encode_table(stamp_ns, frame_id, rows)
    stamp_back, frame_back, rows_back = decode_table(message, dtype, "topic")
    assert (stamp_back, frame_back) == (stamp_ns, frame_id)
    assert rows_back.dtype == dtype
    assert rows_back.tobytes() == rows.tobytes()
    assert rows_back.flags.writeable
    assert rows_back.flags.aligned


@given(DTYPES, st.integers(0, 2**32), STAMPS, FRAME_IDS)
def test_another_implementation_reads_and_writes_the_same(
    dtype: np.dtype[np.void], seed: int, stamp_ns: int, frame_id: str
) -> None:
    rows = random_rows(dtype, seed)
    message: Any = STORE.deserialize_cdr(encode_table(stamp_ns, frame_id, rows), MESSAGE_TYPE)
    assert message.header.frame_id == frame_id
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp_ns
    assert message.width == len(rows)
    assert [field.name for field in message.fields] == list(dtype.names or ())
    written = bytes(STORE.serialize_cdr(message, MESSAGE_TYPE))
    stamp_back, frame_back, rows_back = decode_table(written, dtype, "topic")
    assert (stamp_back, frame_back) == (stamp_ns, frame_id)
    assert rows_back.tobytes() == rows.tobytes()


@given(st.permutations(PIXEL_TRACK_DTYPE.names or ()), st.integers(0, 7), st.integers(0, 20))
def test_fields_are_found_by_name(order: list[str], extra: int, number: int) -> None:
    """Another tracker may order its fields as it likes, add some, and leave gaps."""
    kinds = [(name, PIXEL_TRACK_DTYPE[name].str) for name in order]
    kinds.insert(extra, ("speed", "<f8"))
    layout = np.dtype(kinds, align=True)
    points = np.zeros(number, layout)
    for k, name in enumerate(PIXEL_TRACK_DTYPE.names or ()):
        points[name] = np.arange(number) + 100 * k
    stamp_ns, frame_id, rows = decode_table(
        foreign_message(layout, points), PIXEL_TRACK_DTYPE, "topic"
    )
    assert (stamp_ns, frame_id) == (12_000_000_345, "lens")
    for name in PIXEL_TRACK_DTYPE.names or ():
        np.testing.assert_array_equal(rows[name], points[name])


def test_points_in_several_rows_are_read_in_order() -> None:
    points = random_rows(PIXEL_TRACK_DTYPE, 3)[:6]
    message = foreign_message(PIXEL_TRACK_DTYPE, points, height=2, width=3, row_step=96)
    assert decode_table(message, PIXEL_TRACK_DTYPE, "t")[2].tobytes() == points.tobytes()


@given(DTYPES, st.integers(0, 2**32), st.data())
def test_a_message_cut_anywhere_is_refused(
    dtype: np.dtype[np.void], seed: int, data: st.DataObject
) -> None:
    message = encode_table(1, "lens", random_rows(dtype, seed))
    cut = data.draw(st.integers(0, len(message) - 1))
    with pytest.raises(MessageError, match=r"^topic: "):
        decode_table(message[:cut], dtype, "topic")


@given(st.binary(max_size=300), st.booleans())
def test_any_bytes_give_a_table_or_a_message_error(data: bytes, with_header: bool) -> None:
    try:
        decode_table(b"\0\1\0\0" + data if with_header else data, TRACK_DTYPE, "topic")
    except MessageError as error:
        assert "topic" in str(error)


WIDE = np.dtype([(name, "<f8") for name in PIXEL_TRACK_DTYPE.names or ()])


@pytest.mark.parametrize(
    ("message", "found", "expected"),
    [
        (encode_table(1, "a", np.zeros(2, DETECTION_DTYPE)), "no field 'track_id'", "'track_id'"),
        (encode_table(1, "a", np.zeros(2, WIDE)), "field 'x' as FLOAT64", "FLOAT32"),
        (foreign_message(PIXEL_TRACK_DTYPE, np.zeros(2, PIXEL_TRACK_DTYPE), is_bigendian=True),
         "big-endian", "little-endian"),
        (foreign_message(PIXEL_TRACK_DTYPE, np.zeros(2, PIXEL_TRACK_DTYPE), point_step=31),
         "point_step 31", "32"),
        (foreign_message(PIXEL_TRACK_DTYPE, np.zeros(2, PIXEL_TRACK_DTYPE), row_step=60),
         "row_step 60", "row_step"),
        (foreign_message(PIXEL_TRACK_DTYPE, np.zeros(2, PIXEL_TRACK_DTYPE), width=3),
         "1 x 3 points", "row_step"),
        (foreign_message(np.dtype([*reversed(PIXEL_TRACK_DTYPE.descr)]),
                         np.zeros(1, PIXEL_TRACK_DTYPE), point_step=20, row_step=20,
                         data=np.zeros(20, np.uint8)),
         "of points of 20 bytes", "inside the point"),
        (b"\0\0" + encode_table(1, "a", np.zeros(2, PIXEL_TRACK_DTYPE))[2:], "0x0000", "0x0001"),
    ],
)  # fmt: skip
def test_a_table_of_another_kind_is_refused_with_the_reason(
    message: bytes, found: str, expected: str
) -> None:
    with pytest.raises(MessageError) as caught:
        decode_table(message, PIXEL_TRACK_DTYPE, "/pole_7/tracks_px")
    assert caught.value.place == "/pole_7/tracks_px"
    assert found in str(caught.value.found)
    assert expected in caught.value.expected


def test_what_the_message_type_cannot_hold_is_refused() -> None:
    with pytest.raises(TableError, match="32 bits"):
        encode_table(2**31 * 10**9, "a", np.zeros(1, TRACK_DTYPE))
    with pytest.raises(TableError, match="'x'"):
        encode_table(0, "a", np.zeros(1, np.dtype([("x", "<f2")])))
