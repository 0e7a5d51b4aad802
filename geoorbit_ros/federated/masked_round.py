"""The open round under masks: one attempt at a masked sum."""

from __future__ import annotations

import secrets
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.secure_aggregation.coordinator import Coordinator
from geoorbit_ros.federated.secure_aggregation.message import SecureMessage
from geoorbit_ros.federated.strategies.collection import Aggregate

LOSS_SCALE = 1e3
"""Losses travel as thousands behind the weights, so that they fit the weights' range."""
STAGE_S = 30.0
"""Longest wait for the steps after the first, which only compute."""


def masked_vector(delta: NDArray[np.float32], loss: float) -> NDArray[np.float32]:
    """What a client hides: its update and its loss, shape (size + 1,)."""
    return np.append(delta, np.float32(loss / LOSS_SCALE)).astype(np.float32)


class MaskedRound:
    """One attempt; another one begins with fresh secrets on all sides.

    Args:
        expected: Clients that are waited for.
        at_least: As many must begin, when not all do.
        round_number: The round.
        model: Digest of its model.
        size: Number of weights.
        limit: Largest magnitude of a weight's change.
    """

    def __init__(
        self,
        expected: Iterable[int],
        at_least: int,
        round_number: int,
        model: int,
        size: int,
        limit: float,
    ) -> None:
        self._at_least = at_least
        session = secrets.randbelow(2**32 - 1) + 1
        self.coordinator = Coordinator(expected, round_number, model, session, size + 1, limit)

    @property
    def number(self) -> int:
        """Clients heard at the open step."""
        return self.coordinator.came

    @property
    def enough(self) -> bool:
        """Whether the open step may end before everybody was heard."""
        least = self.coordinator.least
        return self.number >= (max(least, self._at_least) if self.coordinator.stage == 0 else least)

    def advance(self) -> SecureMessage | None:
        """The next step's message; None when the sum can be taken.

        Raises:
            FederationError: Too few were heard.
        """
        return self.coordinator.advance()

    def result(self) -> tuple[Aggregate, float]:
        """Mean update, shape (size,), and mean loss; every client counts the same.

        Raises:
            FederationError: Shares that fit no secret.
        """
        survivors = len(self.coordinator.survivors)
        if survivors == 0:
            raise FederationError("secure aggregation", "no survivors", "clients enough")
        mean = self.coordinator.total() / survivors
        return mean[:-1], float(mean[-1]) * LOSS_SCALE
