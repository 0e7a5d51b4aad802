"""Scores of many runs as one: the sums behind tables over scenes, seeds and cameras."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.metrics.lane_score import LaneScore


@dataclass
class Tally:
    """Scores of one estimator, summed over runs; see `metrics.score` for the words.

    Attributes:
        busy: True lanes with 8 vehicles or more.
        busy_confirmed: Those that were found and confirmed.
        sparse: True lanes with 3 to 7 vehicles.
        sparse_found: Those that were found, confirmed or tentative.
        invented: Confirmed lanes that match no true lane.
        wrong_way: Lanes that lie on a true lane but point the other way.
        error_m: Centreline errors of the samples of each run.
        width_error_m: |width error| of each confirmed match whose true width is known.
        covered_m: Length of the matched true lanes that was found.
        length_m: Length of the matched true lanes.
    """

    busy: int = 0
    busy_confirmed: int = 0
    sparse: int = 0
    sparse_found: int = 0
    invented: int = 0
    wrong_way: int = 0
    error_m: list[NDArray[np.float64]] = field(default_factory=list)
    width_error_m: list[float] = field(default_factory=list)
    covered_m: float = 0.0
    length_m: float = 0.0

    def add(self, score: LaneScore) -> None:
        """Count one run."""
        busy = [row for row in score.lanes if row.traffic == "busy"]
        sparse = [row for row in score.lanes if row.traffic == "sparse"]
        self.busy += len(busy)
        self.busy_confirmed += sum(row.status == "confirmed" for row in busy)
        self.sparse += len(sparse)
        self.sparse_found += sum(row.lane_id is not None for row in sparse)
        self.invented += len(score.invented)
        self.wrong_way += len(score.direction_wrong)
        self.error_m.append(score.centerline_error_m)
        errors = [abs(row.width_error_m) for row in score.confirmed]
        self.width_error_m += [error for error in errors if np.isfinite(error)]
        self.covered_m += sum(row.coverage * row.truth_length_m for row in score.matched)
        self.length_m += sum(row.truth_length_m for row in score.matched)

    def join(self, other: Tally) -> None:
        """Add the runs of another tally."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)

    @property
    def faults(self) -> int:
        """Lanes missed, invented or pointing the wrong way."""
        missed = self.busy - self.busy_confirmed + self.sparse - self.sparse_found
        return missed + self.invented + self.wrong_way

    def errors_m(self) -> tuple[float, float, float]:
        """Mean and 95 % quantile of the centreline error, mean width error; NaN without lanes."""
        error = np.concatenate([np.empty(0), *self.error_m])
        width = float(np.mean(self.width_error_m)) if self.width_error_m else np.nan
        if len(error) == 0:
            return np.nan, np.nan, width
        return float(error.mean()), float(np.quantile(error, 0.95)), width

    @property
    def coverage(self) -> float:
        """Share of the matched true lanes' length that was found; NaN without a match."""
        return self.covered_m / self.length_m if self.length_m else np.nan
