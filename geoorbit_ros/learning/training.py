"""Training of the meta-learner over rounds: central (Meta) and federated (FedMeta)."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, field, fields
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.federated.encodings.encoding import make_encoding
from geoorbit_ros.federated.keys import Member, Roster
from geoorbit_ros.federated.payloads.global_model import interface_digest
from geoorbit_ros.federated.rounds.client import FederatedClient, LocalResult, Work
from geoorbit_ros.federated.rounds.in_process import run_in_process
from geoorbit_ros.federated.rounds.server import FederatedServer
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.rounds.traffic import Traffic
from geoorbit_ros.federated.rounds.verdict import NOT_VALIDATED, Verdict
from geoorbit_ros.federated.strategies.strategy import make_strategy
from geoorbit_ros.learning.features import FEATURE_NAMES
from geoorbit_ros.learning.local_training import (
    Examples,
    TrainingSettings,
    parameter_loss,
    train_locally,
)
from geoorbit_ros.learning.meta_learner import MetaLearner
from geoorbit_ros.learning.parameter_space import PARAMETER_NAMES
from geoorbit_ros.learning.validation import ValidationCameras
from geoorbit_ros.storage.atomic import atomic_output

Mode = Literal["central", "federated"]
MODES: tuple[Mode, ...] = ("central", "federated")


@dataclass(frozen=True, slots=True)
class Round:
    """The model before a round's training, over all seen cameras.

    Attributes:
        number: From 1.
        parameter_loss: Mean L_param.
        parameter_loss_std: Its standard deviation over the cameras.
        composite_loss: Mean L_total.
    """

    number: int
    parameter_loss: float
    parameter_loss_std: float
    composite_loss: float


CompositeLoss = Callable[[MetaLearner, Sequence[str]], NDArray[np.float64]]
"""(N,) L_total of the named cameras with the theta that a learner predicts for them."""


@dataclass(frozen=True, slots=True)
class RunSettings:
    """How the meta-learner is trained.

    Attributes:
        rounds: Most rounds.
        stop_below: The paper's lambda: training ends once the cameras' mean L_total is not above
            it. NaN: never.
        clients_per_round: Cameras that train in a federated round; 0: all.
        strategy: A registered name, or `FILE.py:CLASS`.
        encoding: A registered name.
        loss_every: Lanes are estimated anew in every so-many-th round only, the first and the last
            included; between them cameras report what they measured last. With `stop_below`, in
            every round.
        training: What happens between two rounds.
        seed: Of the first weights and of the selection of clients.
    """

    rounds: int = 20
    stop_below: float = float("nan")
    clients_per_round: int = 0
    strategy: str = "fedavg"
    encoding: str = "float32"
    loss_every: int = 5
    training: TrainingSettings = field(default_factory=TrainingSettings)
    seed: int = 0

    @property
    def loss_period(self) -> int:
        """Rounds from one measurement of the composite loss to the next."""
        return self.loss_every if np.isnan(self.stop_below) else 1


@dataclass(frozen=True, slots=True)
class TrainedModel:
    """What training gives.

    Attributes:
        learner: f_phi.
        rounds: Its history; the last entry is the final model, one beyond the last round.
        traffic: What crossed the wire; nothing in central training.
        verdict: Whether it is better than the defaults.
    """

    learner: MetaLearner
    rounds: tuple[Round, ...]
    traffic: Traffic
    verdict: Verdict = NOT_VALIDATED


def train(
    mode: Mode,
    examples: dict[str, Examples],
    composite: CompositeLoss,
    settings: RunSettings,
    on_round: Callable[[Round], None] | None = None,
    validation: ValidationCameras | None = None,
) -> TrainedModel:
    """Train on the examples of many cameras, by camera id, and validate the model.

    Both modes start from the same weights and take the same gradient steps on the same loss; one
    has all examples in one place, the other leaves each on its camera.
    """
    history: list[Round] = []
    known: dict[str, float] = {}

    def measure(learner: MetaLearner, last: bool = False) -> dict[str, float]:
        """Note a round; L_total by camera, as last measured."""
        names = list(examples)
        if last or len(history) % settings.loss_period == 0:
            known.update(zip(names, composite(learner, names).tolist(), strict=True))
        loss = np.concatenate([parameter_loss(learner, e) for e in examples.values()])
        total = float(np.mean(list(known.values())))
        history.append(Round(len(history) + 1, float(loss.mean()), float(loss.std()), total))
        if on_round:
            on_round(history[-1])
        return known

    start = MetaLearner.untrained(settings.seed)
    if mode == "central":
        learner = _train_central(examples, settings, start, measure)
        verdict, traffic = validation.verdict(learner) if validation else NOT_VALIDATED, Traffic()
    else:
        learner, verdict, traffic = _train_federated(examples, settings, start, measure, validation)
    measure(learner, last=True)
    return TrainedModel(learner, tuple(history), traffic, verdict)


_Measure = Callable[[MetaLearner], dict[str, float]]


def _train_central(
    examples: dict[str, Examples],
    settings: RunSettings,
    learner: MetaLearner,
    measure: _Measure,
) -> MetaLearner:
    everything = Examples(
        np.concatenate([e.features for e in examples.values()]),
        np.concatenate([e.targets for e in examples.values()]),
    )
    for number in range(1, settings.rounds + 1):
        if np.mean(list(measure(learner).values())) <= settings.stop_below:
            break
        tensors = learner.tensors()
        noise = _noise_seed(settings, number, 0)
        delta, _, _ = train_locally(tensors, everything, settings.training, seed=noise)
        learner = MetaLearner.from_tensors({name: tensors[name] + delta[name] for name in tensors})
    return learner


def _train_federated(
    examples: dict[str, Examples],
    settings: RunSettings,
    learner: MetaLearner,
    measure: _Measure,
    validation: ValidationCameras | None,
) -> tuple[MetaLearner, Verdict, Traffic]:
    interface = interface_digest(FEATURE_NAMES, PARAMETER_NAMES)
    config = ServerConfig(
        rounds=settings.rounds,
        target_loss=settings.stop_below,
        clients_per_round=settings.clients_per_round,
        encoding=settings.encoding,
        interface=interface,
        validation_divisor=validation.divisor if validation else 0,
        seed=settings.seed,
    )
    names = list(dict.fromkeys([*examples, *(validation.names if validation else ())]))
    roster = Roster([Member(name, None) for name in names])
    server = FederatedServer(config, learner.tensors(), roster, make_strategy(settings.strategy))
    clients = [
        FederatedClient(name, encoding=make_encoding(settings.encoding), interface=interface)
        for name in names
    ]
    work = _LocalWork(examples, settings, measure, validation)
    traffic = run_in_process(server, clients, work.answer)
    return MetaLearner.from_tensors(server.published), server.verdict, traffic


@dataclass(frozen=True, slots=True)
class _LocalWork:
    """What all cameras of a round do: train, validate, or both."""

    examples: dict[str, Examples]
    settings: RunSettings
    measure: _Measure
    validation: ValidationCameras | None

    def answer(self, asked: Sequence[tuple[FederatedClient, Work]]) -> list[LocalResult]:
        """The results of the clients of a round, in their order."""
        if not asked:
            return []
        learner = MetaLearner.from_tensors(asked[0][1].tensors)
        training = any(work.order.train for _, work in asked)
        losses = self.measure(learner) if training else {}
        gains = self._gains(learner, asked[0][1].round)
        return [
            self._result(client, work, losses, gains if work.order.validate else {})
            for client, work in asked
        ]

    def _result(
        self,
        client: FederatedClient,
        work: Work,
        losses: dict[str, float],
        gains: dict[str, float],
    ) -> LocalResult:
        name = client.camera_id
        gain = gains.get(name, float("nan"))
        if not work.order.train:
            return LocalResult({}, 0, 0.0, gain)
        delta, count, _ = train_locally(
            work.tensors,
            self.examples[name],
            self.settings.training,
            work.order.proximal_mu,
            _noise_seed(self.settings, work.round, client.id),
        )
        return LocalResult(delta, count, losses[name], gain)

    def _gains(self, learner: MetaLearner, number: int) -> dict[str, float]:
        """Gains by camera, in the rounds in which lanes are estimated anew; elsewhere none.

        Only the verdict on the last model decides.
        """
        last = number > self.settings.rounds or not np.isnan(self.settings.stop_below)
        due = last or (number - 1) % self.settings.loss_period == 0
        if self.validation is None or not due:
            return {}
        return dict(zip(self.validation.names, self.validation.gains(learner), strict=True))


def _noise_seed(settings: RunSettings, number: int, client: int) -> int:
    """Other noise in each round and on each camera, the same in each repetition."""
    sequence = np.random.SeedSequence([settings.seed, number, client])
    return int(sequence.generate_state(1)[0])


def save_history(rounds: Sequence[Round], path: Path) -> None:
    """Write the rounds as CSV."""
    with atomic_output(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as f:
        writer = csv.writer(f)
        writer.writerow(field.name for field in fields(Round))
        writer.writerows(astuple(entry) for entry in rounds)


def load_history(path: Path) -> list[Round]:
    """Read what `save_history` wrote.

    Raises:
        InputFileError: Not such a file.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file))
        if header != [field.name for field in fields(Round)]:
            raise InputFileError(str(path), f"columns {header}", "a history of geoorbit train")
        return [Round(int(row[0]), *map(float, row[1:])) for row in rows]
    except (OSError, ValueError) as error:
        raise InputFileError(str(path), error, "a history of geoorbit train") from error
