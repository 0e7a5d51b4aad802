"""Tables as `sensor_msgs/msg/PointCloud2` in CDR, without a Python object per row or field.

The bytes are those of `core.cdr`; blocks that all messages of a topic share are made once.
"""

from __future__ import annotations

import struct
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.cdr import ENCAPSULATION, SECOND_NS, CdrReader, CdrWriter
from geoorbit_ros.core.errors import MessageError, TableError

MESSAGE_TYPE = "sensor_msgs/msg/PointCloud2"
_KIND = f"a {MESSAGE_TYPE}"

_DATATYPE = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
"""sensor_msgs/PointField constants by numpy type."""
_DATATYPE_NAME = dict(
    enumerate(("INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32", "FLOAT32", "FLOAT64"), 1)
)
_NUMPY_TYPE = {number: np.dtype(code).newbyteorder("<").str for code, number in _DATATYPE.items()}

_STAMP = struct.Struct("<iI")
_NUMBER = struct.Struct("<I")  # of fields
_SHAPE = struct.Struct("<II")  # height, width
_FIELD_END = struct.Struct("<IB3xI")  # offset, datatype, count
_DATA_HEAD = struct.Struct("<?3xIII")  # is_bigendian, point_step, row_step, length of data


def encode_table(stamp_ns: int, frame_id: str, rows: NDArray[np.void]) -> bytes:
    """One message, ready for a raw publisher or a bag.

    Args:
        stamp_ns: Capture time, nanoseconds since the epoch of the clock in use.
        frame_id: Coordinate frame of the rows.
        rows: (N,) structured array of little-endian numbers; N may be 0.

    Raises:
        TableError: A stamp that `builtin_interfaces/Time` can't hold, or a field type that
            PointCloud2 has no number for.
    """
    second, nanosecond = divmod(int(stamp_ns), SECOND_NS)
    size = len(rows) * rows.dtype.itemsize
    try:
        stamp = _STAMP.pack(second, nanosecond)
    except struct.error:
        raise TableError("message stamp", f"{stamp_ns} ns", "seconds that fit in 32 bits") from None
    return b"".join(
        (
            ENCAPSULATION,
            stamp,
            _frame_block(frame_id),
            _SHAPE.pack(1, len(rows)),
            _field_block(rows.dtype),
            _DATA_HEAD.pack(False, rows.dtype.itemsize, size, size),
            rows.tobytes(),
            b"\x01",  # is_dense
        )
    )


def decode_table(
    cdr: bytes | memoryview, dtype: np.dtype[np.void], place: str
) -> tuple[int, str, NDArray[np.void]]:
    """The table in one message; fields are found by name, others are ignored.

    Args:
        cdr: The serialised message.
        dtype: Type of the rows wanted.
        place: Topic (and time), for the error.

    Returns:
        stamp_ns, frame_id, and a writable (N,) array of `dtype`.

    Raises:
        MessageError: A message cut short, of another layout, without a field of `dtype`, or with
            that field in another datatype.
    """
    data = bytes(cdr)
    reader = CdrReader(data, place, _KIND)
    stamp_ns, frame_id = reader.header()
    height, width = reader.unpack(_SHAPE)
    # Most messages have exactly the fields of dtype: then there is nothing to look up.
    fields = None if reader.skip_block(_field_block(dtype)) else _read_fields(reader)
    big_endian, point_step, row_step, size = reader.unpack(_DATA_HEAD)
    if big_endian:
        raise MessageError(place, "big-endian points", "little-endian points")
    if fields is not None:
        layout = _layout(fields, point_step, dtype, place)
    elif point_step == dtype.itemsize:
        layout = dtype
    else:
        raise MessageError(place, f"point_step {point_step}", f"{dtype.itemsize} for its fields")
    if row_step != width * point_step or size != row_step * height:
        raise MessageError(
            place,
            f"{height} x {width} points of {point_step} bytes with row_step {row_step} and "
            f"{size} bytes of data",
            "row_step = width x point_step, and height x row_step bytes of data",
        )
    left = reader.left
    if left < size + 1:
        found = f"{max(left - 1, 0)} bytes of data"
        raise MessageError(place, found, f"{size} as announced")
    rows = np.frombuffer(data, layout, height * width, len(data) - left)
    # Either way a copy in the layout of dtype: aligned, writable, independent of the message.
    rows = rows.copy() if layout is dtype else rows.astype(dtype)
    return stamp_ns, frame_id, rows


def _read_fields(reader: CdrReader) -> tuple[tuple[str, int, int, int], ...]:
    """The PointField sequence as (name, offset, datatype, count)."""
    (number,) = reader.unpack(_NUMBER)
    return tuple((reader.text(), *reader.unpack(_FIELD_END)) for _ in range(number))


@lru_cache(maxsize=64)
def _layout(
    fields: tuple[tuple[str, int, int, int], ...],
    point_step: int,
    dtype: np.dtype[np.void],
    place: str,
) -> np.dtype[np.void]:
    """How to read the fields of `dtype` out of points of `point_step` bytes."""
    by_name = {name: rest for name, *rest in fields}
    offsets = []
    for name in dtype.names or ():
        if name not in by_name:
            has = ", ".join(f"'{field[0]}'" for field in fields) or "none"
            raise MessageError(place, f"no field '{name}' among the fields {has}", f"'{name}'")
        offset, datatype, count = by_name[name]
        wanted = dtype[name]
        if _NUMPY_TYPE.get(datatype) != wanted.str or count != 1:
            raise MessageError(
                place,
                f"field '{name}' as {_DATATYPE_NAME.get(datatype, f'datatype {datatype}')}"
                f" x {count}",
                f"{_DATATYPE_NAME[_DATATYPE[wanted.str[1:]]]} x 1",
            )
        if offset + wanted.itemsize > point_step:
            raise MessageError(
                place,
                f"field '{name}' at byte {offset} of points of {point_step} bytes",
                "fields inside the point",
            )
        offsets.append(offset)
    return np.dtype(
        {
            "names": list(dtype.names or ()),
            "formats": [dtype[name] for name in dtype.names or ()],
            "offsets": offsets,
            "itemsize": point_step,
        }
    )


@lru_cache(maxsize=256)
def _frame_block(frame_id: str) -> bytes:
    """`frame_id` with its length, padded; it starts 8 bytes after the encapsulation header."""
    writer = CdrWriter()
    writer.text(frame_id)
    writer.align(4)
    return writer.fields()


@lru_cache(maxsize=64)
def _field_block(dtype: np.dtype[np.void]) -> bytes:
    """The PointField sequence that describes `dtype`; starts and ends on 4-byte boundaries."""
    writer = CdrWriter()
    writer.pack(_NUMBER, len(dtype.names or ()))
    for name, (kind, offset) in ((n, f[:2]) for n, f in (dtype.fields or {}).items()):
        code = kind.str[1:]
        if kind.str[0] == ">" or code not in _DATATYPE:
            raise TableError(
                f"table field '{name}'", kind.str, f"one of {', '.join(_DATATYPE)}, little-endian"
            )
        writer.text(name)
        writer.pack(_FIELD_END, offset, _DATATYPE[code], 1)
    return writer.fields()
