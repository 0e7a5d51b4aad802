"""All models on all cameras: the paper's losses and honest errors, by model, split and seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.learning.camera_task import load_task, required
from geoorbit_ros.learning.lane_embedding import shipped_embedding
from geoorbit_ros.learning.meta_learner import load_model
from geoorbit_ros.learning.objective import DECIMALS, detect_lanes
from geoorbit_ros.learning.parameter_space import DEFAULT_UNIT
from geoorbit_ros.learning.population import Split
from geoorbit_ros.learning.population_cameras import (
    PopulationCamera,
    best_parameters,
    examples_of,
    split_seen_cameras,
)
from geoorbit_ros.learning.processes import Progress, quiet, spread, watched
from geoorbit_ros.learning.study import CAMERAS, Study, seed_of
from geoorbit_ros.learning.training import Mode
from geoorbit_ros.metrics.paper_losses import LaneLosses, lane_losses
from geoorbit_ros.metrics.score import LaneScore, score_lanes, traffic_class

Array = NDArray[np.float64]

BASELINE, COMMON, META, FEDMETA, SEARCHED = "Baseline", "One for all", "Meta", "FedMeta", "Searched"
_MODE: dict[str, Mode] = {META: "central", FEDMETA: "federated"}


@dataclass(frozen=True, slots=True)
class CameraResult:
    """One camera with one theta, measured by its true lanes.

    Attributes:
        losses: The paper's.
        score: Honest errors; None where the lanes were not surveyed.
        count_right: Whether the number of confirmed lanes is right, see `count_is_right`.
    """

    losses: LaneLosses
    score: LaneScore | None
    count_right: bool


@dataclass(frozen=True, slots=True)
class ModelResult:
    """One model on the cameras of a split.

    Attributes:
        model: Its name in tables.
        seed: Of its training; where nothing is trained, the first one that used these cameras.
        split: Which cameras.
        cameras: Results by camera id.
    """

    model: str
    seed: int
    split: Split
    cameras: dict[str, CameraResult]

    def mean(self, term: str) -> float:
        """Mean of one of the paper's losses over the cameras."""
        return float(np.mean([getattr(r.losses, term) for r in self.cameras.values()]))

    def median_total(self) -> float:
        """Median of L_total over the cameras."""
        return float(np.median([r.losses.total for r in self.cameras.values()]))


def evaluate(study: Study, estimator: str, progress: Progress = quiet) -> list[ModelResult]:
    """Measure the fixed parameters and every trained model of an estimator.

    * Baseline: the default parameters on every camera.
    * One for all: the mean of the training cameras' theta*, on every camera: the best
      that is possible without looking at the scene.
    * Meta, FedMeta: the trained models, one row per seed.
    * Searched: theta* of each seen camera that taught, which none without a reference can have.

    Raises:
        InputFileError: Nothing was trained for this estimator.
    """
    seeds = study.trained_seeds(estimator)
    if not seeds:
        raise InputFileError(str(study.folder), f"no model of {estimator}", "geoorbit train first")
    rows = []
    for draw in range(study.population.draws):
        drawn = [seed for seed in seeds if seed % study.population.draws == draw]
        if drawn:
            rows += _evaluate_draw(study, estimator, drawn, progress)
    return rows


def _evaluate_draw(
    study: Study, estimator: str, seeds: Sequence[int], progress: Progress
) -> list[ModelResult]:
    """The rows of seeds that share their cameras."""
    cameras = study.cameras(seeds[0], progress)
    seen, _ = split_seen_cameras(cameras)
    best = best_parameters(
        seen, estimator, study.folder / CAMERAS, study.workers, progress=progress
    )
    common = np.mean([e.targets[0] for e in examples_of(seen, best).values()], axis=0)
    features = np.array([camera.features for camera in cameras])
    plans: list[tuple[str, int, Array]] = [
        (BASELINE, seeds[0], np.tile(DEFAULT_UNIT, (len(cameras), 1))),
        (COMMON, seeds[0], np.tile(common, (len(cameras), 1))),
    ]
    for name, mode in _MODE.items():
        for path in study.models(estimator, mode):
            if seed_of(path) in seeds:
                learner = load_model(path)
                plans.append((name, seed_of(path), learner.predict_unit(features)))
    searched = np.array([best[camera.camera_id].theta for camera in seen])
    jobs = [
        (camera, theta)
        for _, _, thetas in plans
        for camera, theta in zip(cameras, thetas, strict=True)
    ]
    jobs += list(zip(seen, searched, strict=True))
    results = iter(_measure_all(jobs, estimator, study.workers, progress))
    rows = []
    for name, seed, _ in plans:
        found = {camera.camera_id: next(results) for camera in cameras}
        rows += [_row(name, seed, split, cameras, found) for split in ("seen", "unseen")]
    found = {camera.camera_id: next(results) for camera in seen}
    return [*rows, ModelResult(SEARCHED, seeds[0], "seen", found)]


def _row(
    model: str,
    seed: int,
    split: Split,
    cameras: Sequence[PopulationCamera],
    found: dict[str, CameraResult],
) -> ModelResult:
    chosen = [camera.camera_id for camera in cameras if camera.split == split]
    return ModelResult(model, seed, split, {name: found[name] for name in chosen})


_Job = tuple[PopulationCamera, str, tuple[float, ...]]


def _measure_all(
    asked: Sequence[tuple[PopulationCamera, Array]],
    estimator: str,
    workers: int,
    progress: Progress,
) -> list[CameraResult]:
    """Results in the order of `asked`; equal questions are answered once."""
    keys = [
        (camera.camera_id, tuple(np.round(theta, DECIMALS).tolist())) for camera, theta in asked
    ]
    jobs: dict[tuple[str, tuple[float, ...]], _Job] = {
        key: (camera, estimator, key[1]) for key, (camera, _) in zip(keys, asked, strict=True)
    }
    answers = watched(
        spread(measure_camera, list(jobs.values()), workers),
        len(jobs),
        f"measuring ({estimator})",
        progress,
    )
    known = dict(zip(jobs, answers, strict=True))
    return [known[key] for key in keys]


def measure_camera(job: _Job) -> CameraResult:
    """One camera with one theta; (camera, estimator, theta)."""
    camera, estimator, theta = job
    task = load_task(camera.path)
    lanes = detect_lanes(task, estimator, theta)
    asked, tolerated = required(task.truth)
    losses = lane_losses(lanes, asked, shipped_embedding(), tolerated=tolerated)
    score = score_lanes(lanes, task.truth) if task.surveyed else None
    return CameraResult(losses, score, count_is_right(lanes, task.truth))


def count_is_right(lanes: Sequence[Lane], truth: Sequence[Lane]) -> bool:
    """Whether as many lanes are confirmed, and so published on `lanes`, as there are.

    All with eight vehicles or more, or an unknown number, must be, those with three to seven may
    be, and no more.
    """
    confirmed = sum(lane.status == "confirmed" for lane in lanes)
    classes = [traffic_class(lane.vehicles) for lane in truth]
    certain = sum(name in ("busy", "unknown") for name in classes)
    return certain <= confirmed <= certain + classes.count("sparse")
