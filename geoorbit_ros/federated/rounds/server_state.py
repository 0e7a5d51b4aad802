"""What a server must not forget, and its checkpoint: one file, replaced as a whole."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.array_file import read_arrays
from geoorbit_ros.core.state_file import NewerStateError, StateFile
from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.payloads.model_layout import ModelLayout, Vector
from geoorbit_ros.federated.rounds.open_round import Outcome
from geoorbit_ros.federated.rounds.verdict import Verdict


class Answers:
    """One row per member of the roster.

    Args:
        members: Their numbers, ascending.

    Attributes:
        members: As given.
        answered: (M,) last round that each one's update was taken for, 0: none.
        utility: (M,) usefulness of that update (`Selection.choose`); NaN: none yet.
    """

    def __init__(self, members: Sequence[int]) -> None:
        self.members = tuple(members)
        self._row = {member: row for row, member in enumerate(self.members)}
        self.answered: NDArray[np.int64] = np.zeros(len(self.members), np.int64)
        self.utility: NDArray[np.float64] = np.full(len(self.members), np.nan)

    def last(self, member: int) -> int:
        """Last round that the member's update was taken for."""
        return int(self.answered[self._row[member]])

    def of(self, members: Sequence[int]) -> NDArray[np.float64]:
        """Utility of these members, in their order."""
        return self.utility[[self._row[member] for member in members]]

    def note(self, member: int, round_number: int, utility: float = float("nan")) -> None:
        """An update was taken."""
        row = self._row[member]
        self.answered[row] = round_number
        self.utility[row] = utility

    def take_over(
        self, members: Iterable[int], answered: Iterable[int], utility: Iterable[float]
    ) -> None:
        """Take rows from a checkpoint; members who left the roster meanwhile are dropped."""
        for member, number, value in zip(members, answered, utility, strict=True):
            if member in self._row:
                self.note(member, int(number), float(value))


FORMAT = 3
"""Of the checkpoint. 2: verdicts; 3: the strategy's name. Older ones are read."""
KIND = "a checkpoint of federated_server"


@dataclass(frozen=True, slots=True)
class RoundRecord:
    """What came of a round.

    Attributes:
        round: Its number, from 1.
        updates: Updates behind its result.
        loss: Mean loss that they report, weighted as the updates are.
        seconds: From its announcement to its end; not a number when the server was restarted
            meanwhile.
        validation_clients: How many validated the model that it started from.
        gain: Their mean gain (`verdict.Verdict`); NaN with fewer than two.
        gain_error: Its standard error.
        approved: Whether the verdict approves it.
    """

    round: int
    updates: int
    loss: float
    seconds: float
    validation_clients: int = 0
    gain: float = float("nan")
    gain_error: float = float("nan")
    approved: bool = False

    @classmethod
    def of(
        cls, number: int, outcome: Outcome, verdict: Verdict | None, seconds: float
    ) -> RoundRecord:
        """The record of a round with this outcome and verdict."""
        record = cls(number, outcome.training_clients, outcome.loss, seconds)
        if verdict is None:
            return record
        return replace(
            record,
            validation_clients=verdict.clients,
            gain=verdict.gain,
            gain_error=verdict.error,
            approved=verdict.accepted,
        )


@dataclass(slots=True)
class ServerState:
    """All that the next round depends on.

    Attributes:
        run: When the federation began.
        round: The open round; one more than the last when training is over.
        trained: Whether training is over; the last model may still have to be validated.
        finished: Whether everything is over.
        approved: Digest of the newest approved model; 0: none.
        model: The model as the server has it, shape (size,).
        published: The model as the clients have it: they differ by what encodings lose.
        optimiser: State of the strategy.
        answers: Who has answered which round.
        digests: Digest of each model that an update may still name, by round.
        history: Records of all rounds so far.
        secret: 32 bytes for noise that must stay unpredictable.
        strategy: Name of the strategy that `optimiser` is of; empty: not known.
    """

    run: int
    model: Vector
    published: Vector
    answers: Answers
    round: int = 1
    trained: bool = False
    finished: bool = False
    approved: int = 0
    optimiser: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    digests: dict[int, int] = field(default_factory=dict)
    history: list[RoundRecord] = field(default_factory=list)
    secret: bytes = field(default_factory=lambda: os.urandom(32))
    strategy: str = ""

    def renew(self, run: int, layout: ModelLayout) -> None:
        """Begin another run with the model as it stands: clients take it, and answer anew."""
        digest = layout.digest(self.published, run)
        self.approved = digest if self.approved == self.digests.get(self.round) else 0
        self.run, self.digests = run, {self.round: digest}
        self.answers.answered[:] = 0

    def successor(self) -> ServerState:
        """A copy that can become the next state, while this one stays as it is."""
        return replace(
            self,
            optimiser=dict(self.optimiser),
            digests=dict(self.digests),
            history=list(self.history),
        )


