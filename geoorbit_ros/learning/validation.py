"""The verdict on a model: how much better or worse than the defaults each camera is with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from geoorbit_ros.federated.keys import client_id
from geoorbit_ros.federated.rounds.verdict import (
    NOT_VALIDATED,
    GainSums,
    Verdict,
    is_training_client,
    is_validation_client,
    validation_divisor,
)
from geoorbit_ros.learning.meta_learner import MetaLearner
from geoorbit_ros.learning.parameter_search import log_loss
from geoorbit_ros.metrics.paper_losses import LaneLosses

VALIDATE_EVERY = 4
"""One in so many seen cameras validates, the default of `validate_every` in
params/federated_server.yaml. Chosen: more validation cameras leave fewer to train with."""


@dataclass(frozen=True, slots=True)
class ValidationCameras:
    """Cameras that validate and do not train.

    Attributes:
        names: Their names.
        divisor: Who they are, as `federated.verdict.is_validation_client` has it.
        gains: Their gains with a model, in the order of `names`.
    """

    names: tuple[str, ...]
    divisor: int
    gains: Callable[[MetaLearner], list[float]]

    def verdict(self, learner: MetaLearner) -> Verdict:
        """Their verdict on a model."""
        return verdict_of(self.gains(learner))


def gains_of(model: Sequence[LaneLosses], fixed: Sequence[LaneLosses]) -> list[float]:
    """ln(L_total + 1) with a model minus the same with the defaults, camera by camera."""
    return [log_loss(new) - log_loss(old) for new, old in zip(model, fixed, strict=True)]


def verdict_of(gains: Sequence[float]) -> Verdict:
    """The verdict; with fewer than two gains there is none, and the model is used."""
    return GainSums.of(gains).verdict() or NOT_VALIDATED


def roles(camera_ids: Sequence[str]) -> tuple[int, frozenset[str], frozenset[str]]:
    """Which cameras train and which validate, by the rule of the federation.

    Returns:
        The divisor, training cameras, and validation cameras; in a small population all are both.
    """
    numbers = {name: client_id(name, None) for name in camera_ids}
    divisor = validation_divisor(numbers.values(), VALIDATE_EVERY)
    training = frozenset(
        name for name, number in numbers.items() if is_training_client(number, divisor)
    )
    validating = frozenset(
        name for name, number in numbers.items() if is_validation_client(number, divisor)
    )
    return divisor, training, validating
