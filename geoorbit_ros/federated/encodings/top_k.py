"""The few largest entries alone: for updates, with error feedback for what is left out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.plugins import register
from geoorbit_ros.federated.encodings.encoding import EncodingSettings
from geoorbit_ros.federated.encodings.int8 import (
    SCALE_BYTES,
    quantised,
    read_scale,
    restored,
    write_scale,
)
from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal
from geoorbit_ros.federated.payloads.model_layout import Vector

MAX_PARAMETER = 24
"""Largest Rice parameter: a gap is below `model_layout.MAX_SIZE`, 2^24."""


def rice_parameter(gaps: NDArray[np.int64]) -> int:
    """The parameter that needs the fewest bits for these gaps."""
    bits = [int(np.sum(gaps >> b)) + len(gaps) * b for b in range(MAX_PARAMETER + 1)]
    return int(np.argmin(bits))


def encode_indices(indices: NDArray[np.int64]) -> tuple[int, bytes]:
    """Ascending indices, shape (count,), as Rice parameter and bytes."""
    gaps = np.diff(indices, prepend=-1) - 1
    parameter = rice_parameter(gaps)
    low = (gaps[:, None] >> np.arange(parameter)) & 1
    high = gaps >> parameter
    unary = np.ones(int(np.sum(high)) + len(high), np.uint8)
    unary[np.cumsum(high + 1) - 1] = 0
    bits = np.concatenate([low.ravel().astype(np.uint8), unary])
    return parameter, np.packbits(bits).tobytes()


def decode_indices(data: bytes, parameter: int, count: int, size: int) -> NDArray[np.int64]:
    """Indices below `size`, ascending, shape (count,).

    Raises:
        PayloadError: ENCODING, when the bytes are not those of so many such indices.
    """
    bits = np.unpackbits(np.frombuffer(data, np.uint8))
    split = count * parameter
    ends = np.flatnonzero(bits[split:] == 0)[:count]
    used = split + (int(ends[-1]) + 1 if len(ends) else 0)
    if parameter > MAX_PARAMETER or len(ends) < count or len(data) != -(-used // 8):
        found = f"{len(data)} bytes of indices"
        raise PayloadError(Refusal.ENCODING, "top-k data", found, f"those of {count} indices")
    high = np.diff(ends, prepend=-1) - 1
    low = bits[:split].reshape(count, parameter) @ (1 << np.arange(parameter, dtype=np.int64))
    indices = np.cumsum((high << parameter) + low + 1) - 1
    if count and indices[-1] >= size:
        found = f"index {indices[-1]}"
        raise PayloadError(Refusal.SHAPE, "top-k data", found, f"below {size}")
    return indices


_EIGHT_BITS = 0x80
"""Flag beside the Rice parameter, see msg_defs/README.md."""
_LEVELS = {4: 7, 8: 127}
"""Largest value by number of bits: that of a signed integer."""


@register("encoding", "top_k")
@dataclass(frozen=True, slots=True)
class TopK:
    """The k entries of largest magnitude; all others are zero.

    Bytes: the largest magnitude as float32; one byte with the Rice parameter and, as its highest
    bit, whether values have 8 or 4 bits; k as LEB128; the values as shares of the largest
    magnitude in 1/127 or 1/7, two to a byte when of 4 bits; the indices (`rice`). Stich et al.,
    "Sparsified SGD with memory", NeurIPS 2018.

    Args:
        share: k as a share of the vector's size, above 0 and up to 1.
        bits: Bits per value, 4 or 8.

    Raises:
        FederationError: Another share or number of bits.
    """

    share: float = 0.1
    bits: int = 4
    code: int = 3

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1 or self.bits not in _LEVELS:
            found = f"a share of {self.share} and {self.bits} bits"
            raise FederationError("top-k", found, "a share above 0 up to 1, and 4 or 8 bits")

    @classmethod
    def from_settings(cls, settings: EncodingSettings) -> Self:
        """The encoding with this share and number of bits."""
        return cls(settings.top_k_share, settings.top_k_bits)

    def encode(self, vector: Vector) -> bytes:
        """See `Encoding.encode`."""
        count = math.ceil(self.share * len(vector))
        # Stable, so that ties fall the same way everywhere.
        chosen = np.sort(np.argsort(-np.abs(vector), kind="stable")[:count])
        head = write_scale(vector)
        levels = quantised(vector[chosen], read_scale(head, "top-k"), _LEVELS[self.bits])
        chosen, levels = chosen[levels != 0], levels[levels != 0]
        parameter, indices = encode_indices(chosen)
        kind = parameter | (_EIGHT_BITS if self.bits == 8 else 0)
        values = levels.tobytes() if self.bits == 8 else _pack_nibbles(levels)
        return head + bytes([kind]) + _leb128(len(chosen)) + values + indices

    def decode(self, data: bytes, size: int) -> Vector:
        """See `Encoding.decode`; reads any share and number of bits."""
        scale = read_scale(data, "top-k")
        kind = data[SCALE_BYTES] if len(data) > SCALE_BYTES else 0xFF
        parameter, bits = kind & ~_EIGHT_BITS, 8 if kind & _EIGHT_BITS else 4
        if parameter > MAX_PARAMETER:
            found = f"Rice parameter {parameter}"
            raise PayloadError(Refusal.ENCODING, "top-k data", found, f"0 to {MAX_PARAMETER}")
        count, at = _read_leb128(data, SCALE_BYTES + 1)
        end = at + (count * bits + 7) // 8
        if count > size or end > len(data):
            found = f"{count} entries in {len(data)} bytes"
            raise PayloadError(Refusal.SHAPE, "top-k data", found, f"up to {size} that are there")
        raw = np.frombuffer(data, np.int8, end - at, at)
        levels = raw if bits == 8 else _unpack_nibbles(raw, count)
        vector = np.zeros(size, np.float32)
        vector[decode_indices(data[end:], parameter, count, size)] = restored(
            levels, scale, _LEVELS[bits]
        )
        return vector


def _pack_nibbles(levels: NDArray[np.int8]) -> bytes:
    low = np.append(levels, np.zeros(len(levels) % 2, np.int8)).view(np.uint8) & 0xF
    return (low[::2] | (low[1::2] << 4)).astype(np.uint8).tobytes()


def _unpack_nibbles(raw: NDArray[np.int8], count: int) -> NDArray[np.int8]:
    pairs = raw.view(np.uint8)
    nibbles = np.stack([pairs & 0xF, pairs >> 4], axis=1).ravel()[:count].astype(np.int8)
    return np.where(nibbles > 7, nibbles - 16, nibbles).astype(np.int8)


def _leb128(number: int) -> bytes:
    groups = []
    while True:
        number, group = number >> 7, number & 0x7F
        groups.append(group | (0x80 if number else 0))
        if not number:
            return bytes(groups)


def _read_leb128(data: bytes, at: int) -> tuple[int, int]:
    """A number and where it ends; at most 4 bytes, and so below 2^28."""
    number = 0
    for k in range(4):
        if at + k >= len(data):
            break
        number |= (data[at + k] & 0x7F) << (7 * k)
        if not data[at + k] & 0x80:
            return number, at + k + 1
    raise PayloadError(Refusal.ENCODING, "top-k data", "no count", "a count of up to 4 bytes")
