"""The protocol of encodings, their registry, and the checks that all of them share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Protocol, runtime_checkable

import numpy as np

from geoorbit_ros.core import plugins
from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.payloads.model_layout import Vector


@dataclass(frozen=True, slots=True)
class EncodingSettings:
    """Settings of all encodings; each takes its own.

    Attributes:
        top_k_share: Share of the entries that top-k sends.
        top_k_bits: Bits of each of them, 4 or 8.
    """

    top_k_share: float = 0.1
    top_k_bits: int = 4


@runtime_checkable
class Encoding(Protocol):
    """Turns a vector of weights into bytes and back, deterministically."""

    @property
    def code(self) -> int:
        """Its number in the payloads' field `encoding`."""

    def encode(self, vector: Vector) -> bytes:
        """Bytes of a finite vector of shape (size,)."""

    def decode(self, data: bytes, size: int) -> Vector:
        """The vector of shape (size,) that `encode` made these bytes from, or nearly.

        Raises:
            PayloadError: SHAPE, ENCODING or NOT_FINITE.
        """


def make_encoding(name: str, settings: EncodingSettings | None = None) -> Encoding:
    """An encoding by its registered name.

    Raises:
        ParameterError: No encoding has this name.
        FederationError: Top-k can't take these settings.
    """
    return plugins.make(
        "encoding",
        name,
        Encoding,  # type: ignore[type-abstract]
        settings or EncodingSettings(),
    )


def decode_vector(code: int, data: bytes, size: int) -> Vector:
    """The vector of shape (size,) in a payload's data.

    Args:
        code: Number of the encoding, from the payload.
        data: What was encoded.
        size: Number of weights of the model.

    Raises:
        PayloadError: ENCODING, SHAPE or NOT_FINITE.
    """
    encoding = _by_code().get(code)
    if encoding is None:
        known = ", ".join(map(str, sorted(_by_code())))
        raise PayloadError(Refusal.ENCODING, "field encoding", code, f"one of {known}")
    return encoding.decode(data, size)


@cache
def _by_code() -> dict[int, Encoding]:
    made = [make_encoding(name) for name in plugins.registered("encoding")]
    return {encoding.code: encoding for encoding in made}


def check_length(data: bytes, expected: int, what: str) -> None:
    """Refuse data that is not exactly as long as a vector of the model needs.

    Raises:
        PayloadError: SHAPE.
    """
    if len(data) != expected:
        raise PayloadError(Refusal.SHAPE, f"{what} data", f"{len(data)} bytes", f"{expected}")


def check_finite(vector: Vector, what: str) -> Vector:
    """Hand on a vector without infinities and NaN.

    Raises:
        PayloadError: NOT_FINITE.
    """
    finite = np.isfinite(vector)
    if not finite.all():
        bad = int(np.count_nonzero(~finite))
        found = f"{bad} values that are infinite or not a number"
        raise PayloadError(Refusal.NOT_FINITE, f"{what} data", found, "finite numbers")
    return vector


class ErrorFeedback:
    """Remembers what an encoding leaves out, and adds it to the next vector.

    Karimireddy et al., "Error feedback fixes SignSGD and other gradient compression schemes", ICML
    2019: with it, a biased encoding such as top-k reaches what no encoding reaches.

    Args:
        encoding: What sends.
        size: Length of the vectors.

    Attributes:
        residual: What has not been sent yet, shape (size,).
    """

    def __init__(self, encoding: Encoding, size: int) -> None:
        self.encoding = encoding
        self.residual: Vector = np.zeros(size, np.float32)

    def encode(self, vector: Vector) -> bytes:
        """Bytes of this vector plus what earlier ones left unsent."""
        meant = vector + self.residual
        data = self.encoding.encode(meant)
        self.residual = meant - self.encoding.decode(data, len(meant))
        return data
