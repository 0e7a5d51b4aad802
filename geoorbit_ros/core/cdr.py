"""Plain little-endian CDR, the bytes of ROS messages, read and written without a message library.

A message library makes a Python object for each field and takes 30 times as long per payload
(rosbags' typestore); tests hold the bytes of both equal. Layout: OMG DDS-RTPS 2.5 section 10. A
number is aligned to its size, counted from after the 4-byte encapsulation header.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import MessageError

ENCAPSULATION = b"\x00\x01\x00\x00"
"""Header of plain CDR, little-endian, without options."""
LITTLE_ENDIAN = ENCAPSULATION[:2]
"""Its part without the options, which some writers use."""
MAX_ITEMS = 1 << 16
"""Most items of one sequence of texts or numbers. Chosen: far more than any message here has, and
so few that a damaged length can't make its reader allocate much."""
SECOND_NS = 1_000_000_000
"""Nanoseconds of a second."""

_NUMBERS = {kind: struct.Struct(f"<{kind}") for kind in "bBhHiIqQfd"}
_LENGTH = struct.Struct("<I")
_STAMP = struct.Struct("<iI")
_HEADER = struct.Struct("<iII")
"""A stamp and the length of the frame's name."""


class CdrError(MessageError):
    """Bytes that are not the message that they should be."""


def stamp_of(message: bytes) -> int:
    """Nanoseconds of the stamp that a serialised message begins with, without looking further."""
    second, nanosecond = _STAMP.unpack_from(message, 4)
    return int(second) * SECOND_NS + int(nanosecond)


def with_stamp(message: bytes, stamp_ns: int) -> bytes:
    """The message with another stamp at its beginning."""
    return message[:4] + _STAMP.pack(*divmod(stamp_ns, SECOND_NS)) + message[4 + _STAMP.size :]


class CdrWriter:
    """Appends fields in the order of a .msg definition; padding is zero."""

    def __init__(self) -> None:
        self._data = bytearray(ENCAPSULATION)

    def raw(self, value: bytes) -> None:
        """Bytes as they are: an array of fixed length, or fields that are already serialised."""
        self._data += value

    def align(self, size: int) -> None:
        """Pad with zeros to a multiple of `size`."""
        self._data += bytes((4 - len(self._data)) % size)

    def pack(self, layout: struct.Struct, *values: float, alignment: int = 4) -> None:
        """Several numbers at once; the layout names its own padding."""
        data = self._data
        if pad := (4 - len(data)) % alignment:
            data += bytes(pad)
        data += layout.pack(*values)

    def number(self, kind: str, value: float) -> None:
        """One number; `kind` is its letter in the struct module."""
        layout = _NUMBERS[kind]
        self.pack(layout, value, alignment=layout.size)

    def text(self, value: str) -> None:
        """A string with its closing zero."""
        self.data(value.encode() + b"\0")

    def texts(self, values: Sequence[str]) -> None:
        """A sequence of strings."""
        self.pack(_LENGTH, len(values))
        for value in values:
            self.text(value)

    def numbers(self, kind: str, values: Sequence[float]) -> None:
        """A sequence of numbers."""
        self.pack(_LENGTH, len(values))
        if len(values):
            self.align(_NUMBERS[kind].size)
        self._data += struct.pack(f"<{len(values)}{kind}", *values)

    def data(self, value: bytes) -> None:
        """A sequence of bytes."""
        self.pack(_LENGTH, len(value))
        self._data += value

    def header(self, stamp_ns: int, frame_id: str) -> None:
        """A `std_msgs/Header`, padded to four bytes.

        Raises:
            struct.error: Seconds that don't fit in 32 bits.
        """
        self.pack(_STAMP, *divmod(stamp_ns, SECOND_NS))
        self.text(frame_id)
        self.align(4)

    def fields(self) -> bytes:
        """What was appended, to become a part of a message."""
        return bytes(self._data[4:])

    def message(self, last: bytes = b"") -> bytes:
        """Everything, and at its end bytes that are too many to be copied twice."""
        return b"".join((self._data, last))


