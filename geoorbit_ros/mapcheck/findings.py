"""A difference between a map and what a camera sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Kind = Literal["offset", "missing", "extra", "shifted", "width", "direction"]

TITLES: dict[Kind, str] = {
    "offset": "the whole map is displaced",
    "missing": "a lane that the map lacks",
    "extra": "a lane of the map that isn't there",
    "shifted": "a lane in another place",
    "width": "a lane of another width",
    "direction": "a lane that runs the other way",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """One place where a camera's lanes and a network differ.

    Attributes:
        kind: What differs.
        lane_id: SUMO's id of the network's lane; of a missing lane, that of the lane beside it;
            empty where there is none, and for the map as a whole.
        detected: Id of the detected lane; None where there is none.
        line_m: (K, 2) where, in the network's map frame; K >= 1.
        measured: By the camera, in `unit`.
        expected: By the network.
        tolerance: The difference that would have been no finding.
        unit: Of the three: `m`, or empty for directions (degrees from north) and lane counts.
        confidence: Probability that the map is wrong here.
        sentence: The finding as a sentence, without the full stop.
    """

    kind: Kind
    lane_id: str
    detected: int | None
    line_m: NDArray[np.float64]
    measured: float
    expected: float
    tolerance: float
    unit: str
    confidence: float
    sentence: str

    @property
    def middle_m(self) -> NDArray[np.float64]:
        """(2,) a point of it."""
        return np.asarray(self.line_m[len(self.line_m) // 2])


@dataclass(frozen=True, slots=True)
class Unseen:
    """A lane of the network that can't be compared yet.

    Attributes:
        lane_id: SUMO's id.
        sentence: Why, and what is needed.
    """

    lane_id: str
    sentence: str
