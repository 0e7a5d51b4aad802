"""Eight-bit integers with one scale: a quarter of the bytes of float32."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.plugins import register
from geoorbit_ros.federated.encodings.encoding import check_length
from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.payloads.model_layout import Vector

SCALE_BYTES = 4
"""Length of the scale, a float32."""
MAX_SCALE = float(np.finfo(np.float32).max)


def write_scale(vector: Vector) -> bytes:
    """The largest magnitude as float32."""
    return struct.pack("<f", float(np.max(np.abs(vector), initial=0.0)))


def read_scale(data: bytes, what: str) -> np.float32:
    """The largest magnitude at the start of the data.

    Raises:
        PayloadError: SHAPE when it is not there, NOT_FINITE when it is not finite or negative.
    """
    if len(data) < SCALE_BYTES:
        found = f"{len(data)} bytes"
        raise PayloadError(Refusal.SHAPE, f"{what} data", found, f"{SCALE_BYTES} or more")
    scale: float = struct.unpack_from("<f", data)[0]
    if not 0 <= scale <= MAX_SCALE:
        raise PayloadError(Refusal.NOT_FINITE, f"{what} data", f"scale {scale}", "finite, from 0")
    return np.float32(scale)


def quantised(vector: Vector, scale: np.float32, levels: int) -> NDArray[np.int8]:
    """Whole numbers from -levels to levels in proportion to a vector within ±scale."""
    if scale == 0:
        return np.zeros(len(vector), np.int8)
    return np.rint(vector.astype(np.float64) / float(scale) * levels).astype(np.int8)


def restored(numbers: NDArray[np.int8], scale: np.float32, levels: int) -> Vector:
    """What `quantised` stands for; the same bits on every machine (one multiply in float64)."""
    return (numbers * (float(scale) / levels)).astype(np.float32)


@register("encoding", "int8")
@dataclass(frozen=True, slots=True)
class Int8:
    """The largest magnitude as float32, then every weight as its share of it in 1/127."""

    code: int = 2

    def encode(self, vector: Vector) -> bytes:
        """See `Encoding.encode`."""
        head = write_scale(vector)
        return head + quantised(vector, read_scale(head, "int8"), 127).tobytes()

    def decode(self, data: bytes, size: int) -> Vector:
        """See `Encoding.decode`."""
        check_length(data, SCALE_BYTES + size, "int8")
        return restored(
            np.frombuffer(data, np.int8, offset=SCALE_BYTES), read_scale(data, "int8"), 127
        )
