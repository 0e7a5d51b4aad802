"""The number of a federation's run: it only grows, also where a checkpoint or the time was lost.

Clients refuse what is of an earlier run than they know. The number is the time at which the
run began, and so would be too small once the clock was set back. It is kept in a small file beside
the server's key, apart from the checkpoint.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.state_file import StateFile
from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.payloads.model_layout import ModelLayout
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.rounds.server_state import ServerState
from geoorbit_ros.federated.strategies.strategy import Strategy

MAX_RUN = 2**32 - 1
"""Runs are 32 bits wide in payloads."""


class Epochs:
    """Gives numbers to runs.

    Args:
        file: Where the last one is kept; None: nowhere, and only the clock makes it grow.

    Attributes:
        told: What was wrong with the file, in sentences.
    """

    def __init__(self, file: Path | None) -> None:
        self._state = StateFile(file, "the number of a federation's run") if file else None
        self._last = (self._state.read(_number) if self._state else None) or 0
        self.told = self._state.told if self._state else []

    def next(self, now_s: int, known: int = 0) -> int:
        """The number of a run that begins now.

        Args:
            now_s: Seconds since 1970, by whatever clock.
            known: The run before, as far as somebody knows.

        Raises:
            FederationError: There are no more numbers.
        """
        run = max(now_s, known + 1, self._last + 1)
        if run > MAX_RUN:
            raise FederationError("run", run, f"{MAX_RUN} at most: set this computer's clock")
        return run

    def note(self, run: int) -> None:
        """Keep the number before anybody hears it.

        Raises:
            InputFileError: It can't be written.
        """
        if self._state and run > self._last:
            self._state.write(f"{run}\n".encode())
            self._last = run


def _number(path: Path) -> int:
    run = int(path.read_text(encoding="ascii"))
    if not 0 <= run <= MAX_RUN:
        raise InputFileError(str(path), run, "a run")
    return run


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
