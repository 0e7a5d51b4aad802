"""The table codec against the message library of ROS 2 itself."""

from __future__ import annotations

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2, PointField

from geoorbit_ros.core.tables import DETECTION_DTYPE, PIXEL_TRACK_DTYPE, TRACK_DTYPE
from geoorbit_ros.storage.pointcloud2 import decode_table, encode_table


@pytest.mark.parametrize("dtype", [DETECTION_DTYPE, PIXEL_TRACK_DTYPE, TRACK_DTYPE])
@pytest.mark.parametrize("number", [0, 1, 20])
@pytest.mark.parametrize("frame_id", ["", "a", "ab", "abc", "map", "pole_7_optical", "Brücke"])
def test_rclpy_reads_what_we_write_and_we_read_what_rclpy_writes(
    dtype: np.dtype[np.void], number: int, frame_id: str
) -> None:
    rows = np.frombuffer(np.random.default_rng(number).bytes(number * dtype.itemsize), dtype)
    ours = encode_table(12_345_678_901, frame_id, rows)
    message = deserialize_message(ours, PointCloud2)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 345_678_901)
    assert message.header.frame_id == frame_id
    assert (message.height, message.width) == (1, number)
    assert (message.is_bigendian, message.is_dense) == (False, True)
    assert (message.point_step, message.row_step) == (dtype.itemsize, number * dtype.itemsize)
    kinds = {"<f4": PointField.FLOAT32, "<i4": PointField.INT32, "<u4": PointField.UINT32}
    assert [(f.name, f.offset, f.datatype, f.count) for f in message.fields] == [
        (name, dtype.fields[name][1], kinds[dtype[name].str], 1)  # type: ignore[index]
        for name in dtype.names or ()
    ]
    assert bytes(message.data) == rows.tobytes()

    theirs = serialize_message(message)
    assert len(theirs) == len(ours)  # not equal bytes: their padding is uninitialised
    stamp_ns, frame_back, rows_back = decode_table(theirs, dtype, "topic")
    assert (stamp_ns, frame_back) == (12_345_678_901, frame_id)
    assert rows_back.tobytes() == rows.tobytes()
