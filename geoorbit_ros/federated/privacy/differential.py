"""Differential privacy of the released models: updates are cut to a length, their sum gets noise.

McMahan et al., "Learning differentially private recurrent language models", ICLR 2018. What is
protected is a camera's whole part in a round; the server is trusted with the updates themselves.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.payloads.model_layout import Vector
from geoorbit_ros.federated.privacy.random_stream import stream


def clipped(update: Vector, clip_norm: float) -> Vector:
    """An update no longer than `clip_norm` in the Euclidean norm, direction unchanged."""
    length = float(np.linalg.norm(update.astype(np.float64)))
    # A hair less, so that rounding to float32 can't make it longer.
    return update if length <= clip_norm else update * np.float32(clip_norm / length * (1 - 1e-6))


def normal_noise(secret: bytes, round_number: int, size: int) -> NDArray[np.float64]:
    """Standard normal numbers, shape (size,), that can not be predicted without the secret.

    The same secret and round give the same numbers, so that a server that was killed and goes on
    does not release the same round with two noises, whose mean would hold less.

    Args:
        secret: 32 bytes of the server's own.
        round_number: The round.
        size: How many.
    """
    key = bytes(a ^ b for a, b in zip(secret, round_number.to_bytes(32, "little"), strict=True))
    words = stream(key, 2 * size).astype(np.uint64)
    uniform = ((words[:size] << np.uint64(21)) ^ words[size:]).astype(np.float64)
    return np.asarray(scipy.special.ndtri((uniform + 0.5) / 2.0**53))


def epsilon(noise_multiplier: float, rounds: int, delta: float) -> float:
    """Privacy loss of a camera that took part in so many rounds.

    Computed by the privacy loss distribution of Google's dp-accounting, which is tight. Nothing is
    gained from random selection here: the selected clients are public.

    Args:
        noise_multiplier: Standard deviation of the noise on the sum, in `clip_norm`.
        rounds: Rounds that the camera took part in.
        delta: Probability with which the bound may fail; well under 1 / number of cameras.

    Raises:
        FederationError: No noise, no rounds, or a delta outside (0, 1).
    """
    if not (noise_multiplier > 0 and rounds > 0 and 0 < delta < 1):
        found = f"noise {noise_multiplier}, {rounds} rounds, delta {delta}"
        raise FederationError("privacy", found, "noise and rounds above 0, delta in (0, 1)")
    # Takes seconds to import, and only who asks for epsilon needs it.
    from dp_accounting import GaussianDpEvent
    from dp_accounting.pld import PLDAccountant

    accountant = PLDAccountant().compose(GaussianDpEvent(noise_multiplier), rounds)
    return float(accountant.get_epsilon(delta))
