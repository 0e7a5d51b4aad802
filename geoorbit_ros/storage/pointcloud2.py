"""Tables as `sensor_msgs/msg/PointCloud2` in CDR, without a Python object per row or field.

Layout: OMG DDS-RTPS 2.5 section 10 (encapsulation, little-endian plain CDR) around
sensor_msgs/PointCloud2. Alignment counts from after the 4-byte encapsulation header.
"""

from __future__ import annotations

import struct
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import MessageError, TableError

MESSAGE_TYPE = "sensor_msgs/msg/PointCloud2"

_DATATYPE = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
"""sensor_msgs/PointField constants by numpy type."""
_DATATYPE_NAME = dict(
    enumerate(("INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32", "FLOAT32", "FLOAT64"), 1)
)
_NUMPY_TYPE = {number: np.dtype(code).newbyteorder("<").str for code, number in _DATATYPE.items()}

_CDR_LE = b"\x00\x01"
_U32 = struct.Struct("<I")
_HEADER = struct.Struct("<4xiII")  # encapsulation, stamp, length of frame_id
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
    second, nanosecond = divmod(int(stamp_ns), 1_000_000_000)
    size = len(rows) * rows.dtype.itemsize
    try:
        stamp = struct.pack("<iI", second, nanosecond)
    except struct.error:
        raise TableError("message stamp", f"{stamp_ns} ns", "seconds that fit in 32 bits") from None
    return b"".join(
        (
            b"\x00\x01\x00\x00",
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
    try:
        return _decode(data, dtype, place)
    except (struct.error, UnicodeDecodeError, IndexError):
        raise MessageError(
            place, f"{len(data)} bytes that end or break within the message", f"a {MESSAGE_TYPE}"
        ) from None


def _decode(data: bytes, dtype: np.dtype[np.void], place: str) -> tuple[int, str, NDArray[np.void]]:
    if data[:2] != _CDR_LE:
        raise MessageError(place, f"CDR encapsulation 0x{data[:2].hex()}", "0x0001, little-endian")
    second, nanosecond, length = _HEADER.unpack_from(data)
    at = 16 + length
    frame_id = data[16 : at - 1].decode()
    at += -at % 4
    height, width = _SHAPE.unpack_from(data, at)
    at += 8
    own_fields = _field_block(dtype)
    fields = None  # the fields are exactly those of dtype: nothing to look up
    if data.startswith(own_fields, at):
        at += len(own_fields)
    else:
        fields, at = _read_fields(data, at)
    big_endian, point_step, row_step, size = _DATA_HEAD.unpack_from(data, at)
    at += _DATA_HEAD.size
    if big_endian:
        raise MessageError(place, "big-endian points", "little-endian points")
    if nanosecond >= 1_000_000_000:
        raise MessageError(place, f"a stamp with {nanosecond} nanoseconds", "less than 10^9")
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
    if len(data) < at + size + 1:
        raise MessageError(
            place, f"{max(len(data) - at - 1, 0)} bytes of data", f"{size} as announced"
        )
    rows = np.frombuffer(data, layout, height * width, at)
    # Either way a copy in the layout of dtype: aligned, writable, independent of the message.
    rows = rows.copy() if layout is dtype else rows.astype(dtype)
    return second * 1_000_000_000 + nanosecond, frame_id, rows


def _read_fields(data: bytes, at: int) -> tuple[tuple[tuple[str, int, int, int], ...], int]:
    """The PointField sequence at `at` as (name, offset, datatype, count), and where it ends."""
    (number,) = _U32.unpack_from(data, at)
    at += 4
    fields = []
    for _ in range(number):
        (length,) = _U32.unpack_from(data, at)
        name = data[at + 4 : at + 3 + length].decode()
        at += 4 + length
        at += -at % 4
        fields.append((name, *_FIELD_END.unpack_from(data, at)))
        at += 12
    return tuple(fields), at


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
    text = frame_id.encode() + b"\x00"
    return _U32.pack(len(text)) + text + b"\x00" * (-len(text) % 4)


@lru_cache(maxsize=64)
def _field_block(dtype: np.dtype[np.void]) -> bytes:
    """The PointField sequence that describes `dtype`; starts and ends on 4-byte boundaries."""
    parts = [_U32.pack(len(dtype.names or ()))]
    for name, (kind, offset) in ((n, f[:2]) for n, f in (dtype.fields or {}).items()):
        code = kind.str[1:]
        if kind.str[0] == ">" or code not in _DATATYPE:
            raise TableError(
                f"table field '{name}'", kind.str, f"one of {', '.join(_DATATYPE)}, little-endian"
            )
        text = name.encode() + b"\x00"
        parts += [_U32.pack(len(text)), text, b"\x00" * (-len(text) % 4)]
        parts.append(_FIELD_END.pack(offset, _DATATYPE[code], 1))
    return b"".join(parts)
