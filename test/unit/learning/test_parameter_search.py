"""The search finds better parameters, the same ones each time, and none where none are better."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from tasks import made_task

from geoorbit_ros.learning.objective import Objective
from geoorbit_ros.learning.parameter_search import search_theta
from geoorbit_ros.learning.parameter_space import DEFAULT_UNIT
from geoorbit_ros.learning.validation import gains_of, verdict_of
from geoorbit_ros.metrics.paper_losses import LaneLosses


def loss(total: float, detected: int = 2) -> LaneLosses:
    return LaneLosses(total, 0.0, 0.0, 0.0, total, detected)


@dataclass
class MadeUp(Objective):
    """A loss that is known at every theta; below `silent`, no lane is found."""

    best: NDArray[np.float64] | None = None
    silent: float = 0.0

    def losses(self, theta: NDArray[np.float64]) -> LaneLosses:  # type: ignore[override]
        self.runs += 1
        if theta[0] < self.silent:
            return loss(0.0, detected=0)
        best = DEFAULT_UNIT if self.best is None else self.best
        return loss(1000.0 * float(np.sum((theta - best) ** 2)))


def made_up(best: NDArray[np.float64] | None, silent: float = 0.0) -> MadeUp:
    return MadeUp(made_task(), "none", (), best=best, silent=silent)


def test_the_search_goes_where_the_loss_is_low_and_repeats_itself() -> None:
    best = np.array([0.2, 0.8, 0.3])
    found = search_theta(made_up(best), seed=1, stay=0.0)
    assert found.total < 0.1 * found.default_total
    again = search_theta(made_up(best), seed=1, stay=0.0)
    assert found.theta.tobytes() == again.theta.tobytes()
    assert found.runs == again.runs > 10


def test_where_nothing_is_gained_theta_stays() -> None:
    found = search_theta(made_up(None), seed=2)
    np.testing.assert_array_equal(found.theta, DEFAULT_UNIT)


def test_finding_nothing_is_never_the_best() -> None:
    found = search_theta(made_up(np.array([0.3, 0.5, 0.5]), silent=0.5), seed=3)
    assert found.found
    assert found.theta[0] >= 0.5
    hopeless = search_theta(made_up(None, silent=2.0), seed=3)
    assert not hopeless.found
    np.testing.assert_array_equal(hopeless.theta, DEFAULT_UNIT)


def test_the_paper_s_width_is_too_small_and_the_search_widens_it() -> None:
    task = made_task()
    objective = Objective(task, "geolane", task.truth)
    found = search_theta(objective, seed=0)
    assert found.total < found.default_total
    assert found.theta[2] > DEFAULT_UNIT[2], "2 sigma of lateral wander is no lane width"


def test_one_camera_s_losses_are_computed_once_per_theta() -> None:
    task = made_task()
    objective = Objective(task, "curvilinear", task.truth)
    first = objective.losses(DEFAULT_UNIT)
    assert objective.losses(DEFAULT_UNIT + 1e-6) == first
    assert objective.runs == 1
    assert first.lane_num == 0.0


@pytest.mark.parametrize(
    ("factors", "accepted"),
    [
        ((0.5, 0.6, 0.4, 0.5), True),
        ((1.0, 1.0, 1.0, 1.0), False),
        ((0.5, 0.6, 0.4, 3.0), False),  # three better, one much worse: may be chance
        ((1.1, 1.2, 1.1, 1.2), False),
    ],
)
def test_a_model_is_accepted_when_judges_agree_that_it_is_better(
    factors: tuple[float, ...], accepted: bool
) -> None:
    fixed = [loss(t) for t in (10.0, 5000.0, 200.0, 30.0)]
    model = [loss(f * old.total) for f, old in zip(factors, fixed, strict=True)]
    assert verdict_of(gains_of(model, fixed)).accepted is accepted


def test_a_model_that_silences_a_judge_is_not_accepted() -> None:
    fixed = [loss(100.0)] * 4
    model = [*[loss(50.0)] * 3, loss(0.0, detected=0)]
    assert not verdict_of(gains_of(model, fixed)).accepted
