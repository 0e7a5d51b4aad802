"""Masks: streams of numbers that only two parties can make."""

from __future__ import annotations

import numpy as np
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from numpy.typing import NDArray

Words = NDArray[np.uint32]
"""Numbers modulo 2^32."""


def stream(key: bytes, size: int) -> Words:
    """The first numbers of ChaCha20's key stream (RFC 8439), shape (size,)."""
    cipher = Cipher(algorithms.ChaCha20(key, bytes(16)), mode=None)
    return np.frombuffer(cipher.encryptor().update(bytes(4 * size)), "<u4")


def shared_key(own: X25519PrivateKey, other: bytes, purpose: bytes) -> bytes:
    """32 bytes that both owners of a pair of X25519 keys can derive (RFC 7748, RFC 5869).

    Args:
        own: Private key.
        other: Public key of the other side.
        purpose: Separates keys for different uses.

    Raises:
        ValueError: A public key with which nothing can be agreed.
    """
    secret = own.exchange(X25519PublicKey.from_public_bytes(other))
    return HKDF(hashes.SHA256(), 32, salt=None, info=b"geoorbit_ros " + purpose).derive(secret)


def pairwise_mask(own_id: int, other_id: int, seed: bytes, size: int) -> Words:
    """What the client of the lower number adds and the other one subtracts."""
    mask = stream(seed, size)
    return mask if own_id < other_id else (np.uint32(0) - mask)


class Quantiser:
    """Maps weights to numbers modulo 2^32 whose sum over all clients can't wrap around.

    Args:
        limit: Largest magnitude of a weight; beyond it is cut.
        clients: Largest number of summands.
    """

    def __init__(self, limit: float, clients: int) -> None:
        self._limit = limit
        self._scale = (2**31 - 1) // clients / limit

    def forward(self, values: NDArray[np.float32]) -> Words:
        """Numbers modulo 2^32 for weights, shape (size,)."""
        cut = np.clip(values.astype(np.float64), -self._limit, self._limit)
        return np.rint(cut * self._scale).astype(np.int64).astype(np.uint32)

    def backward(self, total: Words) -> NDArray[np.float64]:
        """The sum of weights behind a sum of numbers."""
        return total.view(np.int32).astype(np.float64) / self._scale