class CdrReader:
    """Takes fields in the order of a .msg definition.

    Args:
        message: The serialised message with its encapsulation header.
        place: Where it comes from, for errors: a topic, a schema.
        kind: What it should be, for errors, such as `a std_msgs/String`.

    Raises:
        CdrError: It isn't little-endian CDR. All methods raise it where the message ends too
            early or a length or a text can't be.
    """

    __slots__ = ("_at", "_data", "_kind", "_place")

    def __init__(self, message: bytes, place: str, kind: str = "a whole message") -> None:
        self._data, self._place, self._kind, self._at = message, place, kind, 4
        if not message.startswith(LITTLE_ENDIAN):
            self._malformed(
                f"CDR encapsulation 0x{message[:2].hex()}", f"0x0001, little-endian, of {kind}"
            )

    @property
    def left(self) -> int:
        """Bytes that have not been read."""
        return len(self._data) - self._at

    def unpack(self, layout: struct.Struct, alignment: int = 4) -> tuple[Any, ...]:
        """Several numbers at once; the layout names its own padding."""
        at = self._at + (4 - self._at) % alignment
        self._at = at + layout.size
        try:
            return layout.unpack_from(self._data, at)
        except struct.error:
            self._cut_short()

    def number(self, kind: str) -> float:
        """One number; integers come as int."""
        layout = _NUMBERS[kind]
        value: float = self.unpack(layout, layout.size)[0]
        return value

    def whole(self, kind: str) -> int:
        """One integer."""
        return int(self.number(kind))

    def skip(self, length: int) -> None:
        """Pass over bytes; that they are there shows when the next field is read."""
        self._at += length

    def take(self, length: int, alignment: int = 1) -> memoryview:
        """The next bytes, not copied."""
        at = self._at + (4 - self._at) % alignment
        self._at = at + length
        if self._at > len(self._data):
            self._cut_short()
        return memoryview(self._data)[at : self._at]

    def skip_block(self, block: bytes) -> bool:
        """Pass over these bytes if they come next, on a multiple of four; else stay."""
        at = self._at + (4 - self._at) % 4
        if not self._data.startswith(block, at):
            return False
        self._at = at + len(block)
        return True

    def data(self) -> memoryview:
        """A sequence of bytes, not copied."""
        return self.take(self.unpack(_LENGTH)[0])

    def text(self) -> str:
        """A string; some writers leave out the closing zero of an empty one."""
        return self._string(self.unpack(_LENGTH)[0])

    def texts(self) -> list[str]:
        """A sequence of strings."""
        return [self.text() for _ in range(self._length())]

    def numbers(self, kind: str) -> NDArray[Any]:
        """A sequence of numbers, shape (length,), read-only."""
        length, size = self._length(), _NUMBERS[kind].size
        return np.frombuffer(self.take(length * size, size if length else 1), f"<{kind}")

    def header(self) -> tuple[int, str]:
        """Stamp in nanoseconds and frame of a `std_msgs/Header`."""
        second, nanosecond, length = self.unpack(_HEADER)
        if nanosecond >= SECOND_NS:
            self._malformed(f"a stamp with {nanosecond} nanoseconds", "less than 10^9")
        return second * SECOND_NS + nanosecond, self._string(length)

    def end(self) -> None:
        """Nothing may follow."""
        if self.left:
            self._too_long(f"{self.left} bytes after the last field", f"the end of {self._kind}")

    def _string(self, length: int) -> str:
        at = self._at
        self._at = at + length
        if self._at > len(self._data):
            self._cut_short()
        if length and self._data[self._at - 1]:
            self._malformed("a text without its closing zero", "one")
        try:
            return self._data[at : self._at - 1].decode() if length else ""
        except UnicodeDecodeError:
            self._malformed("a text that is not UTF-8", "UTF-8")

    def _length(self) -> int:
        length: int = self.unpack(_LENGTH)[0]
        if length > MAX_ITEMS:
            self._malformed(f"a sequence of {length}", f"{MAX_ITEMS} at most")
        return length

    def _cut_short(self) -> NoReturn:
        found = f"{len(self._data)} bytes that break off within the message"
        self._truncated(found, f"{self._kind}, {self._at} bytes or more")

    def _truncated(self, found: str, expected: str) -> NoReturn:
        raise CdrError(self._place, found, expected)

    def _malformed(self, found: str, expected: str) -> NoReturn:
        raise CdrError(self._place, found, expected)

    def _too_long(self, found: str, expected: str) -> NoReturn:
        raise CdrError(self._place, found, expected)
