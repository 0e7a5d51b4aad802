"""What follows from a round that is over: verdict, record, next model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geoorbit_ros.federated.privacy.differential import normal_noise
from geoorbit_ros.federated.rounds.model_broadcast import ModelBroadcast
from geoorbit_ros.federated.rounds.open_round import Outcome
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.rounds.server_state import RoundRecord, ServerState
from geoorbit_ros.federated.strategies.strategy import Strategy


@dataclass(frozen=True, slots=True)
class Closing:
    """Makes the next state of a server, and leaves the present one as it is.

    Attributes:
        config: Settings of the server.
        strategy: Makes a model of updates; it remembers the round.
        broadcast: Brings the published model nearer to the server's.
        validates: Whether the last model is validated after training.
    """

    config: ServerConfig
    strategy: Strategy
    broadcast: ModelBroadcast
    validates: bool

    def successor(self, before: ServerState, outcome: Outcome, seconds: float) -> ServerState:
        """The state after a round; called once for each round.

        Args:
            before: The state in which the round was open.
            outcome: What its updates come to.
            seconds: How long it was open.
        """
        state, verdict = before.successor(), outcome.gains.verdict()
        if verdict is not None:  # with fewer than two gains the last verdict stands
            state.approved = state.digests[state.round] if verdict.accepted else 0
        state.history.append(RoundRecord.of(state.round, outcome, verdict, seconds))
        if before.trained:
            state.finished = True
        else:
            self._advance(state, outcome)
        return state

    def _advance(self, state: ServerState, outcome: Outcome) -> None:
        """Make the next model."""
        config, aggregate = self.config, outcome.aggregate
        if config.noise_multiplier:
            noise = normal_noise(state.secret, state.round, len(aggregate))
            spread = config.noise_multiplier * config.clip_norm / outcome.training_clients
            aggregate = aggregate + spread * noise
        change = self.strategy.step(aggregate)
        state.model = (state.model + change).astype(np.float32)
        state.optimiser = {name: np.array(k) for name, k in self.strategy.state().items()}
        state.strategy = type(self.strategy).__name__
        state.round += 1
        state.trained = state.round > config.rounds or outcome.loss <= config.target_loss
        state.finished = state.trained and not self.validates
        self.broadcast.advance(state)
        oldest = state.round - config.max_staleness - 1
        state.digests = {n: digest for n, digest in state.digests.items() if n >= oldest}