def write_checkpoint(file: StateFile, layout: ModelLayout, state: ServerState) -> None:
    """Replace the checkpoint: after a crash or power loss it is the old one or the new one.

    Raises:
        InputFileError: It can't be written.
    """
    facts = {
        "format": FORMAT,
        "names": layout.names,
        "shapes": layout.shapes,
        "run": state.run,
        "round": state.round,
        "trained": state.trained,
        "finished": state.finished,
        "approved": state.approved,
        "history": [list(asdict(record).values()) for record in state.history],
        "secret": state.secret.hex(),
        "strategy": state.strategy,
    }
    arrays: dict[str, NDArray[np.generic]] = {
        f"optimiser_{name}": value for name, value in state.optimiser.items()
    }
    arrays |= {
        "model": state.model,
        "published": state.published,
        "members": np.array(state.answers.members, np.uint32),
        "answered": state.answers.answered,
        "utility": state.answers.utility,
        "digests": _columns(state.digests),
        "facts": np.frombuffer(json.dumps(facts).encode(), np.uint8),
    }
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    file.write(buffer.getvalue())


def read_checkpoint(file: StateFile, layout: ModelLayout, answers: Answers) -> ServerState | None:
    """The state in a checkpoint, its answers filled in; None when there is none.

    Raises:
        FederationError: Files that are no checkpoint, or one of another model.
        NewerStateError: One of a newer version.
    """
    found = file.read(_checkpoint)
    if found is None:
        if file.told:
            raise FederationError(
                str(file.path), "; ".join(file.told), "a checkpoint, or none to begin anew"
            )
        return None
    stored, facts, arrays = found
    if stored != layout:
        raise FederationError(str(file.path), stored.describe(), layout.describe())
    columns = [arrays[name].tolist() for name in ("members", "answered", "utility")]
    answers.take_over(*columns)
    return _state(facts, arrays, answers)


_Checkpoint = tuple[ModelLayout, dict[str, Any], dict[str, NDArray[Any]]]


def _checkpoint(path: Path) -> _Checkpoint:
    """What is in a file, in the present format, and whole."""
    arrays = read_arrays(path, KIND)
    facts = json.loads(arrays.pop("facts").tobytes())
    version = facts.get("format", 1)
    if version > FORMAT:
        found = f"format {version}, of a newer version"
        raise NewerStateError(str(path), found, f"{KIND}, format {FORMAT} or older")
    if version < 2:
        facts |= {"trained": facts["finished"], "approved": 0}
    layout = ModelLayout(tuple(facts["names"]), tuple(map(tuple, facts["shapes"])))
    _state(facts, arrays, Answers(()))
    return layout, facts, arrays


def _state(
    facts: Mapping[str, object], arrays: dict[str, NDArray[np.float64]], answers: Answers
) -> ServerState:
    prefix = "optimiser_"
    history = facts["history"]
    assert isinstance(history, list)
    return ServerState(
        run=int(str(facts["run"])),
        model=arrays["model"].astype(np.float32),
        published=arrays["published"].astype(np.float32),
        round=int(str(facts["round"])),
        trained=bool(facts["trained"]),
        finished=bool(facts["finished"]),
        approved=int(str(facts["approved"])),
        optimiser={k[len(prefix) :]: v for k, v in arrays.items() if k.startswith(prefix)},
        answers=answers,
        digests={k: int(v) for k, v in zip(*_rows(arrays["digests"]), strict=True)},
        history=[RoundRecord(*row) for row in history],
        secret=bytes.fromhex(str(facts["secret"])),
        strategy=str(facts.get("strategy", "")),
    )


def _columns(table: Mapping[int, float]) -> NDArray[np.float64]:
    """Two rows: keys and values, both exact in float64 below 2^53."""
    return np.array([list(table), list(table.values())], np.float64)


def _rows(table: NDArray[np.float64]) -> tuple[list[int], list[float]]:
    return table[0].astype(np.int64).tolist(), table[1].tolist()
