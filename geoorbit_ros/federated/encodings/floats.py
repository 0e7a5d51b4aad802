"""IEEE 754 floats, little endian: float32 is exact, float16 halves the bytes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geoorbit_ros.core.plugins import register
from geoorbit_ros.federated.encodings.encoding import check_finite, check_length
from geoorbit_ros.federated.payloads.model_layout import Vector

FLOAT16_MAX = 65504.0
"""Largest finite number of IEEE 754 binary16."""


@register("encoding", "float32")
@dataclass(frozen=True, slots=True)
class Float32:
    """Every weight as it is: 4 bytes each."""

    code: int = 0

    def encode(self, vector: Vector) -> bytes:
        """See `Encoding.encode`."""
        return vector.astype("<f4").tobytes()

    def decode(self, data: bytes, size: int) -> Vector:
        """See `Encoding.decode`."""
        check_length(data, 4 * size, "float32")
        return check_finite(np.frombuffer(data, "<f4"), "float32")


@register("encoding", "float16")
@dataclass(frozen=True, slots=True)
class Float16:
    """Every weight rounded to 11 significant bits: 2 bytes each; larger than 65504 is cut."""

    code: int = 1

    def encode(self, vector: Vector) -> bytes:
        """See `Encoding.encode`."""
        return np.clip(vector, -FLOAT16_MAX, FLOAT16_MAX).astype("<f2").tobytes()

    def decode(self, data: bytes, size: int) -> Vector:
        """See `Encoding.decode`."""
        check_length(data, 2 * size, "float16")
        return check_finite(np.frombuffer(data, "<f2").astype(np.float32), "float16")
