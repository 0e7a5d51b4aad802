"""Which entries of a vector are meant: gaps between ascending indices in a Rice code.

R. F. Rice, "Some practical universal noiseless coding techniques", JPL 79-22, 1979. A gap g of
parameter b is its b low bits and, in unary, g >> b. All low bits come first and all unary parts
after them, so that both are read without a loop.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.errors import PayloadError, Refusal

MAX_PARAMETER = 24


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
