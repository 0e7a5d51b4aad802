"""Plain little-endian CDR, written and read without a message library.

rosbags' typestore gives the same bytes and takes 30 times as long per payload; a test holds the
two equal. Layout: OMG DDS-RTPS 2.5 section 10; numbers are aligned to their size, counted from
after the 4-byte encapsulation header.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.errors import PayloadError, Refusal

ENCAPSULATION = b"\x00\x01\x00\x00"
MAX_ITEMS = 1 << 16
"""Most names or numbers in one sequence that is not the data itself."""

_SIZES = {"B": 1, "H": 2, "I": 4, "Q": 8, "f": 4, "d": 8}


class CdrWriter:
    """Appends fields in the order of a .msg definition."""

    def __init__(self) -> None:
        self._parts = bytearray()

    def number(self, kind: str, value: float) -> None:
        """One number; `kind` is its letter in the struct module."""
        self._align(_SIZES[kind])
        self._parts += struct.pack(f"<{kind}", value)

    def text(self, value: str) -> None:
        """A string with its closing zero."""
        raw = value.encode()
        self.number("I", len(raw) + 1)
        self._parts += raw + b"\0"

    def texts(self, values: Sequence[str]) -> None:
        """A sequence of strings."""
        self.number("I", len(values))
        for value in values:
            self.text(value)

    def numbers(self, kind: str, values: Sequence[float]) -> None:
        """A sequence of numbers."""
        self.number("I", len(values))
        if len(values):
            self._align(_SIZES[kind])
        self._parts += struct.pack(f"<{len(values)}{kind}", *values)

    def data(self, value: bytes) -> None:
        """A sequence of bytes."""
        self.number("I", len(value))
        self._parts += value

    def fixed(self, value: bytes) -> None:
        """An array of bytes whose length is part of the definition."""
        self._parts += value

    def payload(self) -> bytes:
        """Everything, behind the encapsulation header."""
        return ENCAPSULATION + bytes(self._parts)

    def _align(self, size: int) -> None:
        self._parts += bytes(-len(self._parts) % size)


class CdrReader:
    """Takes fields in the order of a .msg definition.

    Args:
        payload: The serialised message with its encapsulation header.
        place: What it is, for errors.

    Raises:
        PayloadError: MALFORMED, when it isn't little-endian CDR. All methods raise TRUNCATED where
            the payload ends too early, and MALFORMED where a length or a text can't be.
    """

    def __init__(self, payload: bytes, place: str) -> None:
        self._payload, self._place, self._at = payload, place, 4
        if payload[:4] != ENCAPSULATION:
            self._malformed(f"encapsulation {payload[:4].hex()}", ENCAPSULATION.hex())

    def number(self, kind: str) -> float:
        """One number; integers come as int."""
        raw = self._take(_SIZES[kind], _SIZES[kind])
        value: float = struct.unpack(f"<{kind}", raw)[0]
        return value

    def whole(self, kind: str) -> int:
        """One integer."""
        return int(self.number(kind))

    def text(self) -> str:
        """A string."""
        raw = self._take(self.whole("I"))
        if raw[-1:] != b"\0":
            self._malformed("a text without its closing zero", "one")
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError:
            self._malformed("a text that is not UTF-8", "UTF-8")

    def texts(self) -> list[str]:
        """A sequence of strings."""
        return [self.text() for _ in range(self._length())]

    def numbers(self, kind: str) -> NDArray[np.generic]:
        """A sequence of numbers, shape (length,)."""
        length = self._length()
        raw = self._take(length * _SIZES[kind], _SIZES[kind] if length else 1)
        return np.frombuffer(raw, np.dtype(f"<{kind}"))

    def data(self) -> bytes:
        """A sequence of bytes."""
        return self._take(self.whole("I"))

    def fixed(self, length: int) -> bytes:
        """An array of bytes."""
        return self._take(length)

    def end(self) -> None:
        """Nothing may follow.

        Raises:
            PayloadError: TOO_LONG, when something does.
        """
        extra = len(self._payload) - self._at
        if extra:
            raise PayloadError(
                Refusal.TOO_LONG, self._place, f"{extra} bytes after the last field", "none"
            )

    def _length(self) -> int:
        length = self.whole("I")
        if length > MAX_ITEMS:
            self._malformed(f"a sequence of {length}", f"{MAX_ITEMS} at most")
        return length

    def _take(self, length: int, alignment: int = 1) -> bytes:
        start = self._at + (4 - self._at) % alignment
        self._at = start + length
        if self._at > len(self._payload):
            found = f"{len(self._payload)} bytes"
            raise PayloadError(Refusal.TRUNCATED, self._place, found, f"{self._at} or more")
        return self._payload[start : self._at]

    def _malformed(self, found: str, expected: str) -> NoReturn:
        raise PayloadError(Refusal.MALFORMED, self._place, found, expected)
