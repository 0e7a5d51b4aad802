"""The federated server as a plain state machine over bytes and time."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.state_file import StateFile
from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal
from geoorbit_ros.federated.keys import Roster, Signer
from geoorbit_ros.federated.payloads.client_update import ClientUpdate
from geoorbit_ros.federated.payloads.global_model import ASYNCHRONOUS, FINAL, MASKED, VALIDATING
from geoorbit_ros.federated.payloads.model_layout import ModelLayout, Tensors, Vector
from geoorbit_ros.federated.privacy.differential import clipped
from geoorbit_ros.federated.privacy.masked_rounds import STAGE_S, MaskedRound
from geoorbit_ros.federated.rounds.closing import Closing
from geoorbit_ros.federated.rounds.epoch import Epochs, Resumption
from geoorbit_ros.federated.rounds.model_broadcast import ModelBroadcast
from geoorbit_ros.federated.rounds.open_round import OpenRound, Outcome
from geoorbit_ros.federated.rounds.selection import make_selection
from geoorbit_ros.federated.rounds.server_config import ServerConfig, check_settings
from geoorbit_ros.federated.rounds.server_state import (
    KIND,
    Answers,
    RoundRecord,
    ServerState,
    read_checkpoint,
    write_checkpoint,
)
from geoorbit_ros.federated.rounds.update_checks import UpdateChecks
from geoorbit_ros.federated.rounds.verdict import (
    NOT_VALIDATED,
    Verdict,
    is_training_client,
    is_validation_client,
)
from geoorbit_ros.federated.strategies.strategy import FedAvg, Strategy

RETRY_S = 5.0
"""Between two tries to save a round. Chosen: longer delays the next round once there is room."""


class FederatedServer:
    """Runs rounds: announces a model, takes updates, makes the next model of them.

    It does nothing by itself: its driver (a node, the command line, a test) gives it what
    arrived and what time it is, and sends what comes out to all clients. Each method returns at
    most one payload. All that a round's result depends on is in its checkpoint, which is written
    before the result is announced: killed at any moment and started again, the server announces
    the open round once more, clients send their updates once more, and the result is the same.

    Validation clients report whether each round's model is better for them than the defaults
    (`verdict`); the next broadcast carries the verdict. After the last round they
    validate the final model.

    Usage::

        server = FederatedServer(config, tensors, roster, make_strategy("fedavg"))
        payload = server.start(now_s)            # send it to all clients
        while not server.finished:
            payload = server.receive(update, now_s)  # each update; not None: send it to all
            payload = server.tick(now_s)             # now and then; not None: send it to all
        server.tensors                           # the trained model

    Args:
        config: Settings.
        tensors: The first model by tensor; a checkpoint goes before it, but must fit it.
        roster: The cameras that may take part.
        strategy: Makes a model of updates; default: FedAvg.
        signer: Signs what is sent; default: unsigned.
        checkpoint: File to resume from and to write after each round; default: none.
        epochs: Numbers the run; default: by the settings alone.

    Attributes:
        asynchronous: Whether updates to earlier models are taken, too.
        fault: Why the server waits, such as a full disk; empty: it does not.
        notes: What the operator should know of the start, in sentences.
        accepted: Updates taken since the start.
        refused: Updates refused since the start, by reason.

    Raises:
        FederationError: A checkpoint that is none or of another model, or settings that exclude
            each other.
    """

    def __init__(
        self,
        config: ServerConfig,
        tensors: Mapping[str, NDArray[np.float32]],
        roster: Roster,
        strategy: Strategy | None = None,
        signer: Signer | None = None,
        checkpoint: Path | None = None,
        epochs: Epochs | None = None,
    ) -> None:
        self.config, self.layout = config, ModelLayout.of(tensors)
        self._members = tuple(roster)
        self._training = tuple(
            m for m in self._members if is_training_client(m, config.validation_divisor)
        )
        self._validating = tuple(
            m for m in self._members if is_validation_client(m, config.validation_divisor)
        )
        self._strategy = strategy or FedAvg()
        self.asynchronous = self._strategy.buffer_size > 0
        self._selection = make_selection(config.selection, config.seed)
        self._checks = UpdateChecks(
            config, roster, self.layout.size, asynchronous=self.asynchronous
        )
        self._broadcast = ModelBroadcast(
            config,
            self.layout,
            signer or Signer(None, config.federation),
            self._strategy.proximal_mu,
        )
        self._closing = Closing(config, self._strategy, self._broadcast, bool(self._validating))
        counts = (len(m) for m in (self._members, self._training, self._validating))
        check_settings(config, self._strategy, *counts)
        self._epochs = epochs or Epochs(None)
        self._checkpoint = StateFile(checkpoint, KIND) if checkpoint else None
        first = self.layout.flatten(tensors)
        answers = Answers(self._members)
        saved = (
            read_checkpoint(self._checkpoint, self.layout, answers) if self._checkpoint else None
        )
        self.resumed = saved is not None
        self._state = saved or ServerState(self._epochs.next(config.run), first, first, answers)
        self._next: ServerState | None = None
        self.fault, self._retry_s = "", 0.0
        self.notes = list(self._epochs.told)
        if roster.unsigned:
            names = ", ".join(roster.unsigned)
            self.notes.append(f"updates are taken unsigned, in whosever name, of: {names}")
        if saved and self._checkpoint:
            resumption = Resumption(config, self.layout, self._epochs, self._checkpoint)
            self.notes += resumption.take_up(saved, self._strategy)
        self.accepted = 0
        self.refused: Counter[Refusal] = Counter()
        self._selected: frozenset[int] = frozenset()
        self._wanted = len(self._training)
        self._opened_s = self._deadline_s = 0.0
        self._round = self._new_round()
        self._masked: MaskedRound | None = None

    @property
    def tensors(self) -> Tensors:
        """The model as it stands."""
        return self.layout.unflatten(self._state.model)

    @property
    def longest(self) -> int:
        """Bytes of the longest payload that a client may have to send, masked or not."""
        return 16 * self.layout.size + 1024 * len(self._members) + 65536

    @property
    def published(self) -> Tensors:
        """The model as the clients have it; differs from `tensors` by what encodings lose."""
        return self.layout.unflatten(self._state.published)

    @property
    def round(self) -> int:
        """The open round, from 1."""
        return self._state.round

    @property
    def run(self) -> int:
        """When the federation began."""
        return self._state.run

    @property
    def finished(self) -> bool:
        """Whether training is over, and its model validated."""
        return self._state.finished

    @property
    def history(self) -> tuple[RoundRecord, ...]:
        """What came of the rounds so far."""
        return tuple(self._state.history)

    @property
    def verdict(self) -> Verdict:
        """The verdict on the last model that was validated."""
        last = next((r for r in reversed(self._state.history) if r.validation_clients), None)
        if last is None:
            return NOT_VALIDATED if not self._validating else Verdict(False, math.nan, math.nan, 0)
        return Verdict(last.approved, last.gain, last.gain_error, last.validation_clients)

    @property
    def selected(self) -> frozenset[int]:
        """Clients of the open round; empty: all."""
        return self._selected

    @property
    def wanted(self) -> int:
        """Updates after which the open round ends before its deadline."""
        return self._wanted

    @property
    def collected(self) -> int:
        """Updates of the open round so far; under masks, clients heard at its open step."""
        return self._masked.number if self._masked else self._round.number

    @property
    def validated(self) -> int:
        """Validation clients heard so far in the open round; under masks always 0."""
        return self._round.heard

    @property
    def latched(self) -> tuple[bytes, ...]:
        """What to send, oldest first, to a client that joins now."""
        return tuple(self._broadcast.latched)

    def start(self, now_s: float) -> bytes:
        """Announce the first round, or after a restart the one that was open.

        Args:
            now_s: Any clock that does not go backwards, in seconds.

        Returns:
            The payload for all clients.
        """
        if not self.resumed:
            self._broadcast.advance(self._state)
            self._save(self._state)
        announce = self._broadcast.repeat if self.resumed else self._broadcast.announce
        return announce(self._state, self._open(now_s), self._flags)

    def receive(self, payload: bytes, now_s: float) -> bytes | None:
        """Take an update, or with secure aggregation a step of one.

        Returns:
            The next payload for all clients, when this one ends the round or the step.

        Raises:
            PayloadError: It was refused; the server goes on as if it had never come.
        """
        try:
            if self._next is not None:
                expected = "none: the round is over and waits to be saved"
                raise PayloadError(Refusal.OLD_ROUND, "update", "one more update", expected)
            if self._masked is not None:
                return self._receive_masked(self._masked, payload, now_s)
            update, vector = self._checks.check(payload, self._state, self._selected)
        except PayloadError as error:
            self.refused[error.reason] += 1
            raise
        self._take(update, vector)
        self.accepted += 1
        return self._close(self._round.outcome(), now_s) if self._complete else None

    def tick(self, now_s: float) -> bytes | None:
        """Look at the time.

        Returns:
            The next payload for all clients, when a deadline has passed: that of the next round or
            step if there is a quorum, else this round's again, now open to all.
        """
        if self._next is not None:
            return self._go_on(now_s) if now_s >= self._retry_s else None
        waits_for_time = not self.finished and (self._state.trained or not self.asynchronous)
        if not waits_for_time or now_s < self._deadline_s:
            return None
        if self._masked is not None:
            return self._advance_masked(self._masked, now_s)
        heard = self.validated if self._state.trained else self.collected
        if heard >= self._quorum():
            return self._close(self._round.outcome(), now_s)
        return self._again(now_s)

    def _take(self, update: ClientUpdate, vector: Vector | None) -> None:
        """Add an update that passed the checks, or a gain, to the open round."""
        answers = self._state.answers
        if vector is None:
            self._round.add_gain(update)
            answers.note(update.client, update.round)
            return
        if self.config.noise_multiplier:
            weight, vector = 1.0, clipped(vector, self.config.clip_norm)
        else:
            weight = self._strategy.weight(update.sample_count, self.round - update.round)
        self._round.add(update, vector, weight)
        if update.round == self.round and is_validation_client(
            update.client, self.config.validation_divisor
        ):
            self._round.gains.add(update.gain)
        answers.note(update.client, update.round, abs(update.loss) * math.sqrt(update.sample_count))

    @property
    def _complete(self) -> bool:
        """Whether all clients that it waits for were heard."""
        if self._state.trained:
            return self.validated >= len(self._validating)
        apart = (
            len(self._validating)
            if self.config.validation_divisor > 1 and not self.asynchronous
            else 0
        )
        return self.collected >= self._wanted and self.validated >= apart

    def _new_round(self) -> OpenRound:
        return OpenRound(self._strategy.collection(self.layout.size), self.layout.size)

    def _open(self, now_s: float) -> tuple[int, ...]:
        """Begin to collect for the open round; its clients, none for all."""
        number = self.config.clients_per_round
        chosen: tuple[int, ...] = ()
        free = self.asynchronous or self._state.trained
        if 0 < number < len(self._training) and not free:
            utility = self._state.answers.of(self._training)
            chosen = self._selection.choose(self._training, number, self.round, utility)
        self._selected = frozenset(chosen)
        # Stays when the round is opened to all: any client may then replace another one.
        self._wanted = self._strategy.buffer_size or len(chosen) or len(self._training)
        self._round = self._new_round()
        self._opened_s = now_s
        self._wait(now_s, chosen)
        return chosen

    def _wait(self, now_s: float, clients: tuple[int, ...]) -> None:
        """Set the deadline; under masks also begin an attempt, waiting for these clients' keys."""
        self._deadline_s = now_s + self.config.deadline_s
        if not self.config.secure_aggregation or self.finished:
            self._masked = None
            return
        apart = self._validating if self.config.validation_divisor > 1 else ()
        expected = {*clients, *apart} if clients else self._members
        self._masked = MaskedRound(
            self._validating if self._state.trained else expected,
            self._quorum(),
            self.round,
            self._state.digests[self.round],
            self.layout.size,
            self.config.masked_range,
        )

    def _again(self, now_s: float) -> bytes:
        """Announce the open round once more, to all."""
        self._selected = frozenset()
        self._wait(now_s, ())
        return self._broadcast.repeat(self._state, (), self._flags)

    def _quorum(self) -> int:
        wanted = len(self._validating) if self._state.trained else self._wanted
        return max(1, math.ceil(self.config.quorum * wanted))

    def _receive_masked(self, masked: MaskedRound, payload: bytes, now_s: float) -> bytes | None:
        message = self._checks.check_masked(payload, self._state, self._selected)
        masked.coordinator.take(message)
        self.accepted += 1
        return self._advance_masked(masked, now_s) if masked.coordinator.complete else None

    def _advance_masked(self, masked: MaskedRound, now_s: float) -> bytes | None:
        """End a step: the next one, the next round, or this round again where it failed."""
        if not masked.enough:
            return self._again(now_s)
        message = masked.advance()
        if message is not None:
            self._deadline_s = now_s + min(self.config.deadline_s, STAGE_S)
            return self._broadcast.seal(message.unsigned())
        try:
            outcome = masked.outcome()
        except FederationError:  # a client sent wrong shares: try again without this attempt
            return self._again(now_s)
        if outcome.training_clients == 0 and not self._state.trained:
            return self._again(now_s)
        return self._close(outcome, now_s)

    def _close(self, outcome: Outcome, now_s: float) -> bytes | None:
        """Note the verdict and make the next model, then go on with it."""
        self._next = self._closing.successor(self._state, outcome, now_s - self._opened_s)
        return self._go_on(now_s)

    def _go_on(self, now_s: float) -> bytes | None:
        """Save the next state, then take it, then announce it: no update is applied twice.

        Where it can't be saved the server waits and tries again, and makes nothing anew.
        """
        assert self._next is not None
        state, over = self._next, self._state.trained
        try:
            self._save(state)
        except InputFileError as error:
            self.fault = f"round {self.round} is over and can not be saved: {error}"
            self._retry_s = now_s + RETRY_S
            return None
        self._state, self._next, self.fault = state, None, ""
        chosen = self._open(now_s)
        if over:
            return self._broadcast.again(state, self._flags)
        return self._broadcast.announce(state, chosen, self._flags)

    def _save(self, state: ServerState) -> None:
        self._epochs.note(state.run)
        if self._checkpoint is not None:
            write_checkpoint(self._checkpoint, self.layout, state)

    @property
    def _flags(self) -> int:
        final = FINAL if self.finished else VALIDATING if self._state.trained else 0
        masked = MASKED if self.config.secure_aggregation else 0
        return final | masked | (ASYNCHRONOUS if self.asynchronous else 0)
