"""Masked rounds, on the server's side and on a client's: one attempt at a masked sum."""

from __future__ import annotations

import secrets
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.encodings.floats import Float32
from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal
from geoorbit_ros.federated.keys import Signer, Verifier
from geoorbit_ros.federated.payloads.client_update import ClientUpdate
from geoorbit_ros.federated.privacy.coordinator import Coordinator
from geoorbit_ros.federated.privacy.message import SCHEMA, SecureMessage
from geoorbit_ros.federated.privacy.participant import Participant
from geoorbit_ros.federated.rounds.open_round import Outcome
from geoorbit_ros.federated.rounds.verdict import GainSums, gain_terms

EXTRA = 6
"""Numbers behind the weights: loss, whether it trains, and what `verdict.gain_terms` gives."""
LOSS_SCALE = 1e3
"""Losses are sent in thousands behind the weights, to fit the weights' range. Chosen: larger rounds
small losses more, smaller cuts large ones."""
STAGE_S = 30.0
"""Longest wait for the steps after the first, in which clients only compute. Chosen: longer delays
a round when a client is lost, shorter loses slow clients."""


def masked_vector(update: ClientUpdate, size: int) -> NDArray[np.float32]:
    """What a client hides: its weights, its loss, its gain; shape (size + EXTRA,)."""
    extra = [0.0, 0.0, *gain_terms(update.gain)]
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
        """Whether the open step may end before all clients were heard."""
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
        training_clients = round(count)
        gains = GainSums.of_sums(sums)
        if training_clients == 0:
            return Outcome(np.zeros_like(weights), float("nan"), 0, gains)
        return Outcome(
            weights / training_clients,
            loss / training_clients * LOSS_SCALE,
            training_clients,
            gains,
        )


class MaskedClient:
    """Takes part in one masked sum after the other.

    Args:
        own_id: Number of the client.
        signer: Signs its steps.
        verifier: Checks the server's.
    """

    def __init__(self, own_id: int, signer: Signer, verifier: Verifier) -> None:
        self._id, self._signer, self._verifier = own_id, signer, verifier
        self._participant: Participant | None = None

    def begin(self, kept: bytes, size: int) -> bytes:
        """First step of a masked sum, with fresh secrets.

        Args:
            kept: The update as the client keeps it, float32 and never sent.
            size: Number of weights.
        """
        update = ClientUpdate.decode(kept)
        values = masked_vector(update, size)
        self._participant = Participant(self._id, update.round, update.model, values)
        return self._signer.seal(self._participant.keys().unsigned())

    def assist(self, payload: bytes) -> bytes | None:
        """The next step, for one of the server's; None without a part in that sum.

        Raises:
            PayloadError: It was refused.
        """
        message = SecureMessage.decode(payload)
        if self._participant is None:
            return None  # not selected, or started again: then it counts as dropped out
        if message.sender:
            found = f"sender {message.sender}"
            raise PayloadError(Refusal.UNKNOWN_SENDER, SCHEMA, found, "the server, 0")
        self._verifier.check(payload, SCHEMA)
        return self._signer.seal(self._participant.answer(message).unsigned())
