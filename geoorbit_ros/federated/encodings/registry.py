"""Encodings by the name that users give and by the number in payloads."""

from __future__ import annotations

from geoorbit_ros.federated.encodings.encoding import Encoding
from geoorbit_ros.federated.encodings.floats import Float16, Float32
from geoorbit_ros.federated.encodings.int8 import Int8
from geoorbit_ros.federated.encodings.top_k import TopK
from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal
from geoorbit_ros.federated.payloads.model_layout import Vector

ENCODINGS = ("float32", "float16", "int8", "top_k")
_BY_CODE: dict[int, Encoding] = {e.code: e for e in (Float32(), Float16(), Int8(), TopK())}


def make_encoding(name: str, top_k_share: float = 0.1, top_k_bits: int = 4) -> Encoding:
    """An encoding by name.

    Raises:
        FederationError: No encoding has this name, or top-k can't take these settings.
    """
    if name == "top_k":
        return TopK(top_k_share, top_k_bits)
    if name not in ENCODINGS:
        raise FederationError("encoding", repr(name), " or ".join(ENCODINGS))
    return _BY_CODE[ENCODINGS.index(name)]


def decode_vector(code: int, data: bytes, size: int) -> Vector:
    """The vector of shape (size,) in a payload's data.

    Raises:
        PayloadError: ENCODING, SHAPE or NOT_FINITE.
    """
    encoding = _BY_CODE.get(code)
    if encoding is None:
        expected = f"0 to {len(_BY_CODE) - 1}"
        raise PayloadError(Refusal.ENCODING, "field encoding", code, expected)
    return encoding.decode(data, size)
