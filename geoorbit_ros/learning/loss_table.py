"""Losses of many cameras at many theta, each computed once and in parallel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.learning.camera_task import CameraTask, load_task
from geoorbit_ros.learning.objective import DECIMALS, Objective
from geoorbit_ros.learning.parameter_search import SearchResult, search_theta
from geoorbit_ros.learning.processes import Progress, quiet, spread, watched
from geoorbit_ros.metrics.paper_losses import LaneLosses

Array = NDArray[np.float64]
Reference = Literal["supervision", "truth"]
Query = tuple[str, tuple[float, ...]]
"""Camera id, theta."""


@dataclass(frozen=True, slots=True)
class CameraFile:
    """Where a camera's task is kept, and which of its references is asked about."""

    path: Path
    estimator: str
    reference: Reference


@dataclass
class LossTable:
    """L_total and its terms by camera and theta.

    Attributes:
        files: Task files by camera id.
        estimator: A registered name, or `FILE.py:CLASS`.
        reference: `supervision` when learning, `truth` when measuring.
        workers: Processes.
    """

    files: dict[str, Path]
    estimator: str
    reference: Reference
    workers: int = 1
    _known: dict[Query, LaneLosses] = field(default_factory=dict, repr=False)

    def losses(
        self, queries: Sequence[tuple[str, Array]], progress: Progress = quiet
    ) -> list[LaneLosses]:
        """The losses of (camera id, theta) pairs, in their order."""
        keys: list[Query] = [
            (camera, tuple(np.round(theta, DECIMALS).tolist())) for camera, theta in queries
        ]
        missing = [key for key in dict.fromkeys(keys) if key not in self._known]
        jobs = [
            (CameraFile(self.files[camera], self.estimator, self.reference), theta)
            for camera, theta in missing
        ]
        found = watched(spread(_losses, jobs, self.workers), len(jobs), "measuring", progress)
        self._known.update(zip(missing, found, strict=True))
        return [self._known[key] for key in keys]


@lru_cache(maxsize=64)
def _task(path: Path) -> CameraTask:
    return load_task(path)


def _objective(file: CameraFile) -> Objective:
    task = _task(file.path)
    reference = task.supervision if file.reference == "supervision" else task.truth
    return Objective(task, file.estimator, reference)


def _losses(job: tuple[CameraFile, tuple[float, ...]]) -> LaneLosses:
    file, theta = job
    return _objective(file).losses(theta)


def search_job(job: tuple[CameraFile, int]) -> SearchResult:
    """Theta* of one camera; (file, seed)."""
    file, seed = job
    return search_theta(_objective(file), seed=seed)
