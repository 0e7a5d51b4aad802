"""The black box that the parameter search sees: theta in, the camera's losses out."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import derive_once
from geoorbit_ros.learning.camera_task import CameraTask, required
from geoorbit_ros.learning.lane_embedding import shipped_embedding
from geoorbit_ros.learning.parameter_space import from_unit
from geoorbit_ros.metrics.paper_losses import LaneLosses, LossWeights, lane_losses

Array = NDArray[np.float64]

DECIMALS = 2
"""Theta is rounded to this many decimals of the unit cube before it is run: rounds
that differ by less then share their results. Chosen: more repeat runs, fewer blur the search."""


def detect_lanes(task: CameraTask, estimator: str, theta: Sequence[float] | Array) -> list[Lane]:
    """All lanes, confirmed and tentative, that an estimator finds on a camera with theta.

    Args:
        task: The camera.
        estimator: A registered name, or `FILE.py:CLASS`.
        theta: (P,) point of the unit cube.
    """
    parameters = from_unit(theta)
    # A fresh estimator: the result must not depend on what was tried before.
    fresh = make_estimator(estimator)
    for k, stamp_ns in enumerate(task.tracks.stamp_ns):
        fresh.add(int(stamp_ns), task.tracks.frame(k))
    with warnings.catch_warnings():
        # FITPACK and KMeans warn at the far corners of the cube; the losses say it too.
        warnings.simplefilter("ignore")
        return list(derive_once(fresh, parameters).lanes)


@dataclass
class Objective:
    """Losses of one camera against one reference, each theta computed once.

    Attributes:
        task: The camera.
        estimator: A registered name, or `FILE.py:CLASS`.
        reference: `task.supervision` when learning, `task.truth` when measuring.
        weights: Lambdas of the total.
        runs: How many times the estimator ran.
    """

    task: CameraTask
    estimator: str
    reference: tuple[Lane, ...]
    weights: LossWeights = field(default_factory=LossWeights)
    runs: int = 0
    _known: dict[bytes, LaneLosses] = field(default_factory=dict, repr=False)

    def losses(self, theta: Sequence[float] | Array) -> LaneLosses:
        """The paper's losses with theta, a (P,) point of the unit cube."""
        rounded = np.round(np.asarray(theta, dtype=np.float64), DECIMALS).astype(np.float64)
        key = rounded.tobytes()
        if key not in self._known:
            self.runs += 1
            lanes = detect_lanes(self.task, self.estimator, rounded)
            asked, tolerated = required(self.reference)
            self._known[key] = lane_losses(
                lanes, asked, shipped_embedding(), self.weights, tolerated
            )
        return self._known[key]

    def total(self, theta: Sequence[float] | Array) -> float:
        """L_total with theta."""
        return self.losses(theta).total
