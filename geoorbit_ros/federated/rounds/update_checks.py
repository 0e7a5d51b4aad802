"""Lets an update in, or says with one reason why not."""

from __future__ import annotations

import math

import numpy as np

from geoorbit_ros.federated.encodings.encoding import decode_vector
from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.keys import Roster, Verifier
from geoorbit_ros.federated.payloads.client_update import SCHEMA, ClientUpdate
from geoorbit_ros.federated.payloads.model_layout import Vector
from geoorbit_ros.federated.privacy.message import SCHEMA as SECURE
from geoorbit_ros.federated.privacy.message import SecureMessage
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.rounds.server_state import ServerState
from geoorbit_ros.federated.rounds.verdict import is_training_client, is_validation_client

_OVERHEAD_BYTES = 512
"""More than any update needs beyond 5 bytes per weight: the longest encoding is top-k of all."""


class UpdateChecks:
    """Checks updates in the order of `Refusal`: what is cheap and unforgeable comes first.

    Args:
        config: Settings of the server.
        roster: The allow list.
        size: Number of weights.
        asynchronous: Whether updates to earlier models are taken.
    """

    def __init__(
        self, config: ServerConfig, roster: Roster, size: int, *, asynchronous: bool
    ) -> None:
        self._config, self._size = config, size
        self._oldest = config.max_staleness if asynchronous else 0
        self._longest = 5 * size + _OVERHEAD_BYTES
        self._verifiers: dict[int, Verifier] = {}
        for number in roster:
            member = roster.get(number)
            if member is not None:
                self._verifiers[number] = Verifier(member.public, config.federation)

    def check(
        self, payload: bytes, state: ServerState, selected: frozenset[int]
    ) -> tuple[ClientUpdate, Vector | None]:
        """Read an update to the open round, or with an asynchronous strategy to an earlier one.

        Args:
            payload: As it came.
            state: Of the server; not changed.
            selected: Clients of the open round; empty: all on the roster.

        Returns:
            The update and its weights, shape (size,); None from a validation client.

        Raises:
            PayloadError: With any reason.
        """
        if len(payload) > self._longest:
            found = f"{len(payload)} bytes"
            raise PayloadError(Refusal.TOO_LONG, SCHEMA, found, f"{self._longest} at most")
        update = ClientUpdate.decode(payload)
        verifier = self._verifiers.get(update.client)
        if verifier is None:
            found = f"client {update.client}"
            raise PayloadError(Refusal.UNKNOWN_SENDER, SCHEMA, found, "one on the roster")
        self._check_round(update, state)
        self._check_role(update, state, selected)
        verifier.check(payload, SCHEMA)
        if not (math.isfinite(update.loss) and not math.isinf(update.gain)):
            found = f"loss {update.loss}, gain {update.gain}"
            raise PayloadError(Refusal.NOT_FINITE, SCHEMA, found, "finite ones")
        return update, self._checked_vector(update) if update.sample_count else None

    def check_masked(
        self, payload: bytes, state: ServerState, selected: frozenset[int]
    ) -> SecureMessage:
        """Read a client's step of a masked sum of the open round; its data are not looked at.

        Raises:
            PayloadError: With any reason.
        """
        message = SecureMessage.decode(payload)
        verifier = self._verifiers.get(message.sender)
        if verifier is None:
            found = f"client {message.sender}"
            raise PayloadError(Refusal.UNKNOWN_SENDER, SECURE, found, "one on the roster")
        if state.finished or message.round < state.round:
            found, expected = f"round {message.round}", f"round {state.round}"
            raise PayloadError(Refusal.OLD_ROUND, SECURE, found, expected)
        divisor = self._config.validation_divisor
        validates = divisor > 1 and is_validation_client(message.sender, divisor)
        if selected and message.sender not in selected and not validates:
            found = f"client {message.sender}"
            raise PayloadError(Refusal.NOT_SELECTED, SECURE, found, "one of this round")
        verifier.check(payload, SECURE)
        return message

    def _check_round(self, update: ClientUpdate, state: ServerState) -> None:
        if state.finished or update.round < state.round - self._oldest:
            expected = "none, training is over" if state.finished else f"round {state.round}"
            raise PayloadError(Refusal.OLD_ROUND, SCHEMA, f"round {update.round}", expected)
        if update.round > state.round:
            found, expected = f"round {update.round}", f"round {state.round}"
            raise PayloadError(Refusal.FUTURE_ROUND, SCHEMA, found, expected)
        if update.model != state.digests.get(update.round):
            found, expected = f"model {update.model:08x}", f"that of round {update.round}"
            raise PayloadError(Refusal.OTHER_MODEL, SCHEMA, found, expected)
        if state.answers.last(update.client) >= update.round:
            found = f"client {update.client} for round {update.round} again"
            raise PayloadError(Refusal.DUPLICATE, SCHEMA, found, "one update per round")

    def _check_role(
        self, update: ClientUpdate, state: ServerState, selected: frozenset[int]
    ) -> None:
        """Only training clients train; only validation clients report on the open model."""
        divisor, found = self._config.validation_divisor, f"client {update.client}"
        if update.sample_count:
            trains = is_training_client(update.client, divisor)
            if not trains or (selected and update.client not in selected):
                raise PayloadError(
                    Refusal.NOT_SELECTED, SCHEMA, found, "a training client of this round"
                )
            if state.trained:
                expected = "gains only, training is over"
                raise PayloadError(Refusal.OLD_ROUND, SCHEMA, f"round {update.round}", expected)
            return
        if not is_validation_client(update.client, divisor) or (divisor == 1 and not state.trained):
            raise PayloadError(
                Refusal.NOT_SELECTED, SCHEMA, found, "a validation client of this round"
            )
        if update.round < state.round:
            found, expected = f"round {update.round}", f"round {state.round}"
            raise PayloadError(Refusal.OLD_ROUND, SCHEMA, found, expected)
        if update.data:
            found = f"{len(update.data)} bytes of no examples"
            raise PayloadError(Refusal.SHAPE, SCHEMA, found, "no data")

    def _checked_vector(self, update: ClientUpdate) -> Vector:
        most = self._config.max_sample_count
        if update.sample_count > most:
            found = f"{update.sample_count} examples"
            raise PayloadError(Refusal.OUT_OF_RANGE, SCHEMA, found, f"{most} at most")
        vector = decode_vector(update.encoding, update.data, self._size)
        largest = float(np.max(np.abs(vector)))
        if not largest <= self._config.max_abs_update or abs(update.loss) > 1e9:
            found = f"a weight changed by {largest:g}, loss {update.loss:g}"
            expected = f"{self._config.max_abs_update:g} at most"
            raise PayloadError(Refusal.OUT_OF_RANGE, SCHEMA, found, expected)
        return vector
