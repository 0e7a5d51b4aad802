"""Sends an update again where nothing shows that it has arrived."""

from __future__ import annotations

from geoorbit_ros.federated.payloads.client_update import SCHEMA
from geoorbit_ros.federated.payloads.header import schema_of
from geoorbit_ros.federated.rounds.client import FederatedClient


class ResendQueue:
    """Keeps the last update until a newer model, or the end of training, shows that it was heard.

    No acknowledgement is needed: a synchronous server goes on once it has heard all clients. One
    that still waits refuses a second copy, so sending twice changes nothing. Steps of masked sums
    are not sent again: they belong to one attempt.

    Args:
        resend_s: Time to the first repetition; each further one takes twice as long. 0: never.
    """

    def __init__(self, resend_s: float) -> None:
        self._first_s = resend_s
        self._payload, self._model = b"", (0, 0, 0)
        self._due_s = self._wait_s = 0.0

    def pass_on(self, payload: bytes | None, client: FederatedClient, now_s: float) -> bytes | None:
        """A new payload, or the last once more where that is due.

        Args:
            payload: To be sent; None where there is nothing new.
            client: Whose it is.
            now_s: Time of a clock that does not go back.
        """
        if payload is not None:
            keep = self._first_s > 0 and schema_of(payload) == SCHEMA
            self._payload, self._model = payload if keep else b"", client.model_of
            self._wait_s = self._first_s
            self._due_s = now_s + self._wait_s
            return payload
        if client.finished or client.model_of != self._model:
            self._payload = b""
        if not self._payload or now_s < self._due_s:
            return None
        self._wait_s *= 2
        self._due_s = now_s + self._wait_s
        return self._payload
