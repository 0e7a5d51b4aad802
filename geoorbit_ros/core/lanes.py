"""What a lane is, for every producer and consumer of lanes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Status = Literal["confirmed", "tentative"]
Marking = Literal["", "solid", "dashed", "double"]
MarkingColour = Literal["", "white", "yellow"]


@dataclass(frozen=True, slots=True)
class LaneEvidence:
    """What speaks for a lane.

    Attributes:
        vehicles: Distinct vehicles that drove along it; one seen over a short stretch counts less.
        lane_share: Share of the traffic in its band that drives along it rather than across.
        length: Its length in units of the road's scale (about a second of travel).
        presence: Traffic seen there as a share of the most seen in that band of the road.
    """

    vehicles: float
    lane_share: float
    length: float
    presence: float


@dataclass(frozen=True, slots=True)
class LaneEdge:
    """What a lane's boundary was taken from.

    Attributes:
        source: `paint` where it follows a line in the image, `traffic` where it follows from where
            vehicles drive.
        sigma_m: 1-sigma error of its position, mean over the lane.
        marking: `solid`, `dashed`, or `double`: two solid lines, whose common middle is the
            boundary; empty without a line.
        colour: `white` or `yellow`; empty without a line.
        marking_width_m: Width of the line, of both with their gap for `double`; NaN without one.
        painted_share: Share of the lane's length along which the line is seen.
        sigma_along_m: 1-sigma error at each of the boundary's points; empty where it is `sigma_m`
            everywhere, or the producer doesn't say.
    """

    source: Literal["paint", "traffic"]
    sigma_m: float
    marking: Marking = ""
    colour: MarkingColour = ""
    painted_share: float = 0.0
    marking_width_m: float = float("nan")
    sigma_along_m: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Lane:
    """One lane in the map frame (local ENU metres, REP-103).

    Attributes:
        lane_id: Stable over updates of the same map; never reused.
        centerline_m: (K, 2) float64, in travel order.
        left_m: (K, 2) left boundary as the driver sees it, point by point beside the centreline.
        right_m: (K, 2) right boundary.
        width_m: Mean distance between the boundaries.
        width_sigma_m: 1-sigma error of `width_m`.
        confidence: Score in [0, 1]: how sure it is that this is exactly one lane.
        status: `confirmed` when the evidence suffices, else `tentative`.
        vehicles: Distinct vehicles seen in the lane (decayed evidence counts less).
        vehicles_missing: How many more vehicles would confirm it; 0 when confirmed.
        sigma_m: 1-sigma lateral error of the centreline, mean over its length.
        evidence: What the confidence was computed from; None when the producer doesn't say.
        left_edge: What the left boundary was taken from; None when the producer doesn't say.
        right_edge: The same of the right one.
        driven_offset_m: How far left of the middle between two painted lines the median driver is;
            NaN where not both are seen.
        shift_sigma_m: 1-sigma by which the centreline, the left and the right boundary lie aside as
            a whole, by errors of the calibration that no traffic averages; NaN where the producer
            doesn't say.
    """

    lane_id: int
    centerline_m: NDArray[np.float64]
    left_m: NDArray[np.float64]
    right_m: NDArray[np.float64]
    width_m: float
    width_sigma_m: float
    confidence: float
    status: Status
    vehicles: float
    vehicles_missing: int = 0
    sigma_m: float = float("nan")
    evidence: LaneEvidence | None = None
    left_edge: LaneEdge | None = None
    right_edge: LaneEdge | None = None
    driven_offset_m: float = float("nan")
    shift_sigma_m: tuple[float, float, float] = (float("nan"),) * 3

    @property
    def middle(self) -> tuple[float, float, float]:
        """(x_m, y_m, heading_rad) half-way along the centreline; heading CCW from east."""
        step = np.diff(self.centerline_m, axis=0)
        arc = np.append(0.0, np.cumsum(np.hypot(step[:, 0], step[:, 1])))
        k = min(int(np.searchsorted(arc, arc[-1] / 2, side="right")) - 1, len(step) - 1)
        t = (arc[-1] / 2 - arc[k]) / max(arc[k + 1] - arc[k], 1e-12)
        x, y = self.centerline_m[k] + t * step[k]
        return float(x), float(y), float(np.arctan2(step[k, 1], step[k, 0]))

    @property
    def heading_deg(self) -> float:
        """Travel direction at the middle, degrees clockwise from north, in [0, 360)."""
        return float((90.0 - np.degrees(self.middle[2])) % 360.0)

    @property
    def length_m(self) -> float:
        """Arc length of the centreline."""
        return float(np.hypot(*np.diff(self.centerline_m, axis=0).T).sum())


def lane_of_map(
    lane_id: int,
    centerline_m: NDArray[np.float64],
    left_m: NDArray[np.float64],
    right_m: NDArray[np.float64],
) -> Lane:
    """A lane of a map, by its three lines (K, 2): certain, and without vehicles of its own."""
    width_m = float(np.mean(np.hypot(*(left_m - right_m).T)))
    nan = float("nan")
    return Lane(lane_id, centerline_m, left_m, right_m, width_m, nan, 1.0, "confirmed", nan)


@dataclass(frozen=True, slots=True)
class CrossSection:
    """Lateral distribution of traffic across one direction of travel, for reports.

    Attributes:
        heading_deg: Travel direction, clockwise from north.
        offset_m: (B,) lateral position of each bin's centre, positive to the driver's left.
        density: (B,) vehicles per metre, smoothed.
        peak_m: (P,) lateral positions taken for lanes.
    """

    heading_deg: float
    offset_m: NDArray[np.float64]
    density: NDArray[np.float64]
    peak_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ViewNote:
    """What a person should know of the camera's view when a lane map was published.

    Attributes:
        held: Whether the lanes are those of an earlier time, as the image does not show them now.
        since_ns: Since when.
        why: What happened, in a sentence.
    """

    held: bool
    since_ns: int
    why: str


@dataclass(frozen=True, slots=True)
class LaneMap:
    """All lanes one camera knows at one time.

    Attributes:
        stamp_ns: Capture time of the newest evidence in the map.
        lanes: Confirmed and tentative lanes, ordered by `lane_id`.
        cross_sections: One per direction of travel; may be empty.
        visible_m: (V, 2) polygon on the ground inside which a lane can be told from its neighbour;
            empty when unknown.
        segments: Trajectory segments that the map was derived from; 0 when none or unknown.
        doubtful: Something speaks against the calibration or the boxes, so that no lane is
            confirmed, however much traffic there is.
        view: What is to be known of the camera's view; None: it is where it was calibrated, or
            nobody watches it.
    """

    stamp_ns: int
    lanes: tuple[Lane, ...]
    cross_sections: tuple[CrossSection, ...] = ()
    visible_m: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    segments: int = 0
    doubtful: bool = False
    view: ViewNote | None = None

    @property
    def held(self) -> bool:
        """Whether the lanes are those of an earlier time."""
        return self.view is not None and self.view.held

    @property
    def confirmed(self) -> tuple[Lane, ...]:
        """The lanes with enough evidence."""
        return tuple(lane for lane in self.lanes if lane.status == "confirmed")
