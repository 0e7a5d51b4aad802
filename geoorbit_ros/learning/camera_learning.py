"""What a camera learns from an observation: the work of one round, fit for a process of its own."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.payloads.model_layout import Tensors
from geoorbit_ros.federated.rounds.local_work import LocalResult, TrainingOrder
from geoorbit_ros.learning.camera_task import CameraTask
from geoorbit_ros.learning.meta_learner import MetaLearner
from geoorbit_ros.learning.objective import Objective
from geoorbit_ros.learning.parameter_search import log_loss, search_theta
from geoorbit_ros.learning.parameter_space import DEFAULT_UNIT


@dataclass(frozen=True, slots=True)
class LearningResult:
    """What comes back.

    Attributes:
        result: For the client.
        best_theta: (P,) theta* of the observation, in the unit cube: found once, used every round;
            None where it was not needed yet.
    """

    result: LocalResult
    best_theta: NDArray[np.float64] | None


def learn_from_camera(
    task: CameraTask,
    estimator: str,
    tensors: Tensors,
    order: TrainingOrder,
    best_theta: NDArray[np.float64] | None = None,
) -> LearningResult:
    """Detect lanes with the model's theta, search for a better one, step towards it.

    A validation client also compares with the defaults; one that does not train does only that.

    Args:
        task: The observation and its reference lanes; at least one.
        estimator: A registered name, or `FILE.py:CLASS`.
        tensors: The global model.
        order: What to do, the round, and FedProx's penalty.
        best_theta: theta* of the same observation where it is known; None: search for it, which
            runs the estimator over a hundred times.
    """
    objective = Objective(task, estimator, task.supervision)
    losses = objective.losses(MetaLearner.from_tensors(tensors).predict_unit(task.features))
    gain = float("nan")
    if order.validate:
        gain = log_loss(losses) - log_loss(objective.losses(DEFAULT_UNIT))
    if not order.train:
        return LearningResult(LocalResult({}, 0, losses.total, gain), best_theta)
    from geoorbit_ros.learning.local_training import Examples, train_locally  # imports torch

    if best_theta is None:
        best_theta = search_theta(objective).theta
    examples = Examples(task.features[None], best_theta[None])
    delta, count, _ = train_locally(
        tensors, examples, proximal=order.proximal_mu, seed=_seed(task.camera_id, order)
    )
    return LearningResult(LocalResult(delta, count, losses.total, gain), best_theta)


def _seed(camera_id: str, order: TrainingOrder) -> int:
    """Another one for each camera and round, and the same one again after a restart."""
    return zlib.crc32(f"{camera_id} {order.round}".encode())
