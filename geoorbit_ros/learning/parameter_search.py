"""Search for theta*, the parameters that suit one camera best (the paper's reference theta*)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.learning.objective import Objective
from geoorbit_ros.learning.parameter_space import DEFAULT_UNIT
from geoorbit_ros.metrics.paper_losses import LaneLosses

Array = NDArray[np.float64]

POPULATION, GENERATIONS = 16, 4
"""80 runs with the first generation. Chosen: more take time, fewer miss good parameters (ADR
`docs/adr/*-best-parameters-near-the-defaults.md`)."""
NOTHING_FOUND = 50.0
"""Cost of theta with which no lane is found, above any other's: an empty map must not
win, though its losses are often lower than those of a wrong one. Chosen: 50 is
ln(L_total + 1) of a total of 5e21, above that of any map."""
STAY = 0.3
"""Price of leaving the defaults, in ln(L_total) per squared length in the unit cube. Chosen: larger
holds theta* at the defaults, smaller lets theta* of similar cameras scatter (same ADR)."""
LOSS_FLOOR = 1.0
"""Totals are compared as ln(total + floor): below it, differences are noise (a metre of Fréchet
distance, one lane)."""


@dataclass(frozen=True, slots=True)
class SearchResult:
    """What a search found.

    Attributes:
        theta: (P,) theta*, in the unit cube.
        total: Its L_total.
        default_total: L_total of the default parameters.
        runs: How many times the lanes were estimated.
        found: Whether any lane was found with it: a camera on which no theta finds one has nothing
            to train from.
    """

    theta: Array
    total: float
    default_total: float
    runs: int
    found: bool


def search_theta(
    objective: Objective, start: Array | None = None, seed: int = 0, stay: float = STAY
) -> SearchResult:
    """Minimise ln(L_total + 1) + stay * |theta - start|^2 by differential evolution.

    L_total is flat in wide regions and jumps between them, so no gradient helps. The second term
    chooses among the many theta that do equally well: without it, theta* of cameras that are alike
    scatters over the cube, and where nothing is gained it stays where it was.

    Args:
        objective: The camera.
        start: (P,) where the search starts and what it is drawn to; default: the default theta.
        seed: The same seed gives the same result.
        stay: Weight of the second term.
    """
    origin = DEFAULT_UNIT if start is None else np.asarray(start, dtype=np.float64)
    before = objective.runs

    def cost(theta: Array) -> float:
        gone = float(np.sum((theta - origin) ** 2))
        return log_loss(objective.losses(theta)) + stay * gone

    found = scipy.optimize.differential_evolution(
        cost,
        [(0.0, 1.0)] * len(origin),
        init=_first_population(origin, seed),
        maxiter=GENERATIONS,
        mutation=(0.4, 0.8),
        recombination=0.8,
        tol=1e-3,
        polish=False,
        rng=np.random.default_rng([seed, 12]),
    )
    theta = np.asarray(found.x, dtype=np.float64)
    if cost(origin) <= cost(theta):
        theta = origin
    best = objective.losses(theta)
    return SearchResult(
        theta,
        best.total,
        objective.total(DEFAULT_UNIT),
        objective.runs - before,
        best.detected > 0,
    )


def log_loss(losses: LaneLosses) -> float:
    """ln(L_total + 1), or `NOTHING_FOUND`: how cameras with large and small losses are compared."""
    if losses.detected == 0:
        return NOTHING_FOUND
    return float(np.log(losses.total + LOSS_FLOOR))


def _first_population(origin: Array, seed: int) -> Array:
    """(POPULATION, P): the origin, then a Latin hypercube."""
    random = np.random.default_rng([seed, 13])
    count = POPULATION - 1
    strata = np.array([random.permutation(count) for _ in origin]).T
    cube = (strata + random.uniform(size=strata.shape)) / count
    return np.asarray(np.vstack([origin, cube]))
