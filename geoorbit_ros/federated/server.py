"""The federated server as a plain state machine over bytes and time."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.admission import Admission
from geoorbit_ros.federated.announcer import Announcer
from geoorbit_ros.federated.client_update import ClientUpdate
from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.global_model import ASYNCHRONOUS, FINAL
from geoorbit_ros.federated.keys import Roster, Signer
from geoorbit_ros.federated.layout import ModelLayout, Tensors, Vector
from geoorbit_ros.federated.selection import make_selection
from geoorbit_ros.federated.server_config import ServerConfig
from geoorbit_ros.federated.server_state import (
    RoundRecord,
    ServerState,
    read_checkpoint,
    write_checkpoint,
)
from geoorbit_ros.federated.strategies.collection import Collection
from geoorbit_ros.federated.strategies.fedavg import FedAvg
from geoorbit_ros.federated.strategies.strategy import Strategy

_LOSS_BITS = 40


class FederatedServer:
    """Runs rounds: announces a model, takes updates, makes the next model of them.

    It does nothing by itself: whoever drives it (a node, the command line, a test) hands in what
    arrived and what time it is, and sends what comes out to all clients. Each method returns at
    most one payload. All that a round's result depends on is in its checkpoint, which is written
    before the result is announced: killed at any moment and started again, the server announces
    the open round once more, clients send their updates once more, and the result is the same.

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

    Attributes:
        accepted: Updates taken since the start.
        refused: Updates refused since the start, by reason.

    Raises:
        FederationError: A checkpoint that is none, or of another model.
    """

    def __init__(
        self,
        config: ServerConfig,
        tensors: Mapping[str, NDArray[np.float32]],
        roster: Roster,
        strategy: Strategy | None = None,
        signer: Signer | None = None,
        checkpoint: Path | None = None,
    ) -> None:
        self.config, self.layout = config, ModelLayout.of(tensors)
        self._members = tuple(roster)
        self._strategy = strategy or FedAvg()
        self._asynchronous = self._strategy.buffer_size > 0
        self._selection = make_selection(config.selection, config.seed)
        self._admission = Admission(
            config, roster, self.layout.size, asynchronous=self._asynchronous
        )
        self._announcer = Announcer(
            config,
            self.layout,
            signer or Signer(None, config.federation),
            self._strategy.proximal_mu,
        )
        self._checkpoint = checkpoint
        first = self.layout.flatten(tensors)
        saved = read_checkpoint(checkpoint, self.layout) if checkpoint else None
        self.resumed = saved is not None
        self._state = saved or ServerState(config.run, first, first)
        self._strategy.restore(self._state.optimiser)
        self.accepted = 0
        self.refused: Counter[Refusal] = Counter()
        self._selected: frozenset[int] = frozenset()
        self._wanted = len(self._members)
        self._deadline_s = math.inf
        self._open(0.0)

    @property
    def tensors(self) -> Tensors:
        """The model as it stands."""
        return self.layout.unflatten(self._state.model)

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
        """Whether training is over."""
        return self._state.finished

    @property
    def history(self) -> tuple[RoundRecord, ...]:
        """What came of the rounds so far."""
        return tuple(self._state.history)

    @property
    def selected(self) -> frozenset[int]:
        """Clients of the open round; empty: all."""
        return self._selected

    @property
    def collected(self) -> int:
        """Updates of the open round so far."""
        return self._collection.number

    @property
    def latched(self) -> tuple[bytes, ...]:
        """What to send, oldest first, to a client that joins now."""
        return tuple(self._announcer.latched)

    def start(self, now_s: float) -> bytes:
        """Announce the first round, or after a restart the one that was open.

        Args:
            now_s: Any clock that does not go backwards, in seconds.

        Returns:
            The payload for all clients.
        """
        self._open(now_s)
        if not self.resumed:
            self._announcer.advance(self._state)
            self._save()
            return self._announcer.announce(self._state, self._choose(), self._flags)
        return self._announcer.repeat(self._state, self._choose(), self._flags)

    def receive(self, payload: bytes, now_s: float) -> bytes | None:
        """Take an update.

        Returns:
            The next payload for all clients, when this update ends the round.

        Raises:
            PayloadError: It was refused; the server goes on as if it had never come.
        """
        try:
            update, vector = self._admission.admit(payload, self._state, self._selected)
            if self._pending.get(update.client, 0) >= update.round:
                found = f"client {update.client} for round {update.round} again"
                raise PayloadError(Refusal.DUPLICATE, "update", found, "one update per round")
        except PayloadError as error:
            self.refused[error.reason] += 1
            raise
        self._add(update, vector)
        return self._close(now_s) if self.collected >= self._wanted else None

    def tick(self, now_s: float) -> bytes | None:
        """Look at the time.

        Returns:
            The next payload for all clients, when a deadline has passed: that of the next round if
            there is a quorum, else this round's again, now open to all.
        """
        waits_for_time = not (self.finished or self._asynchronous)
        if not waits_for_time or now_s < self._deadline_s:
            return None
        if self.collected >= self._quorum():
            return self._close(now_s)
        self._selected = frozenset()
        self._deadline_s = now_s + self.config.deadline_s
        return self._announcer.repeat(self._state, (), self._flags)

    def _open(self, now_s: float) -> None:
        """Begin to collect for the open round."""
        self._collection: Collection = self._strategy.collection(self.layout.size)
        self._pending: dict[int, int] = {}
        self._loss_sum = self._loss_weight = 0
        self._opened_s = now_s
        self._deadline_s = now_s + self.config.deadline_s

    def _choose(self) -> tuple[int, ...]:
        """Select the clients of the open round; empty: all."""
        number = self.config.clients_per_round
        chosen: tuple[int, ...] = ()
        if 0 < number < len(self._members) and not (self._asynchronous or self.finished):
            utility = self._state.utility
            chosen = self._selection.choose(self._members, number, self.round, utility)
        self._selected = frozenset(chosen)
        # Stays when the round is opened to all: then anybody may stand in for the silent ones.
        self._wanted = self._strategy.buffer_size or len(chosen) or len(self._members)
        return chosen

    def _quorum(self) -> int:
        return max(1, math.ceil(self.config.quorum * self._wanted))

    def _add(self, update: ClientUpdate, vector: Vector) -> None:
        weight = self._strategy.weight(update.sample_count, self.round - update.round)
        self._collection.add(update.client, vector, weight)
        self._pending[update.client] = update.round
        self._state.utility[update.client] = abs(update.loss) * math.sqrt(update.sample_count)
        # Whole numbers, so that the mean does not depend on the order either.
        self._loss_sum += round(update.loss * 2**_LOSS_BITS) * update.sample_count
        self._loss_weight += update.sample_count
        self.accepted += 1

    def _close(self, now_s: float) -> bytes:
        """Make the next model, keep it, announce it."""
        state = self._state
        loss = self._loss_sum / self._loss_weight / 2**_LOSS_BITS
        change = self._strategy.step(self._collection.result())
        state.model = (state.model + change).astype(np.float32)
        state.optimiser = self._strategy.state()
        state.answered |= self._pending
        seconds = now_s - self._opened_s
        state.history.append(RoundRecord(self.round, self.collected, loss, seconds))
        state.round += 1
        state.finished = state.round > self.config.rounds or loss <= self.config.target_loss
        self._announcer.advance(state)
        for number in [n for n in state.digests if n < state.round - self.config.max_staleness - 1]:
            del state.digests[number]
        self._save()
        self._open(now_s)
        return self._announcer.announce(state, self._choose(), self._flags)

    def _save(self) -> None:
        if self._checkpoint is not None:
            write_checkpoint(self._checkpoint, self.layout, self._state)

    @property
    def _flags(self) -> int:
        return (FINAL if self.finished else 0) | (ASYNCHRONOUS if self._asynchronous else 0)
