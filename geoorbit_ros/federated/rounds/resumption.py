"""How a server goes on from a checkpoint, and what its operator should know of it."""

from __future__ import annotations

from dataclasses import dataclass

from geoorbit_ros.core.state_file import StateFile
from geoorbit_ros.federated.payloads.model_layout import ModelLayout
from geoorbit_ros.federated.rounds.epoch import Epochs
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.rounds.server_state import ServerState
from geoorbit_ros.federated.strategies.strategy import Strategy


@dataclass(frozen=True, slots=True)
class Resumption:
    """Takes up a checkpoint under the settings of now.

    Where rounds were added after training was over, or the newest checkpoint is damaged and the
    one before counts, another run begins with the model as it stands: clients that have heard more
    than the checkpoint knows would refuse the old one.

    Attributes:
        config: Settings of the server.
        layout: Of the model.
        epochs: Numbers the run.
        checkpoint: Where the state came from.
    """

    config: ServerConfig
    layout: ModelLayout
    epochs: Epochs
    checkpoint: StateFile

    def take_up(self, state: ServerState, strategy: Strategy) -> list[str]:
        """Give the strategy its memory, and begin another run where that must be.

        Returns:
            What has changed, in sentences.
        """
        notes, name = list(self.checkpoint.told), type(strategy).__name__
        if state.strategy in ("", name):
            strategy.restore(state.optimiser)
        elif state.optimiser:
            notes.append(f"the checkpoint is of {state.strategy}: {name} starts without its memory")
        more = state.trained and state.round <= self.config.rounds and not self._reached(state)
        if more:
            state.trained = state.finished = False
            notes.append(f"training goes on to {self.config.rounds} rounds")
        if more or self.checkpoint.fell_back:
            state.renew(self.epochs.next(self.config.run, state.run), self.layout)
            notes.append(f"this is run {state.run} of the federation, from round {state.round}")
        return notes

    def _reached(self, state: ServerState) -> bool:
        """Whether training ended because the loss was small enough."""
        return bool(state.history) and state.history[-1].loss <= self.config.target_loss
