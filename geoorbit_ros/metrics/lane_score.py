"""The result of comparing lane maps with the truth, one or many (defined in `metrics.score`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Status

TrafficClass = Literal["busy", "sparse", "rare", "unknown"]
"""busy: 8 vehicles or more, sparse: 3 to 7, rare: fewer than 3, unknown: the truth doesn't say."""


def traffic_class(vehicles: float) -> TrafficClass:
    """How much traffic a true lane carried: what may be asked of a detector depends on it."""
    if np.isnan(vehicles):
        return "unknown"
    return "busy" if vehicles >= 8 else "sparse" if vehicles >= 3 else "rare"


@dataclass(frozen=True, slots=True)
class MatchedLane:
    """One true lane and what was found of it; `lane_id` None when it was missed.

    Attributes:
        truth_id: Id of the true lane.
        vehicles: Vehicles that drove on it; NaN when unknown.
        truth_length_m: Length of the true lane.
        lane_id: Id of the detected lane.
        status: Status of the detected lane.
        error_m: (S,) centreline error of each sample of the common length.
        bias_m: Signed mean of the error, positive when detected too far left.
        heading_error_deg: Direction error over the common length, positive counter-clockwise.
        width_error_m: Detected minus true width; NaN when the truth has no width.
        coverage: Share of the true lane's length that was found.
    """

    truth_id: int
    vehicles: float
    truth_length_m: float
    lane_id: int | None = None
    status: Status | None = None
    error_m: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    bias_m: float = float("nan")
    heading_error_deg: float = float("nan")
    width_error_m: float = float("nan")
    coverage: float = 0.0

    @property
    def traffic(self) -> TrafficClass:
        """How much traffic the true lane carried."""
        return traffic_class(self.vehicles)

    @property
    def mean_m(self) -> float:
        """Mean centreline error, NaN when missed."""
        return float(self.error_m.mean()) if len(self.error_m) else float("nan")

    @property
    def p95_m(self) -> float:
        """95 % quantile of the centreline error, NaN when missed."""
        return float(np.quantile(self.error_m, 0.95)) if len(self.error_m) else float("nan")


@dataclass(frozen=True, slots=True)
class LaneScore:
    """A lane map against the truth.

    Attributes:
        lanes: One row per true lane, in the truth's order.
        invented: Ids of confirmed detected lanes that match no true lane.
        unmatched_tentative: Ids of tentative detected lanes that match no true lane.
        direction_wrong: Ids of detected lanes that lie on a true lane but point the other way.
    """

    lanes: tuple[MatchedLane, ...]
    invented: tuple[int, ...]
    unmatched_tentative: tuple[int, ...]
    direction_wrong: tuple[int, ...]

    @property
    def matched(self) -> tuple[MatchedLane, ...]:
        """True lanes that were found, confirmed or tentative."""
        return tuple(row for row in self.lanes if row.lane_id is not None)

    @property
    def confirmed(self) -> tuple[MatchedLane, ...]:
        """True lanes found as confirmed lanes; the errors below are theirs."""
        return tuple(row for row in self.lanes if row.status == "confirmed")

    def missed(self, traffic: TrafficClass | None = None) -> tuple[int, ...]:
        """Ids of true lanes that were not found at all, of one traffic class or of all."""
        return tuple(
            row.truth_id
            for row in self.lanes
            if row.lane_id is None and traffic in (None, row.traffic)
        )

    @property
    def unconfirmed(self) -> tuple[int, ...]:
        """Ids of busy true lanes (8 vehicles or more) that were found, but only as tentative."""
        return tuple(
            row.truth_id
            for row in self.matched
            if row.traffic == "busy" and row.status != "confirmed"
        )

    @property
    def centerline_error_m(self) -> NDArray[np.float64]:
        """(S,) centreline error of every sample of every matched confirmed lane."""
        return np.concatenate([np.empty(0), *(row.error_m for row in self.confirmed)])

    @property
    def centerline_mean_m(self) -> float:
        """Mean centreline error; NaN without a confirmed match."""
        error = self.centerline_error_m
        return float(error.mean()) if len(error) else float("nan")

    @property
    def centerline_p95_m(self) -> float:
        """95 % quantile of the centreline error; NaN without a confirmed match."""
        error = self.centerline_error_m
        return float(np.quantile(error, 0.95)) if len(error) else float("nan")

    @property
    def width_error_m(self) -> float:
        """Mean of |width error| over confirmed matches whose true width is known."""
        error = np.abs([row.width_error_m for row in self.confirmed])
        error = error[np.isfinite(error)]
        return float(error.mean()) if len(error) else float("nan")

    @property
    def coverage(self) -> float:
        """Share of the matched true lanes' length that was found; NaN without a match."""
        length = np.array([row.truth_length_m for row in self.matched])
        share = np.array([row.coverage for row in self.matched])
        return float((share * length).sum() / length.sum()) if len(length) else float("nan")

    @property
    def passed(self) -> bool:
        """Whether every lane that its traffic makes findable is there, and nothing else.

        Busy lanes (and lanes of unknown traffic) must be confirmed, sparse ones present, no
        confirmed lane invented.
        """
        for row in self.lanes:
            if row.traffic in ("busy", "unknown") and row.status != "confirmed":
                return False
            if row.traffic == "sparse" and row.lane_id is None:
                return False
        return not self.invented and not self.direction_wrong

    def as_dict(self) -> dict[str, object]:
        """The score for `--json`: plain numbers, None instead of NaN."""
        return {
            "lanes": [
                {
                    "truth_id": row.truth_id,
                    "lane_id": row.lane_id,
                    "status": row.status,
                    "vehicles": _number(row.vehicles),
                    "centerline_mean_m": _number(row.mean_m),
                    "centerline_p95_m": _number(row.p95_m),
                    "bias_m": _number(row.bias_m),
                    "heading_error_deg": _number(row.heading_error_deg),
                    "width_error_m": _number(row.width_error_m),
                    "coverage": _number(row.coverage),
                }
                for row in self.lanes
            ],
            "truth": len(self.lanes),
            "matched": len(self.matched),
            "confirmed": len(self.confirmed),
            "missed": list(self.missed()),
            "missed_busy": list(self.missed("busy")),
            "missed_sparse": list(self.missed("sparse")),
            "missed_rare": list(self.missed("rare")),
            "unconfirmed": list(self.unconfirmed),
            "invented": list(self.invented),
            "unmatched_tentative": list(self.unmatched_tentative),
            "direction_wrong": list(self.direction_wrong),
            "centerline_mean_m": _number(self.centerline_mean_m),
            "centerline_p95_m": _number(self.centerline_p95_m),
            "width_error_m": _number(self.width_error_m),
            "coverage": _number(self.coverage),
            "passed": self.passed,
        }


def _number(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None


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
