"""A camera in a federation: observes, predicts theta, trains or validates. Free of ROS."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.federated.keys import Signer
from geoorbit_ros.federated.payloads.global_model import interface_digest
from geoorbit_ros.federated.payloads.lane_parameters import ThetaPayload
from geoorbit_ros.federated.payloads.model_layout import Tensors
from geoorbit_ros.federated.rounds.client import FederatedClient, ResendQueue, Work
from geoorbit_ros.federated.rounds.local_work import LocalResult, TrainingOrder
from geoorbit_ros.lanes.parameters import LaneParameters
from geoorbit_ros.learning.camera_task import CameraTask
from geoorbit_ros.learning.features import FEATURE_NAMES, scene_features
from geoorbit_ros.learning.meta_learner import MetaLearner, load_model
from geoorbit_ros.learning.objective import Objective
from geoorbit_ros.learning.parameter_search import log_loss, search_theta
from geoorbit_ros.learning.parameter_space import DEFAULT_UNIT, PARAMETER_NAMES

INTERFACE = interface_digest(FEATURE_NAMES, PARAMETER_NAMES)
"""What both sides must agree on: the meta-learner's inputs and outputs."""
SETTLE_S = 2.0
"""Chosen: longer delays the first observation, shorter may use a map of which lanes are missing."""


