"""What a camera learns from an observation: the work of one round, fit for a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import threading
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.layout import Tensors
from geoorbit_ros.federated.local_work import LocalResult, TrainingOrder
from geoorbit_ros.learning.camera_task import CameraTask
from geoorbit_ros.learning.meta_learner import MetaLearner
from geoorbit_ros.learning.objective import Objective
from geoorbit_ros.learning.parameter_search import search_theta


@dataclass(frozen=True, slots=True)
class Lesson:
    """What comes back.

    Attributes:
        result: For the client.
        best_theta: (P,) theta* of the observation, in the unit cube: found once, used every round.
    """

    result: LocalResult
    best_theta: NDArray[np.float64]


def end_with_parent() -> None:
    """Initialiser of a worker: it ends when the process that started it ends, kill -9 included."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def learn_from_camera(
    task: CameraTask,
    estimator: str,
    tensors: Tensors,
    order: TrainingOrder,
    best_theta: NDArray[np.float64] | None = None,
) -> Lesson:
    """Detect lanes with the model's theta, search for a better one, step towards it.

    Args:
        task: The observation and its reference lanes; at least one.
        estimator: A name of `lanes.factory`.
        tensors: The global model.
        order: Round and FedProx's penalty.
        best_theta: theta* of the same observation where it is known; None: search for it, which
            runs the estimator over a hundred times.
    """
    from geoorbit_ros.learning.local_training import Examples, train_locally  # imports torch

    objective = Objective(task, estimator, task.supervision)
    predicted = MetaLearner.from_tensors(tensors).predict_unit(task.features)
    if best_theta is None:
        best_theta = search_theta(objective).theta
    examples = Examples(task.features[None], best_theta[None])
    delta, count, _ = train_locally(
        tensors, examples, proximal=order.proximal_mu, seed=_seed(task.camera_id, order)
    )
    return Lesson(LocalResult(delta, count, objective.total(predicted)), best_theta)


def _seed(camera_id: str, order: TrainingOrder) -> int:
    """Another one for each camera and round, and the same one again after a restart."""
    return zlib.crc32(f"{camera_id} {order.round}".encode())
