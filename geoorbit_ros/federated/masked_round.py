"""The open round under masks: one attempt at a masked sum."""

from __future__ import annotations

import secrets
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.client_update import ClientUpdate
from geoorbit_ros.federated.encodings.floats import Float32
from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.open_round import Outcome
from geoorbit_ros.federated.secure_aggregation.coordinator import Coordinator
from geoorbit_ros.federated.secure_aggregation.message import SecureMessage
from geoorbit_ros.federated.verdict import Ballot, shares

EXTRA = 6
"""Numbers behind the weights: loss, whether it teaches, and what `verdict.shares` gives."""
LOSS_SCALE = 1e3
"""Losses travel as thousands behind the weights, so that they fit the weights' range."""
STAGE_S = 30.0
"""Longest wait for the steps after the first, which only compute."""


def masked_vector(update: ClientUpdate, size: int) -> NDArray[np.float32]:
    """What a client hides: its weights, its loss, its gain; shape (size + EXTRA,)."""
    extra = [0.0, 0.0, *shares(update.gain)]
    delta = np.zeros(size, np.float32)
    if update.sample_count:
        delta = Float32().decode(update.data, size)
        extra[:2] = [update.loss / LOSS_SCALE, 1.0]
    return np.append(delta, np.array(extra, np.float32)).astype(np.float32)


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
        self.coordinator = Coordinator(expected, round_number, model, session, size + EXTRA, limit)

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

    def outcome(self) -> Outcome:
        """What the clients' vectors add up to; every client counts the same.

        Raises:
            FederationError: Shares that fit no secret.
        """
        if not self.coordinator.survivors:
            raise FederationError("secure aggregation", "no survivors", "clients enough")
        total = self.coordinator.total()
        weights, (loss, count, *sums) = total[:-EXTRA], total[-EXTRA:].tolist()
        teachers = round(count)
        ballot = Ballot.of_sums(sums)
        if teachers == 0:
            return Outcome(np.zeros_like(weights), float("nan"), 0, ballot)
        return Outcome(weights / teachers, loss / teachers * LOSS_SCALE, teachers, ballot)