class CameraSession:
    """Ties a client to its camera's tracks and reference lanes.

    Every `observation_s` of tracks make an observation; the newest counts. Reference lanes arrive
    one by one, and so count once they have not changed for `SETTLE_S`. A round is worked on in
    `executor`, one at a time; a newer round replaces one that waits.

    Args:
        client: The federated client.
        signer: Signs theta.
        estimator: A registered name, or `FILE.py:CLASS`.
        observation_s: Length of an observation, by the stamps of the tracks.
        executor: Where training runs; a process, for it takes a core for seconds.
        resend_s: After this time without a newer model an update is sent again, and after twice as
            long once more, and so on; 0: never.

    Attributes:
        reference: Reference lanes by number, from the map.
        learner: Predicts while no model of the server is approved; None: the defaults.
        observations: How many were completed.
        trained: Rounds that were trained or validated for.
    """

    def __init__(
        self,
        client: FederatedClient,
        signer: Signer,
        estimator: str,
        observation_s: float,
        executor: Executor,
        resend_s: float = 0.0,
    ) -> None:
        self.client, self._signer = client, signer
        self._estimator, self._executor = estimator, executor
        self._resend = ResendQueue(resend_s)
        self._length_ns = round(observation_s * 1e9)
        self.reference: dict[int, Lane] = {}
        self._settled_s = 0.0
        self.learner: MetaLearner | None = None
        self.observations = self.trained = 0
        self.restart()
        self._tracks: Frames | None = None
        self._features: NDArray[np.float64] | None = None
        self._best: tuple[object, NDArray[np.float64]] | None = None
        self._work: Work | None = None
        self._running: tuple[Work, object, Future[LearningResult]] | None = None
        self._died_of: Work | None = None
        self._predicted: object = None

    def restart(self) -> None:
        """Forget the observation that has begun: its source starts again."""
        self._stamps: list[int] = []
        self._rows: list[NDArray[np.void]] = []

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take one frame of tracks."""
        self._stamps.append(stamp_ns)
        self._rows.append(rows.copy())
        if stamp_ns - self._stamps[0] < self._length_ns:
            return
        offset = np.cumsum([0, *(len(rows) for rows in self._rows)])
        tracks = Frames(np.array(self._stamps), offset, np.concatenate(self._rows))
        self._tracks, self._features = tracks, scene_features(tracks)
        self.observations += 1
        self.restart()

    def refer(self, lanes: Mapping[int, Lane], now_s: float) -> None:
        """Take all reference lanes by number, at this time of a clock that does not go back."""
        self.reference, self._settled_s = dict(lanes), now_s + SETTLE_S

    def receive(self, payload: bytes) -> None:
        """Take what the server sent.

        Raises:
            PayloadError: It was refused.
        """
        work = self.client.receive(payload)
        self._work = work

    @property
    def waits_for(self) -> str:
        """What is missing before this camera can train; empty: nothing."""
        if self.client.tensors is None:
            return "a model"
        if self._tracks is None:
            return "tracks"
        return "" if self.reference else "reference lanes"

    def facts(self) -> dict[str, object]:
        """What it has and what it waits for, for people to read."""
        run, number, _ = self.client.model_of
        refused = self.client.refused.items()
        return {
            "run": run,
            "round": number,
            "answered": self.client.answered,
            "finished": self.client.finished,
            "model_in_use": f"{self.client.used:08x}" if self.client.used else "none",
            "observations": self.observations,
            "reference_lanes": len(self.reference),
            "trained": self.trained,
            "waits_for": self.waits_for,
            **{f"refused_{reason.replace(' ', '_')}": count for reason, count in refused},
        }

    def poll(self, now_s: float) -> bytes | None:
        """Go on with what is due at this time; an update to send, or None.

        Raises:
            GeoOrbitError: Training failed.
        """
        return self._resend.pass_on(self._poll(now_s), self.client, now_s)

    def _poll(self, now_s: float) -> bytes | None:
        if self._running is not None:
            return self._finish(*self._running)
        work = self._work
        if work is not None and work.ready:
            self._work = None
            return work.ready
        if work is None or self._tracks is None or self._features is None:
            return None
        if not self.reference or now_s < self._settled_s:
            return None
        self._work = None
        lanes = tuple(self.reference[number] for number in sorted(self.reference))
        task = CameraTask(
            self.client.camera_id, self._tracks, self._features, lanes, lanes, surveyed=False
        )
        key = (id(self._tracks), tuple(map(id, lanes)))
        known = self._best[1] if self._best and self._best[0] == key else None
        future = self._executor.submit(
            learn_from_camera, task, self._estimator, work.tensors, work.order, known
        )
        self._running = (work, (key, task), future)
        return None

    def theta(self) -> bytes | None:
        """The payload with theta for the model in use and this observation; None when it is known.

        Where this camera has no approved model, theta is `learner`'s, or else the
        defaults.
        """
        tensors, features = self.client.used_tensors, self._features
        learner = MetaLearner.from_tensors(tensors) if tensors else self.learner
        heard = self.client.tensors is not None
        if features is None or (learner is None and not heard):
            return None
        parameters = learner.predict(features) if learner else LaneParameters()
        known = (self.client.used, parameters)
        if self._predicted == known:
            return None
        self._predicted = known
        run, number, _ = self.client.model_of
        values = asdict(parameters)
        theta = ThetaPayload(self.client.camera_id, run, number, self.client.used, values)
        return self._signer.seal(theta.unsigned())

    def _finish(self, work: Work, made_of: object, future: Future[LearningResult]) -> bytes | None:
        if not future.done():
            return None
        self._running = None
        try:
            lesson = future.result()
        except GeoOrbitError:
            raise
        except BrokenExecutor as error:  # killed from outside: once more, unless a newer one waits
            if self._work is None and self._died_of is not work:
                self._work = self._died_of = work
            place = f"training of round {work.round}"
            raise GeoOrbitError(place, "a process that was killed", "an update") from error
        except Exception as error:  # whatever ends a worker must not end the node
            place = f"training of round {work.round}"
            raise GeoOrbitError(place, repr(error), "an update") from error
        assert isinstance(made_of, tuple)
        if lesson.best_theta is not None:
            self._best = (made_of[0], lesson.best_theta)
        self.trained += 1
        return self.client.finish(work, lesson.result)


def starting_learner(model_file: str, seed: int) -> MetaLearner:
    """The learner in a file, or without one an untrained learner, which predicts the defaults.

    Raises:
        InputFileError: A file that holds none.
    """
    return load_model(Path(model_file)) if model_file else MetaLearner.untrained(seed)


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

    The work of one round. It takes a core for seconds, and so runs in a process of its own.

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
