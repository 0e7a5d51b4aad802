"""Secrets in shares: some of them restore it, fewer say nothing (Shamir, CACM 1979)."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence

from geoorbit_ros.federated.errors import FederationError

PRIME = 2**521 - 1
"""A Mersenne prime above every secret."""
SHARE_BYTES = 66
"""521 bits."""
SECRET_BYTES = 32
"""Of an X25519 private key or a mask's seed."""


def split(secret: bytes, points: Sequence[int], threshold: int) -> dict[int, bytes]:
    """Shares of a secret of 32 bytes.

    Args:
        secret: What is shared.
        points: Where the polynomial is evaluated: distinct whole numbers from 1 below 2^32.
        threshold: How many shares restore the secret.

    Returns:
        A share of 66 bytes for each point.

    Raises:
        FederationError: More shares needed than there are.
    """
    if not 1 <= threshold <= len(set(points)) or 0 in points or len(secret) != SECRET_BYTES:
        found = f"{threshold} of {len(set(points))} shares of {len(secret)} bytes"
        raise FederationError("secret sharing", found, "shares enough, and 32 bytes")
    coefficients = [int.from_bytes(secret, "big")]
    coefficients += [secrets.randbelow(PRIME) for _ in range(threshold - 1)]
    shares = {}
    for point in points:
        value = 0
        for coefficient in reversed(coefficients):
            value = (value * point + coefficient) % PRIME
        shares[point] = value.to_bytes(SHARE_BYTES, "big")
    return shares


def restore(shares: Mapping[int, bytes]) -> bytes:
    """The secret behind shares by their points; with too few or wrong ones, another number.

    Raises:
        FederationError: Shares that belong to no secret of 32 bytes.
    """
    total = 0
    for point, share in shares.items():
        top = bottom = 1
        for other in shares:
            if other != point:
                top = top * other % PRIME
                bottom = bottom * (other - point) % PRIME
        value = int.from_bytes(share, "big") % PRIME
        total = (total + value * top * pow(bottom, -1, PRIME)) % PRIME
    if total >> (8 * SECRET_BYTES):
        raise FederationError("secret sharing", "shares that do not fit", "shares of one secret")
    return total.to_bytes(SECRET_BYTES, "big")
