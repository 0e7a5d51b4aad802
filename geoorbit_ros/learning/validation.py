"""What judges say of a model: how much better or worse than the defaults each camera is with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from geoorbit_ros.federated.keys import client_id
from geoorbit_ros.federated.rounds.verdict import (
    NOBODY_ASKED,
    Ballot,
    Verdict,
    is_judge,
    is_teacher,
    judge_divisor,
)
from geoorbit_ros.learning.meta_learner import MetaLearner
from geoorbit_ros.learning.parameter_search import log_loss
from geoorbit_ros.metrics.paper_losses import LaneLosses

JUDGE_EVERY = 4
"""One in so many seen cameras is a judge."""


@dataclass(frozen=True, slots=True)
class Jury:
    """The cameras that judge.

    Attributes:
        names: Their names.
        divisor: Who they are, as `federated.verdict.is_judge` has it.
        gains: Their gains with a model, in the order of `names`.
    """

    names: tuple[str, ...]
    divisor: int
    gains: Callable[[MetaLearner], list[float]]

    def verdict(self, learner: MetaLearner) -> Verdict:
        """What they say of a model."""
        return verdict_of(self.gains(learner))


def gains_of(model: Sequence[LaneLosses], fixed: Sequence[LaneLosses]) -> list[float]:
    """ln(L_total + 1) with a model minus the same with the defaults, camera by camera."""
    return [log_loss(new) - log_loss(old) for new, old in zip(model, fixed, strict=True)]


def verdict_of(gains: Sequence[float]) -> Verdict:
    """The verdict; with fewer than two judges nothing can be said, and the model is used."""
    return Ballot.of(gains).verdict() or NOBODY_ASKED


def roles(camera_ids: Sequence[str]) -> tuple[int, frozenset[str], frozenset[str]]:
    """Who teaches and who judges among cameras, by the rule of the federation.

    Returns:
        The divisor, teachers, and judges; in a small fleet everybody is both.
    """
    numbers = {name: client_id(name, None) for name in camera_ids}
    divisor = judge_divisor(numbers.values(), JUDGE_EVERY)
    teachers = frozenset(name for name, number in numbers.items() if is_teacher(number, divisor))
    judges = frozenset(name for name, number in numbers.items() if is_judge(number, divisor))
    return divisor, teachers, judges
