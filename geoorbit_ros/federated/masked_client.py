"""A client's side of masked rounds: its update goes out under masks only."""

from __future__ import annotations

from geoorbit_ros.federated.client_update import ClientUpdate
from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.keys import Signer, Verifier
from geoorbit_ros.federated.masked_round import masked_vector
from geoorbit_ros.federated.secure_aggregation.message import SCHEMA, SecureMessage
from geoorbit_ros.federated.secure_aggregation.participant import Participant


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
